"""Residuals without what is known of errors of poses, powers and pixels; their weights and their excess."""

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
    """Return what the loss of Huber (1964) has beyond squares that are weighted by factors, in their units.

    With it the weighted squares are an upper bound of the loss, which touches it where the weights come from:
    objectives by the weights of two points can be compared.
    """
    return float(np.sum(ROBUST_LIMIT**2 * (1.0 / factors - 1.0)))


def amplitude_error(forward: Forward, nuisances: Mapping[str, float]) -> float:
    """Return the relative 1-sigma of predicted amplitudes beyond noise and errors of poses (robustly)."""
    pattern = np.zeros(forward.camera.shape)

    def sharpest(one: Prediction) -> tuple[Array, Array]:
        pixels = one.amplitude_used
        if not pixels.any():
            return np.zeros(0), np.zeros(0)
        _, amplitude = after_nuisances(one, pattern, nuisances)
        reading = one.station.amplitude[pixels] - one.amplitude_residual[pixels]
        relative = np.maximum((one.amplitude_noise[pixels] / reading) ** 2, 1e-12)
        sharp = relative <= np.quantile(relative, 0.5)
        return (amplitude[pixels] / reading)[sharp], relative[sharp]

    found = list(in_order(sharpest, forward.predictions(slopes=False), threads=forward.threads))
    if not found:
        return AMPLITUDE_MODEL
    deviations, variances = (np.concatenate(part) for part in zip(*found, strict=True))
    return max(AMPLITUDE_MODEL, excess(deviations, variances) if deviations.size else 0.0)


def after_nuisances(
    prediction: Prediction, pattern: Array, nuisances: Mapping[str, float]
) -> tuple[Array, Array]:
    """Return the residuals of distance [m] and amplitude [counts] without pattern, pose and power errors."""
    station = prediction.station
    key = f"{station.recording}.{station.pose}"
    distance = prediction.residual - pattern
    amplitude = prediction.amplitude_residual
    gain = nuisances.get(f"{key}.gain")
    if gain:
        by_distance, by_amplitude = prediction.gain_column()
        distance = distance - gain * by_distance
        amplitude = amplitude - gain * by_amplitude
    if f"{key}.light.real.{station.stamp}" in nuisances:
        for part, (by_distance, by_amplitude) in prediction.light_columns().items():
            light = nuisances.get(f"{key}.light.{part}.{station.stamp}", 0.0)
            distance = distance - light * by_distance
            amplitude = amplitude - light * by_amplitude
    for column in prediction.pose_columns:
        error = nuisances.get(f"{station.recording}.{station.placed}.{column.path}")
        if error:
            by_distance, by_amplitude = prediction.pose_change(column)
            distance = distance - error * by_distance
            amplitude = amplitude - error * by_amplitude
    for block in prediction.linear:
        values = [nuisances.get(one.label, 0.0) for one in block.regressors]
        if not any(values):
            continue
        for value, (by_regressor, counts) in zip(values, block.columns(prediction), strict=True):
            distance = distance - value * by_regressor
            if counts is not None:
                amplitude = amplitude - value * counts
    return distance, amplitude
