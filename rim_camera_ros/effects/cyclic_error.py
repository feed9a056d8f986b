"""Odd harmonics of the modulation (Kahlmann 2007, secs. 2.1.2.2, 3.3.8, figs. 3.45-3.51)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.candidate import Candidate, Coefficients, Facts, effect_block, with_effect
from rim_camera_ros.effects.discrepancy import DIRECTIONS, Change, DiscrepancyColumn
from rim_camera_ros.effects.graph import Graph, over_distance
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import cosine_and_sine


@dataclass(frozen=True)
class Harmonic:
    """One sinusoid over the ambiguity range."""

    order: int = quantity("-", "periods per ambiguity range", minimum=1, maximum=64)
    amplitude: float = quantity("m", "of the distance error", typical=0.02)
    phase: float = quantity("rad", "at distance 0 and the principal point", typical=3.0)


@dataclass(frozen=True)
class CyclicError(DistanceTerm):
    """+ amplitude * sin(order * 2 pi d / L + phase + gradient . (u - cx, v - cy)).

    The third harmonic of the waveform makes order 4, the seventh order 8; even harmonics make
    nothing (sec. 2.1.2.2). The phase changes over the array (fig. 3.51; that it does so linearly is
    a description, not a claim of the thesis).
    """

    name = "cyclic_error"
    title = "odd harmonics of the modulation"
    observable = "distances over at least half the ambiguity range, at steps well below L / 16"
    refuted_by = "residuals over distance without a period of L / 4 or L / 8"
    pointwise = True
    demodulates = True

    drawn_over = ("distance",)
    has_discrepancy = True
    has_phase = True
    per_pixel = frozenset({"gradient"})

    harmonics: tuple[Harmonic, ...] = quantity("-", "sinusoids", most=16)
    gradient: tuple[float, float] = quantity(
        "rad/px", "phase per column, per row", default=(0.0, 0.0), typical=0.003
    )

    def __post_init__(self) -> None:
        if not self.harmonics:
            raise ValueError("harmonics is empty: give at least one")
        orders = [h.order for h in self.harmonics]
        if len(set(orders)) != len(orders):
            raise ValueError("harmonics: an order is given twice")

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"distance", "pixel"} if any(self.gradient) else {"distance"})

    def phase_shift(self, context: Context) -> Image | float:
        """Return the phase in rad that the gradient adds to every harmonic, (H, W), or 0."""
        if not any(self.gradient):
            return 0.0
        optics = context.camera.optics
        return self.gradient[0] * (context.column - optics.cx) + self.gradient[1] * (context.row - optics.cy)

    def shifted(self, phase: float) -> CyclicError:
        """Return the term with a phase [rad] added to every harmonic and no gradient over the array."""
        return CyclicError(harmonics=tuple(replace(h, phase=h.phase + phase) for h in self.harmonics))

    def _angles(self, distance: Image, context: Context) -> list[Image]:
        shift = self.phase_shift(context)
        wave = 2 * np.pi / context.ambiguity
        return [h.order * wave * distance + h.phase + shift for h in self.harmonics]

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        total: Image | float = 0.0
        for harmonic, angle in zip(self.harmonics, self._angles(distance, context), strict=True):
            total = total + harmonic.amplitude * cosine_and_sine(np.asarray(angle))[1]
        return total

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        optics = context.camera.optics
        result: dict[str, Column] = {}
        slope: Image | float = 0.0
        for i, (h, angle) in enumerate(
            zip(self.harmonics, self._angles(signal.distance, context), strict=True)
        ):
            by_phase = h.amplitude * np.cos(angle)
            result[f"harmonics.{i}.amplitude"] = (np.sin(angle), 0.0)
            result[f"harmonics.{i}.phase"] = (by_phase, 0.0)
            slope = slope + by_phase
        result["gradient.0"] = (slope * (context.column - optics.cx), 0.0)
        result["gradient.1"] = (slope * (context.row - optics.cy), 0.0)
        return result

    def sentence(self) -> str:
        parts = [f"±{abs(h.amplitude) * 1e3:.2g} mm with {h.order} periods" for h in self.harmonics]
        return (
            "cyclic error: odd harmonics of the modulation bend the distance by "
            + " and ".join(parts)
            + " over the ambiguity range"
        )

    def priors(self) -> dict[str, float]:
        result: dict[str, float] = {}
        for i, harmonic in enumerate(self.harmonics):
            result[f"harmonics.{i}.amplitude"] = max(abs(harmonic.amplitude), 0.005)
            result[f"harmonics.{i}.phase"] = 1.0  # a fit uses the prior of the phasor (`steps.of_phasors`)
        return result | {"gradient.0": 0.005, "gradient.1": 0.005}

    @classmethod
    def longest_step(cls, path: str, shape: tuple[int, int]) -> float:
        """The phase changes by a radian from rim to rim at most."""
        return {"gradient.0": 1.0 / shape[1], "gradient.1": 1.0 / shape[0]}.get(path, np.inf)

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [_variant(orders) for orders in ((4,), (4, 8), (4, 8, 12), (8,), (2,), (1,))]

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        """Phase and size may change over the array in other ways than linearly."""
        columns = change.reading.columns(self)
        waves = [column for path, (column, _) in columns.items() if path.endswith(".phase")]
        for wave in (change.distance, *waves):
            for factor in change.factors[:DIRECTIONS]:
                yield wave * factor, None

    def graph(self, camera: Camera) -> Graph:
        return replace(over_distance(self, camera), title="cyclic error")

    @classmethod
    def example(cls, camera: Camera) -> CyclicError:
        return cls(harmonics=(Harmonic(4, 0.017, -1.3), Harmonic(8, 0.0025, 0.6)), gradient=(0.0021, -0.0013))


def _variant(orders: tuple[int, ...]) -> Candidate:
    """Sine and cosine of each order, in which a sinusoid is linear."""
    base = CyclicError(harmonics=tuple(Harmonic(order, 1.0, 0.0) for order in orders))
    priors: dict[str, float] = {}
    for i in range(len(orders)):
        priors |= {f"harmonics.{i}.amplitude": 0.02, f"harmonics.{i}.phase": 0.02}
    variant = "+".join(str(order) for order in orders)
    block = effect_block(base, priors, label=f"@{variant}")
    names = [regressor.label for regressor in block.regressors]

    def build(camera: Camera, values: Coefficients) -> Camera:
        harmonics = []
        for i, order in enumerate(orders):
            sine, cosine = values[names[2 * i]], values[names[2 * i + 1]]
            size, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
            harmonics.append(Harmonic(order, max(size, 1e-5), phase))
        return with_effect(camera, CyclicError(harmonics=tuple(harmonics)))

    return Candidate(CyclicError.name, variant, block, build)
