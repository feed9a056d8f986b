"""Stray light between lens, filter and chip (Kahlmann 2007, sec. 3.3.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.convolution import (
    Spreading,
    complex_image,
    gaussian_matrix,
    gaussian_matrix_by_sigma,
    planar,
    shift,
)
from rim_camera_ros.effects.base import ComplexEffect
from rim_camera_ros.effects.candidate import Candidate, Facts, Reading, has_many_pixels, linear
from rim_camera_ros.effects.discrepancy import SPREADS, Change, DiscrepancyColumn, spread_out
from rim_camera_ros.effects.graph import POINTS, Graph, Line
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor

#: Sigma [px] up to which a halo is no stray light: the footprint of a pixel and crosstalk to its neighbours
#: are so wide. Halos between lens and chip are wider.
_LEAST_SPREAD = 2.0
#: Share of the light that is spread below which one of its halos does not count.
_LEAST_WEIGHT = 0.01


@dataclass(frozen=True)
class Kernel:
    """A Gaussian halo."""

    weight: float = quantity("-", "share of each pixel's light", minimum=0.0, below=0.95, typical=0.1)
    sigma: tuple[float, float] = quantity("px", "along row, along column", minimum=0.0, typical=30.0)


@dataclass(frozen=True)
class Ghost:
    """A shifted weak image."""

    weight: float = quantity("-", "share of each pixel's light", minimum=0.0, below=0.5, typical=0.01)
    shift: tuple[float, float] = quantity("px", "columns, rows", typical=20.0)


@dataclass(frozen=True)
class Scattering(ComplexEffect):
    """S_out = (1 - sum of weights) S + sum weight (G * S) + weight_ghost S(u - du, v - dv).

    The sum of weights includes the ghost's, so that light is neither made nor lost within the
    infinite grid. Undone exactly and without regularisation (`convolution.Spreading` says why and
    how much noise it adds). Mure-Dubois & Hügli (2007) model the SwissRanger by such sums of Gaussians.
    """

    name = "scattering"
    title = "stray light between lens, filter and chip"
    observable = "dark targets beside bright near ones, or an object that enters the view of a fixed scene"
    refuted_by = "a dark target whose distance stays when the surface around it changes from black to white"

    steady = True
    spreads = True
    needs_all_pixels = True
    shapes = frozenset({"sigma"})
    in_pixels = frozenset({"sigma", "shift"})

    kernels: tuple[Kernel, ...] = quantity("-", "sums of Gaussians", most=16)
    ghost: Ghost | None = quantity("-", "shifted image", default=None)

    def __post_init__(self) -> None:
        if not self.kernels and self.ghost is None:
            raise ValueError("give kernels or a ghost")
        if self.total_weight > 0.95:
            raise ValueError(f"the weights add up to {self.total_weight:.3g}, at most 0.95 is allowed")
        if self.ghost is not None and self.ghost.weight >= 1.0 - self.total_weight:
            raise ValueError(
                f"the ghost's weight {self.ghost.weight:.3g} must stay below that of the light in its place, "
                f"{1.0 - self.total_weight:.3g}"
            )

    @property
    def total_weight(self) -> float:
        """Share of the light that does not arrive where it belongs."""
        return sum(k.weight for k in self.kernels) + (self.ghost.weight if self.ghost else 0.0)

    @property
    def direct(self) -> float:
        return 1.0 - self.total_weight

    @property
    def margin(self) -> int:
        return 0

    def lean(self) -> Scattering:
        """Return the effect without halos that spread no light, except the last one."""
        kernels = tuple(kernel for kernel in self.kernels if kernel.weight > 0)
        if not kernels and self.ghost is None:
            kernels = self.kernels[:1]
        return self if kernels == self.kernels else replace(self, kernels=kernels)

    def operator(self, shape: tuple[int, int], dtype: Any = np.float64) -> Spreading:
        """Return the (cached) operator for one sensor size and precision."""
        return _operator(self, shape, np.dtype(dtype).name)

    def apply(self, phasor: Image, context: Context) -> Image:
        dtype = phasor.real.dtype
        return complex_image(self.operator(phasor.shape, dtype).apply(planar(phasor)))

    def invert(self, phasor: Image, context: Context) -> Image:
        dtype = phasor.real.dtype
        return complex_image(self.operator(phasor.shape, dtype).solve(planar(phasor)))

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        height, width = phasor.shape
        image = planar(phasor)
        result: dict[str, Image] = {}

        def along_columns(down: Image) -> Image:
            return (down @ image.reshape(height, 2 * width)).reshape(2 * height, width)

        def along_rows(rows: Image, across: Image) -> Image:
            return complex_image((rows @ across).reshape(height, 2, width))

        for i, kernel in enumerate(self.kernels):
            across = gaussian_matrix(width, kernel.sigma[0])
            rows = along_columns(gaussian_matrix(height, kernel.sigma[1]))
            wider = kernel.weight * gaussian_matrix_by_sigma(width, kernel.sigma[0])
            higher = kernel.weight * gaussian_matrix_by_sigma(height, kernel.sigma[1])
            result[f"kernels.{i}.weight"] = along_rows(rows, across) - phasor
            result[f"kernels.{i}.sigma.0"] = along_rows(rows, wider)
            result[f"kernels.{i}.sigma.1"] = along_rows(along_columns(higher), across)
        if self.ghost is not None:
            du, dv = self.ghost.shift
            moved = shift(phasor, columns=du, rows=dv)
            result["ghost.weight"] = moved - phasor
            result["ghost.shift.0"] = self.ghost.weight * (
                shift(phasor, columns=np.floor(du) + 1, rows=dv)
                - shift(phasor, columns=np.floor(du), rows=dv)
            )
            result["ghost.shift.1"] = self.ghost.weight * (
                shift(phasor, columns=du, rows=np.floor(dv) + 1)
                - shift(phasor, columns=du, rows=np.floor(dv))
            )
        return result

    def sentence(self) -> str:
        parts = [
            f"{k.weight:.2%} of each pixel's light is spread over about {np.mean(k.sigma):.3g} pixels"
            for k in self.kernels
        ]
        if self.ghost is not None:
            parts.append(
                f"{self.ghost.weight:.2%} forms a ghost shifted by {self.ghost.shift[0]:.3g}, "
                f"{self.ghost.shift[1]:.3g} pixels"
            )
        return "stray light: " + "; ".join(parts) + "; dark targets are pulled towards bright surfaces"

    def priors(self) -> dict[str, float]:
        result = {}
        for i, kernel in enumerate(self.kernels):
            result[f"kernels.{i}.weight"] = max(kernel.weight, 0.01)
            result[f"kernels.{i}.sigma.0"] = max(0.5 * kernel.sigma[0], 0.3)
            result[f"kernels.{i}.sigma.1"] = max(0.5 * kernel.sigma[1], 0.3)
        if self.ghost is not None:
            result["ghost.weight"] = max(self.ghost.weight, 0.003)
        return result

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        width = camera.sensor.width
        sizes = [max(width * share, 1.0) for share in (0.02, 0.045, 0.1, 0.2, 0.4, 0.9)]
        single = {"kernels.0.weight": 0.05}
        many = has_many_pixels(camera)
        found = [
            linear(cls(kernels=(Kernel(0.0, (s, s)),)), single, f"{s:.3g} px")
            for s in (sizes[::2] if many else sizes)
        ]
        pairs = ((sizes[1], sizes[4]), (sizes[2], sizes[5]), (sizes[0], sizes[3]))
        for narrow, wide in () if many else pairs:
            base = cls(kernels=(Kernel(0.0, (narrow, narrow)), Kernel(0.0, (wide, wide))))
            found.append(linear(base, single | {"kernels.1.weight": 0.05}, f"{narrow:.3g}+{wide:.3g} px"))
        return found

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        yield from super().discrepancy(change)
        yield from spread_out(change)
        yield from self._mirrored(change.reading)

    def _mirrored(self, reading: Reading) -> Iterator[DiscrepancyColumn]:
        """Yield the effect of light that is mirrored through the optical axis onto the chip, a blurred ghost.

        It is light that the chip reflects, and that comes back from surfaces of the lens (Hullin et al. 2011,
        Physically-based real-time lens flare rendering).
        """
        from scipy.ndimage import gaussian_filter

        context = reading.context
        light = reading.before_effect(self.name)
        before = to_phasor(light.distance, light.amplitude, context.ambiguity)
        after = self.apply(before, context)
        seen = np.abs(after) > 0
        optics = context.camera.optics
        mirrored = shift(
            np.ascontiguousarray(before[::-1, ::-1]),
            columns=2 * optics.cx - (before.shape[1] - 1),
            rows=2 * optics.cy - (before.shape[0] - 1),
        )
        for share in SPREADS[:2]:
            ghost = gaussian_filter(mirrored, share * before.shape[1], mode="constant")
            relative = np.divide(ghost - before, after, out=np.zeros_like(after), where=seen)
            yield reading.light_change(self.name, relative)

    @property
    def limit(self) -> str | None:
        """Light that crosses to the neighbours alone is two surfaces in a pixel."""
        least = _LEAST_WEIGHT * sum(kernel.weight for kernel in self.kernels)
        sigmas = [max(kernel.sigma) for kernel in self.kernels if kernel.weight >= least]
        narrow = self.ghost is None and max(sigmas, default=np.inf) <= _LEAST_SPREAD
        return MixedPixels.name if narrow else None

    def graph(self, camera: Camera) -> Graph:
        """The share of the light that falls within a radius."""
        reach = 2.5 * max(max(kernel.sigma) for kernel in self.kernels)
        x = np.geomspace(0.5, max(reach, 2.0), POINTS)

        def value(scattering: Scattering) -> Image:
            parts = [
                k.weight * (1 - np.exp(-0.5 * x**2 / max(k.sigma[0] * k.sigma[1], 1e-9)))
                for k in scattering.kernels
            ]
            return 100.0 * np.asarray(sum(parts))

        line = Line(x, value)
        return Graph("stray light within a radius", "radius [px]", "of the light [%]", (line,), log=True)

    @classmethod
    def example(cls, camera: Camera) -> Scattering:
        width = camera.sensor.width
        return cls(
            kernels=(Kernel(0.08, (width / 12, width / 15)), Kernel(0.05, (width / 4, width / 3))),
            ghost=Ghost(0.004, (width / 20 + 0.3, -width / 30)),
        )


@lru_cache(maxsize=32)
def _operator(effect: Scattering, shape: tuple[int, int], dtype: str) -> Spreading:
    ghost = effect.ghost
    return Spreading(
        shape,
        [(k.weight, k.sigma[0], k.sigma[1]) for k in effect.kernels],
        None if ghost is None else (ghost.weight, ghost.shift[0], ghost.shift[1]),
        dtype=dtype,
    )
