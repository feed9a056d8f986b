"""Mixed pixels as candidates: a blur of what the pixels' centres see, or the footprint of a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from rim_camera_ros.calibrate.blocks import Block, Regressor
from rim_camera_ros.calibrate.candidate import Candidate, Coefficients, added
from rim_camera_ros.calibrate.prediction import Column, Prediction
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.footprint import COARSE, FINE, Cells
from rim_camera_ros.phasor import to_phasor

Array = NDArray[Any]

#: Share of its light that a pixel gathers from its footprint at least, where a fit begins.
_LEAST_SHARE = 0.001
#: How the variants begin that gather the light of a footprint.
_FOOTPRINT = "footprint"


def blurred(blur: float) -> Candidate:
    """The change that a blur makes, scaled by a coefficient of prior 1 (its square root scales the blur)."""
    effect = MixedPixels(blur=blur)
    label = f"effects.mixed_pixels.blur@{blur:g} px"

    def columns(prediction: Prediction) -> list[Column]:
        signal = prediction.before_effect(effect.name)
        phasor = to_phasor(signal.distance, signal.amplitude, prediction.context.ambiguity)
        blurred = effect.apply(phasor, prediction.context)
        with np.errstate(divide="ignore", invalid="ignore"):
            return [_mixing(prediction, np.where(phasor == 0, 0, blurred / phasor))]

    def build(camera: Camera, values: Coefficients) -> Camera:
        share = float(np.clip(values[label], 1e-6, 4.0))
        return added(camera, MixedPixels(blur=_blur_of_variance(share * _variance_of_blur(blur))))

    block = Block((Regressor(label, effect.name, 1.0),), columns)
    return Candidate("mixed_pixels", f"{blur:g} px", block, build, positive=(label,))


def footprints(*, at_first_sight: bool = False) -> list[Candidate]:
    """Return the variants of mixed pixels where sharp optics let edges cross some pixels and miss others.

    They show in the very pixels that an edge crosses alone. ``at_first_sight`` fewer rays sample the scene.
    """
    sides = (0.3, 0.6) if at_first_sight else (0.3, 0.6, 1.0)
    return [_gathered(side, COARSE if at_first_sight else FINE) for side in sides]


def footprint_of(candidate: Candidate) -> float | None:
    """Return the side [px] of a variant of mixed pixels that is one of `footprints`, else None."""
    if candidate.effect != "mixed_pixels" or not candidate.variant.startswith(_FOOTPRINT):
        return None
    return float(candidate.variant.split()[1])


def _gathered(side: float, cells: Cells) -> Candidate:
    """The change that a footprint makes, scaled by a coefficient of prior 1."""
    label = f"effects.mixed_pixels.footprint@{side:g} px"

    def columns(prediction: Prediction) -> list[Column]:
        context = prediction.context
        assert context.footprint is not None
        return [_mixing(prediction, context.footprint(cells).ratio(side))]

    def build(camera: Camera, values: Coefficients) -> Camera:
        share = float(np.clip(values[label], _LEAST_SHARE, 1.0))
        return added(camera, MixedPixels(blur=0.0, footprint=side, share=share))

    block = Block((Regressor(label, "mixed_pixels", 1.0),), columns)
    return Candidate("mixed_pixels", f"{_FOOTPRINT} {side:g} px", block, build, positive=(label,))


def _mixing(prediction: Prediction, relative: Array) -> Column:
    """Return the column of a change of the light to some ratio (H, W) complex of what it was."""
    # large changes turn the phase by angles, not by ratios
    change = np.where(relative == 0, 0, np.log(np.where(relative == 0, 1, relative)))
    return prediction.light_change("mixed_pixels", change)


def _variance_of_blur(blur: float) -> float:
    """Return the variance [px^2] of the sampled Gaussian, which for narrow ones is below blur^2."""
    k = np.arange(-40, 41)
    kernel = np.exp(-0.5 * (k / blur) ** 2)
    return float(np.sum(kernel * k**2) / np.sum(kernel))


def _blur_of_variance(variance: float) -> float:
    return float(brentq(lambda blur: _variance_of_blur(blur) - variance, 0.12, 10.0, xtol=1e-4))
