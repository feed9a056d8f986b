"""Other readings of a recording: what a driver may have done to its distances and amplitudes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import Change, Files
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.scene import Scene

Array = NDArray[Any]


def to_distances(change: Callable[[Array, Array], Array]) -> Change:
    """Return a change of files by a function of the distances (H, W) [m] and the rays (H, W, 3)."""

    def changed(dataset: Dataset, scene: Scene, camera: Camera) -> Files:
        stations = [
            replace(station, distance=change(station.distance, camera.rays)) for station in dataset.stations
        ]
        return replace(dataset, stations=stations), scene, camera

    return changed


def times(distance: Array, rays: Array, *, factor: float) -> Array:
    """Return distances (H, W) [m] in other units, whatever the rays."""
    return distance * factor


def along_the_ray(distance: Array, rays: Array) -> Array:
    """Return the distances (H, W) [m] along rays (H, W, 3) of those along the optical axis."""
    return np.asarray(distance / rays[..., 2])


def to_amplitudes(factor_of: Callable[[Station], Array]) -> Change:
    """Return a change of files by factors on amplitudes (H, W), whose level is that of the scene."""

    def changed(dataset: Dataset, scene: Scene, camera: Camera) -> Files:
        factors = [factor_of(station) for station in dataset.stations]
        ratios = [np.zeros(0)]
        predictions = Forward(dataset, scene, camera).predictions(AmplitudeModel(), slopes=False)
        for prediction, factor in zip(predictions, factors, strict=True):
            ratio = prediction.station.amplitude * factor / prediction.model_reading
            ratios.append(ratio[prediction.used & (ratio > 0)])
        every = np.concatenate(ratios)
        level = float(np.median(every)) if every.size else 1.0
        stations = [
            replace(
                station,
                amplitude=station.amplitude * (factor / level),
                amplitude_variance=station.amplitude_variance * (factor / level) ** 2,
            )
            for station, factor in zip(dataset.stations, factors, strict=True)
        ]
        return replace(dataset, stations=stations), scene, camera

    return changed


def falloff(station: Station) -> Array:
    """Return the falloff (H, W) of the light with the measured distance [1/m^2], 0 where there is none."""
    far = np.where(station.distance > 0, station.distance, np.inf)
    return np.asarray(far**-2.0)
