"""Sec. 3.3.7: warm-up of both cameras, external temperature of the SR-2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.laboratory import OBSERVED, OBSERVED_SR2, Laboratory, Measured, around
from rim_camera_ros.reproduce.reductions import settled_after
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row

Array = NDArray[np.float64]

_SEED = 3307
#: Minutes after which the cameras are warm, and the pixel that is watched with its neighbours.
_WARM_UP = {"sr2": (12.0, OBSERVED_SR2), "sr3000": (6.0, OBSERVED)}
#: A camera is warm when less drift than this is left, in m: the accuracy of the track line is 1-2 mm.
_STABLE = 0.001
_REACH = 10


@dataclass(frozen=True)
class Series:
    """Mean over pixels and frames of bursts: time since power-on [s], drift [m] from the end, amplitude."""

    uptime: Array
    drift: Array
    amplitude: Array
    frame_uptime: Array
    frame_drift: Array


def series(there: Sequence[Measured], *, last: float) -> Series:
    """Return a drift over uptime, relative to the mean of the last ``last`` seconds."""
    uptime = np.array([float(result.uptime.mean()) for result in there])
    error = np.array([result.mean_error for result in there])
    final = float(error[uptime >= uptime[-1] - last].mean())
    middle = there[0].error.shape[1] // 2
    frames = np.concatenate([result.error[:, middle, middle] for result in there])
    own = float(np.nanmean(frames[-50:]))
    return Series(
        uptime,
        error - final,
        np.array([result.mean_amplitude for result in there]),
        np.concatenate([result.uptime for result in there]),
        frames - own,
    )


def warm_up(laboratory: Laboratory) -> Outcome:
    """Fig. 3.33: time until the distance is stable, and the drift over 8 min (sec. 4.3.1)."""
    rows: list[Row] = []
    panels: list[Panel] = []
    for name, (minutes, pixel) in _WARM_UP.items():
        camera = laboratory.camera(name)
        there = laboratory.record(
            camera,
            laboratory.scene("cold_start"),
            around(pixel, _REACH),
            seed=_SEED,
            words=f"cold start, {name}",
        )
        run = series(there, last=600.0)
        settled = settled_after(run.uptime, run.drift, final=0.0, tolerance=_STABLE) / 60
        how = (
            "white wall at 1.166 m, setting 100, from power-on for 40 min in bursts of 5 frames; mean of 21 "
            "x 21 "
            "pixels; time from which on less than 1 mm is left against the mean of the last 10 min"
        )
        why = "the thesis chose its times amply, without a criterion"
        shown = Printed.number(minutes)
        rows.append(Row(f"{camera.device} warm-up", "sec. 3.3.7", shown, settled, "min", how, why=why))
        if name == "sr3000":
            rows += _drifts(run)
        panels += _panels(camera.device, run)
    caption = (
        "Warm-up of the SR-2 and the SR-3000: distance of one pixel (points) and mean of 21 x 21 pixels "
        "(line), "
        "and amplitude. The camera files have no drift of the amplitude, which the thesis shows as well."
    )
    return Outcome(tuple(rows), (Picture("fig_3_33", "Fig. 3.33", caption, tuple(panels), columns=2),))


def _drifts(run: Series) -> list[Row]:
    at = np.interp([30.0, 480.0], run.uptime, run.drift)
    start = float(run.drift[0])
    how = "the same recording: mean distance at that time minus that of the first burst (0 to 0.4 s)"
    return [
        Row(
            "SR-3000 drift over 8 min",
            "sec. 4.3.1",
            Printed(90.0, 100.0, "more than 90"),
            (float(at[1]) - start) * 1e3,
            "mm",
            how,
        ),
        Row(
            "SR-3000 drift over 30 s",
            "sec. 4.3.1",
            Printed.number(80.0, "about 80"),
            (float(at[0]) - start) * 1e3,
            "mm",
            how,
            why="by the exponentials of the camera file, 7.6 cm in 30 s, less what the first burst lasts",
        ),
    ]


def _panels(device: str, run: Series) -> list[Panel]:
    distance = Panel(
        f"{device}, distance",
        "uptime [min]",
        "distance - final [mm]",
        (
            Curve(run.frame_uptime / 60, run.frame_drift * 1e3, points=True, colour="#c9d3dc"),
            Curve(run.uptime / 60, run.drift * 1e3, colour="#1d2733"),
        ),
    )
    amplitude = Panel(
        f"{device}, amplitude", "uptime [min]", "amplitude [counts]", (Curve(run.uptime / 60, run.amplitude),)
    )
    return [distance, amplitude]


# --- external temperature --------------------------------------------------------------------------

#: Rests of the climate cell: the last so many s before the next change of temperature, every 2 h.
_STEP, _REST = 7200.0, 1200.0


def ambient(laboratory: Laboratory) -> Outcome:
    """Fig. 3.34: gradient of the SR-2's distance over the external temperature."""
    camera, scene = laboratory.camera("sr2"), laboratory.scene("climate_cell")
    pixel = (62, 74)  # sees the plate at 1.996 m
    there = laboratory.record(camera, scene, around(pixel, 3), seed=_SEED, words="climate cell, sr2")
    error = np.array([result.mean_error for result in there])
    degrees = np.array([float(result.ambient.mean()) for result in there])
    hours = np.array([float(result.uptime.mean()) for result in there])
    since = (hours - hours[0]) % _STEP
    rests = since >= _STEP - _REST
    slope, level = np.polyfit(degrees[rests], error[rests], 1)
    how = (
        "white plate at 1.996 m through 10, 0, -10 ... 40 ... 10 degC in steps of 2 h, setting 100, 5 frames "
        "of 7 "
        f"x 7 pixels every 5 min; line through the {int(rests.sum())} means of the last 20 min of each step"
    )
    spread = float(np.std(error[rests] - np.polyval([slope, level], degrees[rests]), ddof=2))
    sigma = spread / float(np.sqrt(np.sum((degrees[rests] - degrees[rests].mean()) ** 2)))
    row = Row(
        "SR-2, external temperature",
        "sec. 3.3.7",
        Printed.number(8.0, "about 8"),
        slope * 1e3,
        "mm/degC",
        how,
        2,
        sigma * 1e3,
    )
    line = np.array([-10.0, 40.0])
    panel = Panel(
        "SR-2, external temperature",
        "temperature [degC]",
        "measured - nominal [mm]",
        (
            Curve(degrees, error * 1e3, label="every 5 min", colour="#b9c4cf"),
            Curve(degrees[rests], error[rests] * 1e3, label="rests", points=True),
            Curve(line, np.polyval([slope, level], line) * 1e3, label="line", dashed=True),
        ),
    )
    caption = (
        "Distance of the SR-2 over the external temperature: the camera lags behind, rests are on a line."
    )
    return Outcome((row,), (Picture("fig_3_34", "Fig. 3.34", caption, (panel,)),))
