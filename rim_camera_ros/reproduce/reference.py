"""Chapter 4: drifts that remain after the correction by the internal reference path.

The reference follows the drift of the external path and has the camera's own cyclic error at its 0.85 m. This
is how sec. 4.4 explains the drifts that remain after the simple correction (eq. 4.4). No lag is simulated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reproduce.laboratory import OBSERVED, Laboratory
from rim_camera_ros.reproduce.reductions import half_range
from rim_camera_ros.reproduce.reference_paths import (
    LOWER,
    by_burst,
    by_frame,
    camera_with_reference,
    climate_cell,
    cold_start,
    one_target,
    record_paths,
)
from rim_camera_ros.reproduce.reference_pictures import (
    first_minutes,
    first_seconds,
    mild_pictures,
    two_pictures,
    wide_pictures,
)
from rim_camera_ros.reproduce.results import Outcome, Printed, Row
from rim_camera_ros.scene import ScenePose

Array = NDArray[np.float64]

_SEED = 4300
_SET_UP = (
    "SR-3000 with a reference path of 0.85 m that has the camera's own cyclic error (sec. 4.4) and no lag; "
)


def warm_up(laboratory: Laboratory) -> Outcome:
    """Figs. 4.4, 4.5: the first 30 s and the first 30 min after power-on."""
    paths = by_frame(record_paths(laboratory, cold_start(laboratory), "warm-up with reference", seed=_SEED))
    first = paths.time < 30.0
    start = paths.time < 0.5
    end = first & (paths.time > 29.5)

    def drift(values: Array) -> float:
        return float(values[end].mean() - values[start].mean())

    external, internal, left = drift(paths.external), drift(paths.reference), drift(paths.corrected)
    how = _SET_UP + (
        "white wall at 1.166 m from power-on, 20 Hz, mean of 3 x 3 pixels; mean of the last half second of "
        "the first "
        "30 s minus that of the first"
    )
    why = (
        "by the slope of the cyclic error at 0.85 m, with phase and gradient as the camera file assumes them"
    )
    rows = (
        Row(
            "external distance, drift in 30 s",
            "sec. 4.3.1",
            Printed.number(80.0, "about 80"),
            external * 1e3,
            "mm",
            how,
            why="by the exponentials of the camera file, 7.6 cm in 30 s",
        ),
        Row(
            "reference distance, drift in 30 s",
            "sec. 4.3.1",
            Printed.number(70.0, "about 70"),
            internal * 1e3,
            "mm",
            how,
            why=why,
        ),
        Row(
            "residual drift after eq. 4.4, first 30 s",
            "sec. 4.3.1",
            Printed.number(20.0, "about 20"),
            left / external * 100,
            "%",
            how + ", corrected over external",
            why=why,
        ),
    )
    return Outcome(rows, (first_seconds(paths, first), first_minutes(paths)))


def climate(laboratory: Laboratory) -> Outcome:
    """Figs. 4.6-4.10: temperatures from 0 to 30 degC, and from -10 to 40 degC."""
    mild = by_burst(
        record_paths(
            laboratory, one_target((10, 0, 10, 20, 30, 10), rest=24.0), "climate 0 to 30", seed=_SEED + 1
        )
    )
    wide = by_burst(
        record_paths(laboratory, one_target((20, 40, -10, 20)), "climate -10 to 40", seed=_SEED + 2)
    )
    through = mild.time < 12 * 3600.0
    how = _SET_UP + (
        "white wall at 1.166 m turned by 10 deg, steps of 2 h, 20 frames of 3 x 3 pixels every 5 min, "
        "running mean "
        "of 25 min; half of largest minus smallest"
    )
    why = "what the reference leaves is the slope of its cyclic error at 0.85 m, as in the warm-up"
    share = half_range(wide.corrected) / half_range(wide.external) * 100
    rows = (
        Row(
            "0 to 30 degC: external distance, +-",
            "sec. 4.3.2.1",
            Printed(20.0, 30.0, "20-30"),
            half_range(mild.external[through]) * 1e3,
            "mm",
            how + ", 10, 0, 10, 20, 30, 10 degC",
        ),
        Row(
            "0 to 30 degC: corrected (eq. 4.4), +-",
            "sec. 4.3.2.1",
            Printed.number(4.0, "about 4"),
            half_range(mild.corrected[through]) * 1e3,
            "mm",
            how + ", 10, 0, 10, 20, 30, 10 degC",
            why=why,
        ),
        Row(
            "-10 to 40 degC: what eq. 4.4 leaves",
            "fig. 4.10",
            Printed(10.0, 20.0, "10-20"),
            share,
            "%",
            how + ", 20, 40, -10, 20 degC; corrected over external",
            why=why,
        ),
    )
    return Outcome(rows, (*mild_pictures(mild, through), *wide_pictures(wide)))


def two_distances(laboratory: Laboratory) -> Outcome:
    """Figs. 4.11-4.13: targets at 2.81 and 1.79 m, with and without a scale (eq. 4.5)."""
    camera, _ = camera_with_reference(laboratory)
    scene = laboratory.scene("climate_cell")
    poses = {"cardboard": ScenePose((0.0, 0.0, 3.2))}
    for name, pixel, distance in (("middle_plate", OBSERVED, 2.81), ("lower_plate", (106, 87), 1.79)):
        x, y, z = (float(ray) for ray in camera.rays[pixel] * distance)
        poses[name] = ScenePose((x, y, z))
    surfaces = [replace(surface, pose="truth") for surface in scene.surfaces]
    there = record_paths(
        laboratory, climate_cell((10, 0, 10, 20, 30, 10), surfaces, poses), "two distances", seed=_SEED + 3
    )
    far, near = by_burst(there), by_burst(there, LOWER)
    scale = (far.scale, near.scale)
    how = _SET_UP + (
        "white plates at 2.81 and 1.79 m, 10, 0, 10, 20, 30, 10 degC, 20 frames of 3 x 3 pixels every 5 min, "
        "running "
        "mean of 25 min; "
    )
    rows = (
        Row(
            "variation of the distance, 2.81 m",
            "sec. 4.3.2.3",
            Printed.number(50.0, "nearly 50"),
            2 * half_range(far.external) * 1e3,
            "mm",
            how + "largest minus smallest",
        ),
        Row(
            "variation after eq. 4.4, 2.81 m",
            "fig. 4.13",
            Printed(0.0, 10.0, "several millimetres"),
            2 * half_range(far.corrected) * 1e3,
            "mm",
            how + "largest minus smallest",
            why="the slope of the reference's cyclic error, as in the warm-up",
        ),
        Row(
            "variation after eq. 4.5, 2.81 m",
            "fig. 4.13",
            Printed(0.0, 2 * half_range(far.corrected) * 1e3, "less than by eq. 4.4"),
            2 * half_range(far.scaled(scale[0])) * 1e3,
            "mm",
            how + f"largest minus smallest, scale {scale[0]:.2f} by least squares",
        ),
    )
    return Outcome(rows, two_pictures(far, near, scale))
