"""Differences of another recording of the same stations, such as a simulation, from the predictions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.scene import Scene

Array = NDArray[Any]


@dataclass(frozen=True)
class Shift:
    """Differences (H, W) of another recording of a station from its predictions: ``distance`` [m] and
    ``amplitude`` [counts], with the variances of its noise.
    """

    distance: Array
    amplitude: Array
    distance_variance: Array
    amplitude_variance: Array

    def apply(self, predicted: Prediction) -> None:
        """Subtract the other recording's differences from residuals, and add the variances of its noise."""
        predicted.residual = predicted.residual - self.distance
        predicted.amplitude_residual = predicted.amplitude_residual - self.amplitude
        predicted.variance_of_other = self.distance_variance
        predicted.sigma = np.sqrt(predicted.sigma**2 + self.distance_variance)
        predicted.amplitude_sigma = np.sqrt(predicted.amplitude_sigma**2 + self.amplitude_variance)
        predicted.amplitude_noise = np.sqrt(predicted.amplitude_noise**2 + self.amplitude_variance)


def shifts_between(dataset: Dataset, other: Dataset, scene: Scene, camera: Camera) -> list[Shift]:
    """Return the differences of another recording of a dataset's stations from the predictions of a camera.

    Raises `InputError` where it does not have the same stations.
    """
    if len(other.stations) != len(dataset.stations):
        raise InputError(
            f"holds {len(other.stations)} stations, the recording {len(dataset.stations)}",
            file=other.files[0] if other.files else None,
            remedy="simulate it with --poses BAG of the recording",
        )
    result = []
    predictions = Forward(other, scene, camera).predictions(slopes=False)
    for prediction, mine in zip(predictions, dataset.stations, strict=True):
        if any(prediction.station.truth[name] != mine.truth[name] for name in scene.needs_truth):
            raise InputError(
                f"its station at {prediction.station.time:.3f} s has other poses than the recording's",
                file=other.files[0] if other.files else None,
                remedy="simulate it with --poses BAG of the recording",
            )
        result.append(
            Shift(
                np.where(prediction.station.count > 0, prediction.residual, np.nan),
                prediction.amplitude_residual,
                prediction.sigma**2,
                prediction.amplitude_sigma**2,
            )
        )
    return result
