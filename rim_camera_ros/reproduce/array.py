"""Secs. 3.3.8, 3.3.9: phase of the cyclic error over the array, fixed pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from rim_camera_ros.reports.figures import COLOURS, Curve, Map, Panel
from rim_camera_ros.reproduce.incidence import turned_plate
from rim_camera_ros.reproduce.laboratory import WARM, Laboratory, across, around, plate, stations
from rim_camera_ros.reproduce.linearity import reduced_track_line
from rim_camera_ros.reproduce.precision import wall
from rim_camera_ros.reproduce.reductions import CyclicFit, Plane, fit_cyclic, fit_plane, quartic
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row
from rim_camera_ros.reproduce.targets import hyperbolas

Array = NDArray[np.float64]

_SEED = 3351
#: Table 3.6: calibrated pixels, row and column.
TABLE_3_6 = (
    (10, 10), (10, 87), (40, 87), (71, 20), (71, 87), (10, 160), (110, 87), (71, 120), (71, 161), (130, 150),
    (130, 15),
)  # fmt: skip
_DISTANCES = np.round(np.arange(1.46, 3.961, 0.1), 3)
_FRAMES = 6
_REACH = 2


@dataclass(frozen=True)
class Phases:
    """Cyclic errors at the pixels of table 3.6: fits, and their unwrapped phases [rad] with a plane."""

    error: Array
    fits: tuple[CyclicFit, ...]
    phase: Array
    plane: Plane


def phases(laboratory: Laboratory) -> Phases:
    """Return the cyclic errors at the pixels of table 3.6, each looking along the track."""
    return laboratory.once("phases", lambda: _phases(laboratory))


def _phases(laboratory: Laboratory) -> Phases:
    camera = laboratory.camera("sr3000")
    fitted = hyperbolas(laboratory)[100]
    errors, fits = [], []
    for i, pixel in enumerate(TABLE_3_6):
        placed = [(100, across(camera.rays[pixel], float(z))) for z in _DISTANCES]
        scene = stations(plate(), placed, frames=_FRAMES, uptime=WARM["sr3000"])
        words = f"track line, pixel {pixel[0]}/{pixel[1]}"
        there = laboratory.record(camera, scene, around(pixel, _REACH), seed=_SEED + i, words=words)
        error = np.array([result.mean_error for result in there])
        light = np.array([result.mean_amplitude for result in there])
        sigma = np.array([result.sigma / np.sqrt(result.count) for result in there])
        reduced = error - fitted.offset(light)
        errors.append(reduced)
        fits.append(fit_cyclic(_DISTANCES, reduced, ambiguity=camera.sensor.ambiguity, sigma=sigma))
    # within half a period of the phase in the middle of the array
    middle = fits[TABLE_3_6.index((71, 87))].phase
    phase = np.array([middle + (fit.phase - middle + np.pi) % (2 * np.pi) - np.pi for fit in fits])
    row, column = np.array(TABLE_3_6, float).T
    plane = fit_plane(row, column, phase, np.array([fit.phase_sigma for fit in fits]))
    return Phases(np.array(errors), tuple(fits), phase, plane)


def phase_map(laboratory: Laboratory) -> Outcome:
    """Figs. 3.50, 3.51: the phase of the cyclic error grows from pixel 0/0."""
    found = phases(laboratory)
    row, column = np.array(TABLE_3_6, float).T
    rank = float(spearmanr(np.hypot(row, column), found.phase).statistic)
    plane = found.plane
    rise = float(plane.at(143, 175) - plane.at(0, 0))
    how = (
        "eleven pixels of table 3.6, the camera turned so that each looks along the track line, white plate "
        "from "
        f"1.46 to 3.96 m every 10 cm, {_FRAMES} frames of 5 x 5 pixels, reduced for the amplitude; offset, "
        "slope and "
        "a sinusoid of 4 periods at each; "
    )
    grows = Printed(0.0, np.inf, "grows")
    rows = (
        Row(
            "phase over distance from pixel 0/0, rank correlation",
            "fig. 3.51",
            grows,
            rank,
            "-",
            how + "Spearman's rank correlation of phase and distance from pixel 0/0",
            2,
        ),
        Row(
            "phase, pixel 0/0 to 143/175",
            "fig. 3.51",
            grows,
            rise,
            "rad",
            how + "plane through the phases",
            2,
            why="the size of the gradient is assumed in the camera file",
        ),
        Row(
            "phase, RMS about the plane",
            "fig. 3.51",
            Printed(0.0, np.inf, "planarity not claimed"),
            plane.rms,
            "rad",
            how + "residuals of the plane",
            3,
        ),
    )
    return Outcome(rows, _pictures(found))


def _pictures(found: Phases) -> tuple[Picture, ...]:
    curves = tuple(
        Curve(
            _DISTANCES,
            -(error - fit.offset) * 1e3,
            label=f"{r}/{c}",
            colour=COLOURS[i % len(COLOURS)],
            dashed=i >= len(COLOURS),
        )
        for i, (error, fit, (r, c)) in enumerate(zip(found.error, found.fits, TABLE_3_6, strict=True))
    )
    distance = Picture(
        "fig_3_50",
        "Fig. 3.50",
        "Correction of eleven pixels (row/column) over the distance, less their offset.",
        (Panel("SR-3000, pixels of table 3.6", "nominal distance [m]", "correction [mm]", curves),),
    )
    rows, columns = np.mgrid[:144, :176]
    image = found.plane.at(rows, columns)
    # the measured pixels stand out as squares of their own phase
    for (r, c), phase in zip(TABLE_3_6, found.phase, strict=True):
        image[r - 5 : r + 6, c - 5 : c + 6] = phase
    middle = float(found.plane.at(71, 87))
    over = Picture(
        "fig_3_51",
        "Fig. 3.51",
        "Phase of the cyclic error against that in the middle: eleven pixels (squares) and the plane through "
        "them.",
        maps=(Map("SR-3000, phase", image - middle),),
        unit="rad",
    )
    return distance, over


# --- fixed pattern ---------------------------------------------------------------------------------


def fixed_pattern(laboratory: Laboratory) -> Outcome:
    """Fig. 3.57: remaining errors on a white wall at 1.366 m, with all other calibrated effects undone."""
    camera = laboratory.camera("sr3000")
    seen = wall(laboratory, "sr3000", distance=1.366, frames=50)
    z = camera.rays[..., 2]
    nominal = 1.366 / z
    gon = np.arccos(z) * 200 / np.pi
    plane = phases(laboratory).plane
    cyclic = reduced_track_line(laboratory)[2]
    rows, columns = np.mgrid[: camera.shape[0], : camera.shape[1]]
    angle = cyclic.order * 2 * np.pi / camera.sensor.ambiguity * nominal + plane.at(rows, columns)
    left = seen.mean - nominal
    left = left - hyperbolas(laboratory)[100].offset(seen.amplitude)
    left = left + quartic(gon, turned_plate(laboratory)[100].polynomial)
    left = left - cyclic.amplitude * np.sin(angle) - cyclic.slope * nominal
    pattern = -(left - np.nanmedian(left))
    middle = pattern[22:122, 38:138]
    noise = float(np.median(seen.sigma[22:122, 38:138])) / np.sqrt(seen.frames)
    how = (
        "white wall at 1.366 m, setting 100, mean of 50 frames, reduced by the hyperbola of the wedge, the "
        "polynomial "
        "of the rotating plate, and cyclic error, slope and phases of the track line, all as fitted here; "
        "RMS of "
        f"the middle 100 x 100 pixels, of which noise {noise * 1e3:.1f} mm"
    )
    printed = Printed(0.0, np.inf, "smooth, no number")
    row = Row(
        "fixed pattern, RMS in the middle", "fig. 3.57", printed, float(np.std(middle)) * 1e3, "mm", how
    )
    caption = (
        "Additive correction of each pixel from a white wall at 1.366 m after the other corrections; the "
        "corners "
        "hold what stray light and low amplitudes leave."
    )
    picture = Picture(
        "fig_3_57", "Fig. 3.57", caption, maps=(Map("SR-3000, fixed pattern", pattern * 1e3),), unit="mm"
    )
    return Outcome((row,), (picture,))
