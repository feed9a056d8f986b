"""Residuals given the estimated errors of poses, powers and pixels; their weights and excess scatter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.amplitudes import AMPLITUDE_MODEL
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.robust import excess
from rim_camera_ros.threads import in_order

Array = NDArray[Any]

#: Residuals beyond this many sigma weigh less (Huber), the more the farther.
ROBUST_LIMIT = 4.0
#: Least number of pixels whose scatter gives the variance of their mean.
LEAST_IN_PATCH = 8


def huber(pattern: Array, nuisances: Mapping[str, float]) -> Callable[[Prediction], tuple[Array, Array]]:
    """Return the weights of robust fitting for residuals after pattern and nuisances."""

    def weigh(prediction: Prediction) -> tuple[Array, Array]:
        distance, amplitude = after_nuisances(prediction, pattern, nuisances)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(distance) / prediction.sigma
            z_a = np.abs(amplitude) / prediction.amplitude_sigma
            return (
                np.where(z > ROBUST_LIMIT, ROBUST_LIMIT / z, 1.0),
                np.where(z_a > ROBUST_LIMIT, ROBUST_LIMIT / z_a, 1.0),
            )

    return weigh


def beyond_limit(factors: Array) -> float:
    """Return the excess of the loss of Huber (1964) over squares that are weighted by factors.

    With it the weighted squares are an upper bound of the loss, and equal it where the weights were computed:
    so objectives with the weights of two points can be compared.
    """
    return float(np.sum(ROBUST_LIMIT**2 * (1.0 / factors - 1.0)))


def amplitude_error(forward: Forward, nuisances: Mapping[str, float]) -> float:
    """Return the relative 1-sigma of errors of predicted amplitudes that pixels of a patch share (robustly).

    It is the excess scatter of the means of patches over that by the pixels in them: noise and gains of
    pixels are independent errors.
    """
    pattern = np.zeros(forward.camera.shape)

    def means(predicted: Prediction) -> tuple[Array, Array]:
        pixels = predicted.amplitude_used
        if not pixels.any():
            return np.zeros(0), np.zeros(0)
        _, amplitude = after_nuisances(predicted, pattern, nuisances)
        reading = predicted.station.amplitude[pixels] - predicted.amplitude_residual[pixels]
        return _means(amplitude[pixels] / reading, forward.views.patches(predicted.view)[pixels])

    found = list(in_order(means, forward.predictions(slopes=False), threads=forward.threads))
    if not found:
        return AMPLITUDE_MODEL
    deviations, variances = (np.concatenate(part) for part in zip(*found, strict=True))
    if not deviations.size:
        return AMPLITUDE_MODEL
    sharp = variances <= np.quantile(variances, 0.5)
    return max(AMPLITUDE_MODEL, excess(deviations[sharp], variances[sharp]))


def _means(values: Array, patches: Array) -> tuple[Array, Array]:
    """Return the means of patches of enough pixels, and their variances by the scatter within them."""
    group = np.unique(patches, return_inverse=True)[1]
    count = np.bincount(group)
    mean = np.bincount(group, values) / count
    square = np.bincount(group, (values - mean[group]) ** 2)
    enough = count >= LEAST_IN_PATCH
    count = count[enough]
    return mean[enough], np.maximum(square[enough] / (count - 1) / count, 1e-12)


def after_nuisances(
    prediction: Prediction, pattern: Array, nuisances: Mapping[str, float]
) -> tuple[Array, Array]:
    """Return the residuals of distance [m] and amplitude [counts] after pattern, pose and power errors."""
    station, inner = prediction.station, prediction.inner
    key = f"{station.recording}.{station.pose}"
    distance = prediction.residual - pattern
    amplitude = np.array(prediction.amplitude_residual, float)
    window: Any = ... if inner.context.window is None else inner.context.window

    def take_off(value: float, change: tuple[Array, Array | None], at: Any) -> None:
        distance[at] -= value * change[0]
        if change[1] is not None:
            amplitude[at] -= value * change[1]

    gain = nuisances.get(f"{key}.gain")
    if gain:
        take_off(gain, inner.gain_column(), window)
    if f"{key}.light.real.{station.stamp}" in nuisances:
        for part, change in prediction.light_columns().items():
            take_off(nuisances.get(f"{key}.light.{part}.{station.stamp}", 0.0), change, ...)
    for column in inner.pose_columns:
        error = nuisances.get(f"{station.recording}.{station.placed}.{column.path}")
        if error:
            take_off(error, inner.pose_change(column), window)
    for block in prediction.linear:
        values = [nuisances.get(regressor.label, 0.0) for regressor in block.regressors]
        if any(values):
            columns = block.columns(prediction.for_columns(block))
            for value, change in zip(values, columns, strict=True):
                take_off(value, change, window if block.pointwise else ...)
    return distance, amplitude
