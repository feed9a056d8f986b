"""A calibration of a large sensor: parameters from every k-th pixel, offsets from all pixels.

Hundreds of thousands of pixels determine a dozen parameters no better than a tenth of them, because errors of
poses limit both. The fixed pattern, which each pixel has by itself, needs all pixels, but a single pass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.solution import Solution, with_pattern
from rim_camera_ros.camera import Camera, Validity
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import PixelMap
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.decimation import decimated_camera, decimated_dataset, full_camera, full_number
from rim_camera_ros.fit.design import PATTERN_FIELD, linear_blocks, pattern_field
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixels import BESIDE, WIDEST, usable_pixels
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.residuals import ROBUST_LIMIT, after_nuisances
from rim_camera_ros.geometry import beside_edges, see
from rim_camera_ros.scene import Scene

Array = NDArray[Any]


@dataclass(frozen=True)
class LargeSensor:
    """``camera`` and ``dataset`` of all pixels; every ``step``-th in both directions is fitted."""

    camera: Camera
    dataset: Dataset
    scene: Scene
    step: int
    _margins: dict[tuple[int, int], Array] = field(default_factory=dict)

    @property
    def coarse(self) -> tuple[Camera, Dataset]:
        """Camera and stations on the coarser grid."""
        return decimated_camera(self.camera, self.step), decimated_dataset(self.dataset, self.step)

    @property
    def note(self) -> str:
        """The pixels that are used, in words."""
        return (
            f"parameters are fitted to one of {self.step} x {self.step} pixels, their offsets to all; with "
            f"{PixelMap.name} among --effects everything is"
        )

    def beside_edges(self, prediction: Prediction, margin: int = BESIDE) -> Array:
        """Return which pixels (H, W) of the coarser grid are within ``margin`` [px] of edges on the full one.

        ``margin`` from `BESIDE` to `WIDEST`.
        """
        station = prediction.station
        key = (station.recording, station.stamp)
        if key not in self._margins:
            geometry = see(self.scene, self.scene.poses_for(station.truth), self.camera.rays)
            pick = slice(self.step // 2, None, self.step)
            found = np.full(prediction.distance.shape, WIDEST + 1, np.uint8)
            for number in range(WIDEST, BESIDE - 1, -1):
                found[beside_edges(geometry, number)[pick, pick]] = number
            self._margins[key] = found
        return np.asarray(self._margins[key] <= margin)

    def finished(
        self, solution: Solution, *, edges_within: int, tick: Callable[[], None] | None = None
    ) -> tuple[Camera, Array]:
        """Return the camera of all pixels with their offsets, and the offsets' variance (H, W) [m^2].

        The variance is infinite where no pose was seen. Pixels within ``edges_within`` [px] of edges are
        excluded. ``tick`` is called for each station and may raise to end the work.
        """
        fitted = solution.fit
        small = fitted.camera
        without = {name: effect for name, effect in small.effects.items() if name != PixelMap.name}
        camera = full_camera(with_effects(small, without), self.camera, self.step)
        if PixelMap.name in self.camera.effects:
            camera = with_effects(
                camera, {**camera.effects, PixelMap.name: self.camera.effects[PixelMap.name]}
            )
        forward = Forward(self.dataset, fitted.scene, camera)
        # Gains of pixels are those of the coarse grid.
        forward.amplitude_model = replace(fitted.forward.amplitude_model, pixels=None)
        forward.light_curves = fitted.forward.light_curves
        # those over the array are of the coarse grid, too
        field = any(name.startswith(PATTERN_FIELD) for name in fitted.nuisances)
        forward.linear = linear_blocks(replace(camera, covariance=None), fitted.scene, pattern_field=field)
        forward.variance_factors = fitted.forward.variance_factors
        forward.correlated_error = fitted.forward.correlated_error
        forward.tick = tick
        masks, _ = usable_pixels(forward)
        total, weight = np.zeros(camera.shape), np.zeros(camera.shape)
        none = np.zeros(camera.shape)
        for prediction, (used, _) in zip(forward.predictions(), masks, strict=True):
            if edges_within:
                used = used & ~beside_edges(prediction.view.geometry, edges_within)
            rest, _ = after_nuisances(prediction, none, fitted.nuisances)
            z = np.abs(rest[used]) / prediction.sigma[used]
            own = np.minimum(1.0, ROBUST_LIMIT / np.maximum(z, ROBUST_LIMIT)) / prediction.sigma[used] ** 2
            total[used] += own * rest[used]
            weight[used] += own
        with np.errstate(divide="ignore"):
            variance = np.where(weight > 0, solution.factor / weight, np.inf)
        offsets = total / (weight + fitted.equations.pattern_prior**-2)
        offsets += pattern_field(fitted.nuisances, camera.shape)
        return with_pattern(camera, offsets, variance), variance

    def covariance(self, paths: Sequence[str], matrix: Array) -> Array:
        """Convert a covariance of parameters from the camera of the coarser grid to the full camera."""
        scale = np.array([full_number(path, 1.0, self.step) for path in paths])
        return np.asarray(matrix * scale[:, None] * scale[None, :])

    def validity(self, coarse: Validity) -> Validity:
        """Return the ranges with the region [px] on the full grid."""
        if coarse.region is None:
            return coarse
        height, width = self.camera.shape
        u0, v0, u1, v1 = coarse.region
        # a pixel of the grid represents those around it, the last ones the rim
        last = [
            size - 1.0
            if end >= len(range(self.step // 2, size, self.step)) - 1
            else (end + 1) * self.step - 1
            for end, size in ((u1, width), (v1, height))
        ]
        return replace(coarse, region=(u0 * self.step, v0 * self.step, last[0], last[1]))
