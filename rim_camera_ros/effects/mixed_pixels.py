"""Two surfaces in one pixel (Kahlmann 2007, sec. 3.3.10, fig. 3.58)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import cv2
import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import ComplexEffect, Undo
from rim_camera_ros.effects.candidate import (
    Block,
    Candidate,
    Coefficients,
    Column,
    Facts,
    Reading,
    Regressor,
    has_many_pixels,
    with_effect,
)
from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn, spread_out
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.errors import InputError
from rim_camera_ros.footprint import COARSE, FINE, Cells, FootprintLight
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor

#: Below this sigma in pixels a sampled Gaussian is one pixel, to the last digit.
_POINT = 0.02
#: Least share of its light that a pixel gathers from its footprint where a fit begins.
_LEAST_SHARE = 0.001
#: Sigmas at which the Gaussian ends.
_REACH = 8.0


@dataclass(frozen=True)
class MixedPixels(ComplexEffect):
    """Gaussian blur of the complex image; at the sensor's edge the image is continued by reflection.

    A blur of the light at the centres of pixels gives each pixel beside an edge the same share of the other
    surface. With sharp optics, pixels that the edge crosses see up to a half of it, and their neighbours
    none: a pixel gathers the light of its ``footprint``, a square about its centre, before any blur. This
    requires the simulation of a scene. Pixels whose centre sees nothing stay dark.
    """

    name = "mixed_pixels"
    title = "two surfaces in one pixel"
    observable = "a distance step in view, at several places relative to the pixels"
    refuted_by = "edges at which no pixel lies between the two surfaces"
    undo: ClassVar[Undo] = "none"

    steady = True
    spreads = True
    at_edges = True
    needs_all_pixels = True
    discrepancy_is_determined = False
    shapes = frozenset({"blur"})
    in_pixels = frozenset({"blur", "footprint"})

    blur: float = quantity("px", "sigma of the Gaussian", minimum=0.0, maximum=20.0, typical=0.5)
    footprint: float | None = quantity(
        "px",
        "side of the square whose light a pixel gathers, where that is distinguished from a blur",
        default=None,
        minimum=0.0,
        maximum=FINE.widest,
        typical=0.8,
    )
    share: float | None = quantity(
        "-",
        "part of a pixel's light that it gathers from the footprint, the rest from its centre",
        default=None,
        minimum=0.0,
        maximum=1.0,
        typical=0.2,
    )

    def __post_init__(self) -> None:
        if self.share is not None and self.footprint is None:
            raise ValueError("share is the part of a footprint: give footprint as well")

    def apply(self, phasor: Image, context: Context) -> Image:
        if self.footprint is not None:
            ratio = context.inside(_light_around(context).ratio(self.footprint))
            phasor = phasor * self._gathered(ratio)
        return self._blurred(phasor)

    @property
    def margin(self) -> int:
        return 0 if self.blur < _POINT else len(_gaussian(self.blur)[1]) // 2

    def _gathered(self, ratio: Image) -> Image:
        return ratio if self.share is None else 1.0 + self.share * (ratio - 1.0)

    def _blurred(self, phasor: Image) -> Image:
        if self.blur < _POINT:
            return phasor
        kernel = _gaussian(self.blur)[1]
        return _filtered(phasor, kernel, kernel)

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        """By the heat equation, of the sampled kernel: d/d sigma of exp(-k^2 / 2 sigma^2) / sum."""
        if self.footprint is None:
            return {"blur": self._blur_column(phasor)}
        light = _light_around(context)
        found = light.ratio(self.footprint), light.ratio_column(self.footprint)
        ratio, wider = (context.inside(image) for image in found)
        share = 1.0 if self.share is None else self.share
        columns = {
            "blur": self._blur_column(phasor * self._gathered(ratio)),
            "footprint": self._blurred(phasor * (share * wider)),
        }
        if self.share is not None:
            columns["share"] = self._blurred(phasor * (ratio - 1.0))
        return columns

    def _blur_column(self, phasor: Image) -> Image:
        if self.blur < _POINT:
            return np.zeros_like(phasor)
        k, kernel = _gaussian(self.blur)
        slope = kernel * (k**2 - (kernel * k**2).sum()) / self.blur**3
        return _filtered(phasor, slope, kernel) + _filtered(phasor, kernel, slope)

    def sentence(self) -> str:
        if self.footprint is not None:
            part = "" if self.share is None else f"{100 * self.share:.2g} % of "
            blurred = "" if self.blur < _POINT else f", blurred over {self.blur:.2g} px (sigma)"
            return (
                f"mixed pixels: each pixel gathers {part}its light from a square of {self.footprint:.2g} px"
                f"{blurred}; those that an edge crosses measure a distance between the two surfaces"
            )
        return (
            f"mixed pixels: the light of each point is blurred over {self.blur:.2g} px (sigma); "
            "pixels at edges measure a distance between the two surfaces"
        )

    def finest(self) -> MixedPixels:
        """Return a form of the same width that includes the area of a pixel.

        Light at the centres of pixels locates an edge to half a pixel, light over their areas exactly.
        """
        if self.footprint is not None:
            return self
        side = min(1.0, self.blur * 12**0.5)
        return MixedPixels(blur=max(self.blur**2 - side**2 / 12, 0.0) ** 0.5, footprint=side)

    def priors(self) -> dict[str, float]:
        if self.footprint is not None and self.blur == 0.0:
            return {"footprint": 0.3} if self.share is None else {"footprint": 0.3, "share": 0.3}
        return super().priors()

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        few, all_ = (0.5, 1.0), (0.25, 0.35, 0.5, 0.65, 0.8, 1.0, 1.3, 1.7)
        return [_blurred(blur) for blur in (few if has_many_pixels(camera) else all_)]

    @classmethod
    def edge_candidates(cls, *, at_first_sight: bool = False) -> list[Candidate]:
        """Variants where sharp optics let edges cross some pixels and miss others."""
        sides = (0.3, 0.6) if at_first_sight else (0.3, 0.6, 1.0)
        return [_gathered(side, COARSE if at_first_sight else FINE) for side in sides]

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        yield from super().discrepancy(change)
        yield from spread_out(change)

    @classmethod
    def example(cls, camera: Camera) -> MixedPixels:
        return cls(blur=0.4)


@lru_cache(maxsize=64)
def _gaussian(sigma: float) -> tuple[Image, Image]:
    """Return whole numbers of pixels, and the weights there of a Gaussian of sum 1."""
    reach = int(_REACH * sigma + 0.5)
    k = np.arange(-reach, reach + 1, dtype=float)
    weights = np.exp(-0.5 * (k / sigma) ** 2)
    return k, weights / weights.sum()


def _filtered(phasor: Image, rows: Image, columns: Image) -> Image:
    """Return a complex image (H, W) filtered along columns by ``rows`` and along rows by ``columns``."""
    planes = np.ascontiguousarray(phasor).view(phasor.real.dtype).reshape(*phasor.shape, 2)
    filtered = cv2.sepFilter2D(planes, -1, columns, rows, borderType=cv2.BORDER_REFLECT)
    return np.asarray(filtered.reshape(len(phasor), -1).view(phasor.dtype))


def _light_around(context: Context) -> FootprintLight:
    if context.footprint is None:
        raise InputError("mixed_pixels.footprint needs the scene's geometry", remedy="simulate a scene file")
    return context.footprint(FINE)


def _blurred(blur: float) -> Candidate:
    """The change by a blur, scaled by a coefficient of prior 1 (its square root scales the blur)."""
    effect = MixedPixels(blur=blur)
    label = f"effects.{effect.name}.blur@{blur:g} px"

    def columns(reading: Reading) -> list[Column]:
        signal = reading.before_effect(effect.name)
        phasor = to_phasor(signal.distance, signal.amplitude, reading.context.ambiguity)
        blurred = effect.apply(phasor, reading.context)
        with np.errstate(divide="ignore", invalid="ignore"):
            return [_mixing(reading, np.where(phasor == 0, 0, blurred / phasor))]

    def build(camera: Camera, values: Coefficients) -> Camera:
        share = float(np.clip(values[label], 1e-6, 4.0))
        return with_effect(camera, MixedPixels(blur=_blur_of_variance(share * _variance_of_blur(blur))))

    block = Block((Regressor(label, effect.name, 1.0),), columns)
    return Candidate(effect.name, f"{blur:g} px", block, build, positive=(label,))


def _gathered(side: float, cells: Cells) -> Candidate:
    """The change by a footprint, scaled by a coefficient of prior 1."""
    name = MixedPixels.name
    label = f"effects.{name}.footprint@{side:g} px"

    def columns(reading: Reading) -> list[Column]:
        assert reading.context.footprint is not None
        return [_mixing(reading, reading.context.footprint(cells).ratio(side))]

    def build(camera: Camera, values: Coefficients) -> Camera:
        share = float(np.clip(values[label], _LEAST_SHARE, 1.0))
        return with_effect(camera, MixedPixels(blur=0.0, footprint=side, share=share))

    block = Block((Regressor(label, name, 1.0),), columns)
    return Candidate(name, f"footprint {side:g} px", block, build, positive=(label,), footprint=side)


def _mixing(reading: Reading, relative: Image) -> Column:
    """Return the column of a change of the light by a complex ratio (H, W)."""
    # large changes turn the phase by angles, not by ratios
    change = np.where(relative == 0, 0, np.log(np.where(relative == 0, 1, relative)))
    return reading.light_change(MixedPixels.name, change)


def _variance_of_blur(blur: float) -> float:
    """Return the variance [px^2] of the sampled Gaussian, which for narrow ones is below blur^2."""
    k = np.arange(-40, 41)
    kernel = np.exp(-0.5 * (k / blur) ** 2)
    return float(np.sum(kernel * k**2) / np.sum(kernel))


def _blur_of_variance(variance: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(lambda blur: _variance_of_blur(blur) - variance, 0.12, 10.0, xtol=1e-4))
