"""How far effects move distances, and how much light they change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OF_SURFACES, OPTICS
from rim_camera_ros.effects.base import DistanceTerm, ResponseEffect
from rim_camera_ros.effects.candidate import Column
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.parameters import flatten

Array = NDArray[Any]

#: Metres of distance that count as much as a relative change of the amplitude of 1.
SAME_SIZE = 0.1


def effect_size(fitted: Fit, names: Sequence[str], start: Camera) -> float:
    """Return how far effects move distances [m], or 0.1 m times relative amplitudes where these change more.

    RMS over the 5 % of pixel values that they move most, after the fit of all other parameters.
    """
    parts = []
    for prediction in fitted.forward.predictions():
        total: Any = 0.0
        for name in names:
            total = total + contribution(prediction, name, start)
            effect = prediction.context.camera.effects.get(name)
            if effect is not None and effect.at_edges:
                # on a single surface the edges of its texture show the effect in the amplitudes alone
                total = np.maximum(np.abs(total), SAME_SIZE * np.abs(_relative_light(prediction, name)[0]))
        parts.append(np.abs(np.broadcast_to(total, prediction.used.shape)[prediction.used]))
    values = np.concatenate(parts) if parts else np.zeros(1)
    if not values.size:
        return 0.0
    top = values[values >= np.quantile(values, 0.95)]
    return float(np.sqrt(np.mean(top**2)))


def contribution(prediction: Prediction, name: str, start: Camera) -> Array:
    """Return what an effect of the camera does to the measured distance [m] of a station, (H, W).

    For an effect on the light: the difference to a prediction without it, or 0.1 m times the relative change
    of amplitudes where it only changes these. For the optics: the difference to those of ``start``.
    """
    camera = prediction.context.camera
    if name in OF_SURFACES:
        return np.asarray(SAME_SIZE * _of_surfaces(prediction))
    if name in OPTICS:
        return _geometry_contribution(prediction, name, start)
    effect = camera.effects[name]
    if isinstance(effect, DistanceTerm):
        return change_by(prediction, name)[0]
    if isinstance(effect, ResponseEffect):
        return np.asarray(SAME_SIZE * (1 - prediction.model_reading / prediction.model_amplitude))
    relative, by_distance = _relative_light(prediction, name)
    moved, _ = prediction.reading_change(by_distance, relative)
    if effect.shows_in == "amplitude":
        return np.asarray(np.nan_to_num(np.maximum(np.abs(moved), SAME_SIZE * np.abs(relative))))
    return np.asarray(np.nan_to_num(moved))


def moved_by_light(prediction: Prediction, name: str) -> Array:
    """Return how far distances [m] move as an effect on the light, or surfaces, change the amplitude."""
    if name in OF_SURFACES:
        relative, by_distance = _of_surfaces(prediction), np.zeros(1)
    else:
        relative, by_distance = _relative_light(prediction, name)
    return np.asarray(np.nan_to_num(prediction.reading_change(by_distance, relative)[0]))


def _of_surfaces(prediction: Prediction) -> Array:
    """Return the change of log amplitude by surfaces unlike Lambert's."""
    curves = prediction.light_curves
    if curves is None:
        return np.zeros(prediction.used.shape)
    return np.asarray(np.log(curves.surfaces(prediction.view.geometry)))


def change_by(prediction: Prediction, name: str) -> Column:
    """Return what an effect of the camera does to measured distance [m] and published amplitude [counts]."""
    effect = prediction.context.camera.effects[name]
    shape = prediction.distance.shape
    if isinstance(effect, DistanceTerm):
        value = effect.term(prediction.delivered.distance, prediction.amplitude, prediction.context)
        return np.broadcast_to(np.asarray(value, float), shape), None
    if isinstance(effect, ResponseEffect):
        numbers, columns = flatten(effect), prediction.columns(effect)
        return np.zeros(shape), sum((columns[path][1] * numbers[path] for path in columns), np.zeros(shape))
    relative, by_distance = _relative_light(prediction, name)
    turned = 2 * np.pi / prediction.context.ambiguity * by_distance
    return prediction.light_change(name, relative + 1j * turned)


def _relative_light(prediction: Prediction, name: str) -> tuple[Array, Array]:
    """Return the changes of log amplitude and of the distance [m] by an effect on the light."""
    before = prediction.before_effect(name)
    after = prediction.context.camera.effects[name].simulate(before, prediction.context)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(before.amplitude > 0, np.log(after.amplitude / before.amplitude), 0.0)
    return np.nan_to_num(relative), np.nan_to_num(after.distance - before.distance)


def _geometry_contribution(prediction: Prediction, name: str, start: Camera) -> Array:
    block = OPTICS[name].block(prediction.context.camera)
    before, after = flatten(start.optics), flatten(prediction.context.camera.optics)
    total = np.zeros(prediction.used.shape)
    for regressor, (column, _) in zip(block.regressors, block.columns(prediction), strict=True):
        path = regressor.label.removeprefix("optics.")
        total = total + (after[path] - before[path]) * column
    return total
