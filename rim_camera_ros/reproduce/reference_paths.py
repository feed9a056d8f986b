"""Chapter 4: external and reference path as recorded through a warm-up and through changes of temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.reference_path import estimate_reference_scale
from rim_camera_ros.pipeline.reference import Linearity, SimulatedReference
from rim_camera_ros.reproduce.laboratory import OBSERVED, WHITE, Laboratory, Measured
from rim_camera_ros.reproduce.reductions import moving_mean
from rim_camera_ros.scene import Scene, ScenePose, Station, Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Paths:
    """Drifts of external and reference path over time, from their first value, m; ``ambient`` in degC."""

    time: Array
    external: Array
    reference: Array
    ambient: Array

    @property
    def corrected(self) -> Array:
        """Eq. 4.4: external less reference."""
        result: Array = self.external - self.reference
        return result

    def scaled(self, scale: float) -> Array:
        """Eq. 4.5: external less scale times reference."""
        result: Array = self.external - scale * self.reference
        return result

    @property
    def scale(self) -> float:
        """Scale of eq. 4.5 by least squares with errors in both paths."""
        noise = float(np.std(np.diff(self.reference, 2))) / np.sqrt(6)
        own = float(np.std(np.diff(self.external, 2))) / np.sqrt(6)
        found = estimate_reference_scale(
            drift=self.external, reading=self.reference, drift_sigma=own, reading_sigma=noise
        )
        return found.scale


def camera_with_reference(laboratory: Laboratory) -> tuple[Camera, SimulatedReference]:
    """Return the SR-3000 with a reference path, and the errors of that path."""
    path = laboratory.camera("sr3000_every_effect").effects["reference_path"]
    plain = laboratory.camera("sr3000")
    camera = with_effects(plain, dict(plain.effects) | {"reference_path": path})
    return camera, SimulatedReference(linearity=Linearity.of_camera(camera))


def record_paths(laboratory: Laboratory, scene: Scene, words: str, *, seed: int) -> list[Measured]:
    """Simulate a scene with the reference path and return rows 70-107 about column 87, by station."""
    camera, reference = camera_with_reference(laboratory)
    # both pixels of sec. 3.3.7, 71/87 and 106/87, with their neighbours
    region = (slice(OBSERVED[0] - 1, 108), slice(OBSERVED[1] - 1, OBSERVED[1] + 2))
    return laboratory.record(camera, scene, region, seed=seed, words=words, reference=reference)


#: Rows of the region above that hold the two pixels with their neighbours.
UPPER, LOWER = slice(0, 3), slice(35, 38)


def by_frame(there: Sequence[Measured]) -> Paths:
    """Return the paths frame by frame, the external one, like the reference, as the mean of 3 x 3 pixels."""
    external = np.concatenate([result.error[:, UPPER].mean(axis=(1, 2)) for result in there])
    return Paths(
        np.concatenate([result.uptime for result in there]),
        external,
        np.concatenate([result.reference for result in there]),
        np.concatenate([result.ambient for result in there]),
    )


def by_burst(there: Sequence[Measured], rows: slice = UPPER) -> Paths:
    """Return the paths as means of each burst, filtered by a running mean of five bursts."""
    external = np.array([float(np.nanmean(result.error[:, rows])) for result in there])
    reference = np.array([float(result.reference.mean()) for result in there])
    time = np.array([float(result.uptime.mean()) for result in there])
    external, reference = moving_mean(external, 5), moving_mean(reference, 5)
    ambient = np.array([float(result.ambient.mean()) for result in there])
    return Paths(time - time[0], external - external[0], reference - reference[0], ambient)


# --- set-ups ---------------------------------------------------------------------------------------


def cold_start(laboratory: Laboratory) -> Scene:
    """Return the shipped cold start with a continuous first half minute."""
    scene = laboratory.scene("cold_start")
    later = [
        station
        for station in scene.schedule
        if station.uptime is not None and 30.0 < station.uptime <= 1800.0
    ]
    first = replace(scene.schedule[0], frames=600, rate=20.0)
    return replace(scene, schedule=(first, *later))


def climate_cell(
    degrees: Sequence[float], surfaces: Sequence[Surface], poses: dict[str, ScenePose], *, rest: float = 0.0
) -> Scene:
    """Return a climate cell: 2 h for each temperature, of which the change takes 30 min; 20 frames in 5 min.

    ``rest`` hours follow, in which the cell returns to 20 degC.
    """
    times, values = [0.0, 2.0], [degrees[0], degrees[0]]
    for i, (_, after) in enumerate(pairwise(degrees), 1):
        times += [2.0 * i + 0.5, 2.0 * (i + 1)]
        values += [after, after]
    if rest:
        times.append(times[-1] + rest)
        values.append(20.0)
    hours = np.arange(0.0, times[-1] + 1e-9, 1 / 12)
    schedule = tuple(
        Station(
            frames=20,
            rate=10.0,
            integration_time=100.0,
            uptime=3600.0 * (1 + float(hour)),
            ambient=float(np.interp(hour, times, values)),
            poses=poses if i == 0 else {},
        )
        for i, hour in enumerate(hours)
    )
    return Scene(tuple(surfaces), schedule=schedule)


def one_target(degrees: Sequence[float], *, rest: float = 0.0) -> Scene:
    """Return a climate cell with a white wall at 1.166 m, turned by 10 degrees (sec. 4.3.2.1)."""
    half = np.radians(5.0)
    pose = ScenePose((0.0, 0.0, 1.166), (0.0, float(np.sin(half)), 0.0, float(np.cos(half))))
    wall = Surface("wall", "plane", "truth", reflectivity=WHITE)
    return climate_cell(degrees, [wall], {"wall": pose}, rest=rest)
