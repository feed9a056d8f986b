"""Sec. 3.3.6: angle of incidence on a uniform plate, and how it cancels the effect of the amplitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.figures import COLOURS, Curve, Panel
from rim_camera_ros.reproduce.laboratory import OBSERVED, SETTINGS, TARGET, Laboratory, around, with_frames
from rim_camera_ros.reproduce.reductions import (
    HyperbolaFit,
    fit_quartic,
    fold_angles,
    quartic,
    root_mean_square,
)
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row, Table
from rim_camera_ros.reproduce.targets import hyperbolas
from rim_camera_ros.rotations import rotation_matrix

Array = NDArray[np.float64]

_SEED = 3306
#: Table 3.5: a1 a2 a3 a4 in m / gon^4 ... m / gon by integration time.
TABLE_3_5 = {
    16: (5.768e-9, -4.555e-7, 9.834e-6, 5.655e-4),
    60: (4.122e-9, -1.806e-7, 1.757e-6, 2.996e-4),
    100: (3.065e-9, -1.691e-7, 4.899e-6, 2.817e-4),
}
#: Five pixels of a column at 200 frames: the 1000 measurements of the thesis.
_REGION = around(OBSERVED, (2, 0))
_FRAMES = 200
#: Angles in gon at which the curves are compared; the last ones of the thesis are steep and noisy.
_COMPARED = (30.0, 60.0)
#: Cancellation is judged up to this angle in gon.
_JUDGED = 60.0


@dataclass(frozen=True)
class Turned:
    """Deviation from the perpendicular case [m] over |angle| [gon] at a setting, before and after eq. 3.7."""

    gon: Array
    raw: Array
    reduced: Array

    @property
    def polynomial(self) -> Array:
        """Eq. 3.8 with a5 = 0 through the reduced deviations: a1 a2 a3 a4 (4,), m over gon."""
        return fit_quartic(self.gon, -self.reduced)


def incidence(laboratory: Laboratory) -> Outcome:
    """Table 3.5, fig. 3.32, and the compensation to about a tenth."""
    turned = turned_plate(laboratory)
    rows: list[Row] = []
    lines = []
    how = (
        f"uniform plate ({TARGET:.0%}) at 2.5 m turned every 10 gon from -90 to 90, median of 200 frames of "
        "5 "
        "pixels; +- angles averaged, amplitude reduced by the hyperbolas fitted to the wedge (eq. 3.7), eq. "
        "3.8 "
        "with a5 = 0 through |angle| <= 80 gon"
    )
    why = (
        "at 60 and 100 stray light, which takes more of the amplitude the narrower the turned plate is "
        "(without it the RMS is less than half); at 16 mostly noise of plate and wedge"
    )
    for setting, printed in TABLE_3_5.items():
        one = turned[setting]
        fitted = one.polynomial
        for gon in _COMPARED:
            value = float(quartic(gon, printed)) * 1e3
            ours = float(quartic(gon, fitted)) * 1e3
            label = f"incidence correction at {gon:g} gon, setting {setting}"
            shown = Printed.number(value, f"{value:.1f} by the polynomial")
            rows.append(Row(label, "table 3.5", shown, ours, "mm", how, why=why))
        difference = quartic(one.gon, fitted) - quartic(one.gon, printed)
        rows.append(
            Row(
                f"RMS between the polynomials, 0-80 gon, setting {setting}",
                "table 3.5",
                Printed.number(0.0, "0"),
                root_mean_square(difference) * 1e3,
                "mm",
                how,
                why=why,
            )
        )
        lines.append((f"{setting}", *(f"{p:.3e} / {q:.3e}" for p, q in zip(printed, fitted, strict=True))))
    rows += [_cancelled(turned[setting], setting) for setting in SETTINGS]
    headings = ("setting", "a1 [m/gon^4]", "a2 [m/gon^3]", "a3 [m/gon^2]", "a4 [m/gon]")
    table = Table("Table 3.5, coefficients: printed / ours", headings, tuple(lines))
    return Outcome(tuple(rows), (_picture(turned),), (table,))


def turned_plate(laboratory: Laboratory) -> Mapping[int, Turned]:
    """Return the deviations of a uniform plate that is turned about the vertical, by integration time."""
    return laboratory.once("turned plate", lambda: _turned(laboratory, hyperbolas(laboratory)))


def _turned(laboratory: Laboratory, fitted: Mapping[int, HyperbolaFit]) -> dict[int, Turned]:
    scene = with_frames(laboratory.scene("rotating_plate"), _FRAMES)
    uniform = tuple(replace(surface, texture=None, reflectivity=TARGET) for surface in scene.surfaces)
    scene = replace(scene, surfaces=uniform)
    camera = laboratory.camera("sr3000")
    there = laboratory.record(camera, scene, _REGION, seed=_SEED, words="rotating plate")
    result = {}
    for setting in SETTINGS:
        mine = [row for row in there if row.setting == setting]
        angle = np.array([_gon(row.poses["plate"].orientation) for row in mine])
        # each pixel relative to its nominal distance, which changes with the angle off the axis
        error = np.array([float(np.nanmean(np.nanmedian(row.error, axis=0))) for row in mine])
        amplitude = np.array([float(np.nanmean(np.nanmedian(row.amplitude, axis=0))) for row in mine])
        gon, raw = fold_angles(angle, error)
        _, reduced = fold_angles(angle, error - fitted[setting].offset(amplitude))
        keep = gon <= 80.0 + 1e-6
        result[setting] = Turned(gon[keep], (raw - raw[0])[keep], (reduced - reduced[0])[keep])
    return result


def _gon(orientation: tuple[float, float, float, float]) -> float:
    """Return the turn about the vertical in gon (400 gon = 360 deg)."""
    rotation = rotation_matrix(orientation)
    return float(np.arctan2(rotation[0, 2], rotation[2, 2]) * 200 / np.pi)


def _cancelled(turned: Turned, setting: int) -> Row:
    judged = turned.gon <= _JUDGED
    share = root_mean_square(turned.raw[judged]) / root_mean_square(turned.reduced[judged])
    how = (
        "RMS over 0-60 gon of the deviations from the perpendicular case, not reduced over reduced for the "
        "amplitude"
    )
    alone = {16: 0.25, 60: 0.09, 100: 0.14}[setting]
    rest = "noise" if setting == 100 else "stray light and noise"
    why = f"tables 3.4 and 3.5 alone, with amplitude ~ cos, leave {alone:.2f}; the rest is {rest}"
    printed = Printed.number(0.1, "about a tenth")
    label = f"amplitude and incidence together, setting {setting}"
    return Row(label, "sec. 3.3.6", printed, share, "-", how, 2, why=why)


def _picture(turned: Mapping[int, Turned]) -> Picture:
    left, right = [], []
    fine = np.linspace(0.0, 80.0, 161)
    for i, (setting, one) in enumerate(turned.items()):
        left.append(Curve(one.gon, -one.raw * 1e3, label=f"{setting}", points=True, colour=COLOURS[i]))
        right.append(Curve(one.gon, -one.reduced * 1e3, label=f"{setting}", points=True, colour=COLOURS[i]))
        right.append(Curve(fine, quartic(fine, TABLE_3_5[setting]) * 1e3, colour=COLOURS[i], dashed=True))
    axes = ("angle of incidence [gon]", "additive correction [mm]")
    panels = (
        Panel("not corrected for the amplitude", *axes, tuple(left)),
        Panel("corrected; dashed: table 3.5", *axes, tuple(right)),
    )
    caption = (
        "Additive correction over the angle of incidence, before and after the reduction of the amplitude."
    )
    return Picture("fig_3_32", "Fig. 3.32", caption, panels)
