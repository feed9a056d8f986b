"""The residuals of stations by which values that do not see the scene are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.robust_poses import PoseErrors, robust_residuals
from rim_camera_ros.select.thresholds import FEW

Array = NDArray[Any]
Mask = NDArray[np.bool_]

#: Least number of values by which one is judged: neighbours of a pixel, poses, frames, pixels of a region.
LEAST = 4


@dataclass(frozen=True)
class Deviations:
    """Residuals of a station [m] and their ``sigma``, where ``used``, with the ``tile`` of each pixel (H, W).

    ``surface`` (H, W) is the number of the surface that a pixel sees, ``amplitude`` (H, W) are the residuals
    of the amplitudes in sigmas, where they are ``lit``.

    Where surfaces are ``described`` their tiles are known; elsewhere distances may end by steps where the
    brightness does. ``scatter`` (H, W) is the sum of squares of repeated frames about their mean, in
    variances of the noise model, of ``freedom`` (H, W). Where pixels are saturated (``saturates``) rows and
    columns may differ from others by steps.
    """

    recording: int
    stamp: int
    residual: Array
    sigma: Array
    used: Mask
    described: Mask
    tile: Array
    surface: Array
    amplitude: Array
    lit: Mask
    scatter: Array
    freedom: Array
    saturates: bool

    @cached_property
    def z(self) -> Array:
        """The residuals in sigmas."""
        return np.asarray(self.residual / self.sigma)

    @cached_property
    def is_judged(self) -> bool:
        """Whether few of the values deviate."""
        return float(np.mean(np.abs(self.z[self.used]) > BEYOND)) <= FEW if self.used.any() else False

    @classmethod
    def of(cls, prediction: Prediction, fitted: Fit) -> Deviations:
        """Return those of a prediction after its nuisances."""
        station, used = prediction.station, prediction.used
        rest, light = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        freedom = np.maximum(station.count - 1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            scatter = freedom * station.distance_variance / (prediction.sigma**2 * station.count)
        known = used & np.isfinite(scatter)
        return cls(
            recording=station.recording,
            stamp=station.stamp,
            residual=np.where(used, rest, 0.0).astype(np.float32),
            sigma=np.where(used, prediction.sigma, 1.0).astype(np.float32),
            used=used,
            described=np.array([*(surface.is_described for surface in fitted.scene.surfaces), False])[
                prediction.view.geometry.surface
            ],
            tile=prediction.view.geometry.tile,
            surface=prediction.view.geometry.surface,
            amplitude=np.where(prediction.amplitude_used, light / prediction.amplitude_sigma, 0.0).astype(
                np.float32
            ),
            lit=prediction.amplitude_used,
            scatter=np.where(known, scatter, 0.0).astype(np.float32),
            freedom=np.where(known, freedom, 0).astype(np.int32),
            saturates=bool((station.saturated > 0).any()),
        )


def robustly(stations: Sequence[Deviations], poses: Sequence[PoseErrors]) -> list[Deviations]:
    """Return the deviations after robust errors of poses and offsets of pixels."""
    residuals = robust_residuals([one.residual for one in stations], [one.sigma for one in stations], poses)
    return [replace(station, residual=rest) for station, rest in zip(stations, residuals, strict=True)]
