"""How well amplitudes are predicted: the gain of every pose, and the relative error of the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.robust import excess

Array = NDArray[Any]

#: Least relative 1-sigma of predicted amplitudes; more, by areas, flatness and dust, is estimated.
AMPLITUDE_MODEL = 0.005


@dataclass
class AmplitudeModel:
    """How well the amplitude is predicted: relative 1-sigma ``tau`` per pixel, gain of every pose.

    ``pixels`` (H, W) are the logarithms of the gains of pixels, None where they are not known.
    """

    gains: dict[tuple[int, int], float] = field(default_factory=dict)
    tau: float = 0.0
    pixels: Array | None = None


def gains_and_error(
    predictions: Iterable[Prediction],
    expanded: Callable[[Array], Array],
    *,
    gains: Mapping[tuple[int, int], float] | None,
    varies: bool,
) -> tuple[dict[tuple[int, int], float], float]:
    """Return the gain of every pose and the relative 1-sigma of predicted amplitudes (robustly).

    ``expanded`` returns the light of published amplitudes [counts]; known ``gains`` are kept. Unless the gain
    ``varies`` from pose to pose, all poses have one gain.
    """
    ratios: dict[tuple[int, int], list[Array]] = {}
    errors, variances = [], []
    for prediction in predictions:
        pixels = (
            prediction.amplitude_used & (prediction.model_amplitude > 0) & (prediction.station.amplitude > 0)
        )
        if not pixels.any():
            continue
        gain = np.broadcast_to(prediction.pixel_gain, pixels.shape)[pixels]
        measured = expanded(prediction.station.amplitude[pixels] / gain) * gain
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.log(measured / prediction.model_amplitude[pixels])
        noise = prediction.amplitude_sigma[pixels] / prediction.model_amplitude[pixels]
        # amplitudes above the range of a response stand for no finite light
        known = np.isfinite(ratio)
        if not known.any():
            continue
        ratio, noise = ratio[known], noise[known]
        sharp = noise <= np.quantile(noise, 0.5)
        key = (prediction.station.recording, prediction.station.pose)
        ratios.setdefault(key, []).append(ratio[sharp])
        errors.append((key, ratio[sharp]))
        variances.append(noise[sharp] ** 2)
    if gains is None:
        gains = {key: float(np.exp(np.median(np.concatenate(r)))) for key, r in ratios.items()}
        if not varies and gains:
            everything = np.concatenate([r for parts in ratios.values() for r in parts])
            gains = dict.fromkeys(gains, float(np.exp(np.median(everything))))
    tau = AMPLITUDE_MODEL
    if errors:
        rest = np.concatenate([r - np.log(gains.get(key, 1.0)) for key, r in errors])
        tau = max(tau, excess(rest, np.concatenate(variances)))
    return dict(gains), tau
