"""Sec. 3.3.8: the track line, cyclic errors of the SR-2 and the SR-3000."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.laboratory import (
    OBSERVED,
    OBSERVED_SR2,
    SETTINGS,
    WARM,
    WHITE,
    Laboratory,
    Measured,
    around,
    facing,
    plate,
    stations,
)
from rim_camera_ros.reproduce.reductions import CyclicFit, fit_cyclic, half_range, strongest_order
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row
from rim_camera_ros.reproduce.targets import hyperbolas

Array = NDArray[np.float64]

_SEED = 3308
_STEPS = np.round(0.3 + 0.05 * np.arange(141), 3)
#: Least distance in m in the look-up tables of the SR-3000 (sec. 4.4).
_NEAREST = 1.2
#: Measurements with a standard deviation of a single distance above this [m] are discarded (sec. 3.3.5).
_DISCARD = 0.4


@dataclass(frozen=True)
class TrackLine:
    """Means at the stations of a track line, at one setting: m, counts; NaN where the pixel saturates."""

    nominal: Array
    error: Array
    amplitude: Array
    sigma: Array
    count: Array

    @property
    def mean_sigma(self) -> Array:
        """1-sigma of the mean error in m."""
        result: Array = self.sigma / np.sqrt(np.maximum(self.count, 1))
        return result


def track_line(laboratory: Laboratory, name: str, *, frames: int) -> Mapping[int, TrackLine]:
    """Return the track line of the thesis' pixel and its neighbours, by integration time."""

    def measure() -> dict[int, TrackLine]:
        camera = laboratory.camera(name)
        pixel = OBSERVED_SR2 if name == "sr2" else OBSERVED
        result = {}
        for setting in SETTINGS:
            placed = [(setting, facing(float(z))) for z in _STEPS]
            scene = stations(plate(), placed, frames=frames, uptime=WARM[name])
            words = f"track line, {name}, setting {setting}"
            seed = _SEED + setting
            there = laboratory.record(camera, scene, around(pixel, 1), seed=seed, words=words)
            result[setting] = _line(there)
        return result

    return laboratory.once(f"track line {name} {frames}", measure)


def _line(there: list[Measured]) -> TrackLine:
    sigma = np.array([result.sigma for result in there])
    kept = sigma < _DISCARD
    return TrackLine(
        np.array([float(result.nominal.mean()) for result in there]),
        np.where(kept, [result.mean_error for result in there], np.nan),
        np.array([result.mean_amplitude for result in there]),
        np.where(kept, sigma, np.nan),
        np.array([result.count for result in there]),
    )


def _description(frames: int) -> str:
    return (
        f"white plate ({WHITE:.0%}) of 1 x 1 m from 0.3 to 7.3 m every 5 cm, {frames} frames of 3 x 3 pixels "
        "about "
        "the thesis' pixel; "
    )


# --- SR-2 ------------------------------------------------------------------------------------------


def sr2(laboratory: Laboratory) -> Outcome:
    """Fig. 3.45: cyclic error, offset, and influence of the setting, SR-2."""
    frames = 6
    camera = laboratory.camera("sr2")
    lines = track_line(laboratory, "sr2", frames=frames)
    fits = {setting: _fitted(measurement, camera.sensor.ambiguity) for setting, measurement in lines.items()}
    at_100, line = fits[100], lines[100]
    order = strongest_order(
        line.nominal, line.error, ambiguity=camera.sensor.ambiguity, orders=range(1, 9), sigma=line.mean_sigma
    )
    mean = {setting: fit.offset + fit.slope * 3.75 for setting, fit in fits.items()}
    how = _description(frames)
    rows = (
        Row(
            "SR-2 cyclic error, +-",
            "fig. 3.45",
            Printed.number(80.0, "about 80"),
            at_100.amplitude * 1e3,
            "mm",
            how + "least squares of offset, slope and a sinusoid of 4 periods, setting 100",
            1,
            at_100.amplitude_sigma * 1e3,
        ),
        Row(
            "SR-2 cyclic error, half of the range",
            "fig. 3.45",
            Printed.number(80.0, "about 80"),
            half_range(line.error) * 1e3,
            "mm",
            how + "half of largest minus smallest error, setting 100; noise of the means is in it",
        ),
        Row(
            "SR-2 periods in the ambiguity range",
            "fig. 3.45, sec. 2.1.2",
            Printed.number(4.0, "4 (uneven harmonics)"),
            float(order),
            "-",
            how + "number of periods (1 to 8) that leaves the smallest residuals",
            0,
        ),
        Row(
            "SR-2 offset",
            "fig. 3.45",
            Printed.number(300.0, "about 300"),
            mean[100] * 1e3,
            "mm",
            how + "level of the line at 3.75 m, setting 100",
        ),
        Row(
            "SR-2 offset between the settings",
            "fig. 3.45",
            Printed(0.0, 100.0, "up to 100"),
            (max(mean.values()) - min(mean.values())) * 1e3,
            "mm",
            how + "largest minus smallest level at 3.75 m",
        ),
        Row(
            "SR-2 setting 100 minus 16",
            "sec. 3.3.8",
            Printed(0.0, 100.0, "longer, up to 100"),
            (mean[100] - mean[16]) * 1e3,
            "mm",
            how + "levels at 3.75 m",
        ),
    )
    curves = tuple(
        Curve(measurement.nominal, -measurement.error * 1e3, label=f"setting {setting}")
        for setting, measurement in lines.items()
    )
    panel = Panel("SR-2, look-up tables", "nominal distance [m]", "correction [mm]", curves)
    caption = "Additive correction of the SR-2 over the distance for three integration times, not filtered."
    return Outcome(rows, (Picture("fig_3_45", "Fig. 3.45", caption, (panel,)),))


def _fitted(line: TrackLine, ambiguity: float, error: Array | None = None) -> CyclicFit:
    values = line.error if error is None else error
    return fit_cyclic(line.nominal, values, ambiguity=ambiguity, sigma=line.mean_sigma)


# --- SR-3000 ---------------------------------------------------------------------------------------


def reduced_track_line(laboratory: Laboratory) -> tuple[TrackLine, Array, CyclicFit]:
    """Return the SR-3000's track line at setting 100, its errors reduced for the amplitude, and their fit."""
    camera = laboratory.camera("sr3000")
    line = track_line(laboratory, "sr3000", frames=17)[100]
    error = line.error - hyperbolas(laboratory)[100].offset(line.amplitude)
    error = np.where(line.nominal >= _NEAREST, error, np.nan)
    return line, error, _fitted(line, camera.sensor.ambiguity, error)


def sr3000(laboratory: Laboratory) -> Outcome:
    """Figs. 3.46-3.49: look-up tables of the SR-3000, amplitude and precision over the distance."""
    camera = laboratory.camera("sr3000")
    lines = track_line(laboratory, "sr3000", frames=17)
    fitted = hyperbolas(laboratory)
    line, error, fit = reduced_track_line(laboratory)
    ambiguity = camera.sensor.ambiguity
    how = (
        _description(17)
        + "setting 100, reduced for the amplitude by the hyperbolas of the wedge, from 1.2 m; "
    )
    centimetre = float(np.interp(3.5, line.nominal, line.sigma))
    rows = (
        Row(
            "SR-3000 cyclic error, +-",
            "sec. 3.3.8",
            Printed.number(80.0, "nearly as the SR-2, 80"),
            fit.amplitude * 1e3,
            "mm",
            how + "offset, slope and a sinusoid of 4 periods",
            1,
            fit.amplitude_sigma * 1e3,
            "fig. 3.47 has no numbers in the text",
        ),
        Row(
            "SR-3000 periods in the ambiguity range",
            "fig. 3.47",
            Printed.number(4.0, "4 (uneven harmonics)"),
            float(
                strongest_order(
                    line.nominal, error, ambiguity=ambiguity, orders=range(1, 9), sigma=line.mean_sigma
                )
            ),
            "-",
            how + "number of periods (1 to 8) that leaves the smallest residuals",
            0,
        ),
        Row(
            "SR-3000 sigma of one distance at 3.5 m",
            "fig. 3.49",
            Printed.number(10.0, "centimetre level"),
            centimetre * 1e3,
            "mm",
            _description(17) + "setting 100",
        ),
    )
    return Outcome(rows, _pictures(lines, fitted, error, fit, ambiguity))


def _pictures(
    lines: Mapping[int, TrackLine],
    fitted: Mapping[int, object],
    error: Array,
    fit: CyclicFit,
    ambiguity: float,
) -> tuple[Picture, ...]:
    raw = tuple(
        Curve(measurement.nominal, -measurement.error * 1e3, label=f"{s}") for s, measurement in lines.items()
    )
    light = tuple(
        Curve(measurement.nominal, measurement.amplitude, label=f"{s}") for s, measurement in lines.items()
    )
    sigma = tuple(
        Curve(measurement.nominal, measurement.sigma * 1e3, label=f"{s}") for s, measurement in lines.items()
    )
    line = lines[100]
    known = np.isfinite(error)
    fine = np.linspace(_NEAREST, 7.3, 400)
    model = fit.offset + fit.slope * fine + fit.cyclic(fine, ambiguity)
    reduced = (
        Curve(line.nominal[known], -error[known] * 1e3, label="measured", points=True),
        Curve(fine, -model * 1e3, label="offset, slope, 4 periods", colour="#1d2733"),
    )
    x = "nominal distance [m]"
    return (
        Picture(
            "fig_3_46",
            "Fig. 3.46",
            "Correction of the SR-3000 over the distance, not reduced.",
            (Panel("SR-3000, not reduced", x, "correction [mm]", raw),),
        ),
        Picture(
            "fig_3_47",
            "Fig. 3.47",
            "The same at setting 100, reduced for the amplitude, with its fit.",
            (Panel("SR-3000, reduced for the amplitude", x, "correction [mm]", reduced),),
        ),
        Picture(
            "fig_3_48",
            "Fig. 3.48",
            "Amplitude of a white plate over the distance.",
            (Panel("SR-3000, amplitude", x, "amplitude [counts]", light, log_y=True),),
        ),
        Picture(
            "fig_3_49",
            "Fig. 3.49",
            "Standard deviation of one distance over the distance.",
            (Panel("SR-3000, precision", x, "sigma [mm]", sigma, log_y=True),),
        ),
    )
