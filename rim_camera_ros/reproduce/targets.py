"""Secs. 3.3.3, 3.3.5: the grey wedge; distance and precision over the amplitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.laboratory import OBSERVED, SETTINGS, Laboratory, Measured, around, with_frames
from rim_camera_ros.reproduce.reductions import HyperbolaFit, fit_hyperbola, fit_noise
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row

_SEED = 3305
#: Table 3.4: a [m counts], b [counts] by integration time.
TABLE_3_4 = {16: (85.71, 0.995), 60: (237.0, 15.71), 100: (383.3, 4.036)}
#: The wedge that table 3.4 is taken from: its c is about 2.29 m.
_TABLE_DISTANCE = 2.344
#: Five pixels of a column, at 40 frames: the 200 measurements of the thesis.
_REGION = around(OBSERVED, (2, 0))
_FRAMES = 40
#: Fields that are darker are discarded (sec. 3.3.5): their single measurements spread by more than this many
#: m, which is a third of a radian and a third of the amplitude.
_DISCARD = 0.4


def wedge_stations(laboratory: Laboratory) -> list[Measured]:
    """Return the grey wedge (sec. 3.3.5): 20 greys at three distances and three settings."""

    def measure() -> list[Measured]:
        scene = with_frames(laboratory.scene("grey_wedge"), _FRAMES)
        camera = laboratory.camera("sr3000")
        return laboratory.record(camera, scene, _REGION, seed=_SEED, words="grey wedge")

    return laboratory.once("grey wedge", measure)


def hyperbolas(laboratory: Laboratory) -> Mapping[int, HyperbolaFit]:
    """Return eq. 3.6 fitted to the wedge at 2.344 m, by integration time."""

    def fit() -> dict[int, HyperbolaFit]:
        there = wedge_stations(laboratory)
        return {setting: _fit(_series(there, setting, _TABLE_DISTANCE)) for setting in SETTINGS}

    return laboratory.once("hyperbolas", fit)


def _series(there: list[Measured], setting: int, distance: float) -> list[Measured]:
    return [
        result
        for result in there
        if result.setting == setting
        and abs(result.poses["wedge"].position[2] - distance) < 1e-3
        and result.sigma < _DISCARD
    ]


def _means(series: list[Measured]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean amplitude [counts], mean distance [m] and the 1-sigma of that, by station."""
    amplitude = np.array([result.mean_amplitude for result in series])
    distance = np.array([float(np.nanmean(result.distance)) for result in series])
    sigma = np.array([result.sigma / np.sqrt(result.count) for result in series])
    order = np.argsort(amplitude)
    return amplitude[order], distance[order], sigma[order]


def _fit(series: list[Measured]) -> HyperbolaFit:
    amplitude, distance, sigma = _means(series)
    spread = np.array([float(np.nanstd(result.amplitude)) / np.sqrt(result.count) for result in series])
    order = np.argsort([result.mean_amplitude for result in series])
    return fit_hyperbola(amplitude, distance, distance_sigma=sigma, amplitude_sigma=spread[order])


def grey_wedge(laboratory: Laboratory) -> Outcome:
    """Table 3.4 and figs. 3.19, 3.24-3.26."""
    there, fitted = wedge_stations(laboratory), hyperbolas(laboratory)
    rows = []
    how = (
        "grey wedge at 2.344 m, 20 greys, 40 frames of 5 pixels (200 measurements) each; eq. 3.6 by least "
        f"squares weighted by the spread; fields whose single measurements spread by more than {_DISCARD} m "
        "discarded"
    )
    why = "noise of the measurements, a and b being correlated; stray light makes a larger by half a percent"
    for setting, (a, b) in TABLE_3_4.items():
        hyperbola_fit = fitted[setting]
        rows += [
            Row(
                f"hyperbola a, setting {setting}",
                "table 3.4",
                Printed.number(a, f"{a:.4g}"),
                hyperbola_fit.a,
                "m counts",
                how,
                1,
                hyperbola_fit.a_sigma,
                why,
            ),
            Row(
                f"hyperbola b, setting {setting}",
                "table 3.4",
                Printed.number(b, f"{b:.4g}"),
                hyperbola_fit.b,
                "counts",
                how,
                1,
                hyperbola_fit.b_sigma,
                why,
            ),
        ]
    rows += [_exponent(there), _same_precision(there), _between_distances(there)]
    pictures = (_precision(there), _amplitude(there, fitted), _three_distances(there), _shifted(there))
    return Outcome(tuple(rows), pictures)


# --- precision -------------------------------------------------------------------------------------


def _spread(there: list[Measured], setting: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean amplitude [counts] and sigma of one measurement [m] of all stations at a setting."""
    mine = [result for result in there if result.setting == setting and result.sigma < _DISCARD]
    return np.array([result.mean_amplitude for result in mine]), np.array([result.sigma for result in mine])


def _exponent(there: list[Measured]) -> Row:
    pairs = [_spread(there, setting) for setting in SETTINGS]
    amplitude = np.concatenate([one for one, _ in pairs])
    sigma = np.concatenate([one for _, one in pairs])
    floor = fit_noise(amplitude, sigma).floor
    varying = sigma > 3 * floor
    rest = np.sqrt(sigma[varying] ** 2 - floor**2)
    slope = float(np.polyfit(np.log(amplitude[varying]), np.log(rest), 1)[0])
    how = (
        "grey wedge, all settings and distances: slope of log sigma over log amplitude after the floor, "
        f"{int(varying.sum())} stations with sigma above three floors"
    )
    printed = Printed.number(-1.0, "-1 (anti-proportional)")
    return Row("exponent of sigma over amplitude", "sec. 3.3.3, fig. 3.19", printed, slope, "-", how, 3)


def _same_precision(there: list[Measured]) -> Row:
    slopes = [fit_noise(*_spread(there, setting)).slope for setting in SETTINGS]
    spread = (max(slopes) - min(slopes)) / float(np.mean(slopes)) * 100
    how = "sigma^2 = floor^2 + (k / A)^2 for each setting: largest minus smallest k over their mean"
    printed = Printed.number(0.0, "no influence")
    return Row("influence of the setting on sigma(A)", "fig. 3.19", printed, spread, "%", how)


def _precision(there: list[Measured]) -> Picture:
    curves = tuple(
        Curve(amplitude, sigma * 1e3, label=f"setting {setting}", points=True)
        for setting in SETTINGS
        for amplitude, sigma in (_spread(there, setting),)
    )
    panel = Panel("Precision over amplitude, SR-3000", "amplitude [counts]", "sigma [mm]", curves, True, True)
    caption = "Standard deviation of one distance over the amplitude, grey wedge, three integration times."
    return Picture("fig_3_19", "Fig. 3.19", caption, (panel,))


# --- amplitude -------------------------------------------------------------------------------------


def _amplitude(there: list[Measured], fitted: Mapping[int, HyperbolaFit]) -> Picture:
    curves = []
    for setting in SETTINGS:
        amplitude, distance, sigma = _means(_series(there, setting, _TABLE_DISTANCE))
        colour = ("#1f6f8b", "#b9632f", "#5d8a3a")[SETTINGS.index(setting)]
        hyperbola_fit = fitted[setting]
        curves.append(
            Curve(amplitude, (distance - hyperbola_fit.c) * 1e3, sigma * 1e3, f"{setting}", True, colour)
        )
        fine = np.geomspace(amplitude.min(), amplitude.max(), 200)
        curves.append(Curve(fine, hyperbola_fit.offset(fine) * 1e3, colour=colour))
    panel = Panel(
        "Distance over amplitude, SR-3000", "amplitude [counts]", "distance - c [mm]", tuple(curves), log=True
    )
    caption = (
        "Measured distance to the wedge at 2.344 m over its amplitude, less the asymptote, with eq. 3.6."
    )
    return Picture("fig_3_24", "Fig. 3.24", caption, (panel,))


_DISTANCES = (1.728, 2.344, 2.944)


def _three_distances(there: list[Measured]) -> Picture:
    panels = []
    for distance in _DISTANCES:
        curves = []
        for setting in SETTINGS:
            amplitude, measured, _ = _means(_series(there, setting, distance))
            curves.append(Curve(amplitude, measured, label=f"{setting}"))
        panels.append(Panel(f"{distance:.3f} m", "amplitude [counts]", "distance [m]", tuple(curves)))
    caption = "The grey wedge at three distances: measured distance over amplitude."
    return Picture("fig_3_25", "Fig. 3.25", caption, tuple(panels))


def _at_4000(there: list[Measured]) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return for each distance the amplitudes and the distances shifted to 0 at 4000 counts, setting 100."""
    result = []
    for distance in _DISTANCES:
        amplitude, measured, _ = _means(_series(there, 100, distance))
        result.append((distance, amplitude, measured - np.interp(4000.0, amplitude, measured)))
    return result


def _shifted(there: list[Measured]) -> Picture:
    curves = tuple(
        Curve(amplitude, shifted * 1e3, label=f"{distance:.3f} m")
        for distance, amplitude, shifted in _at_4000(there)
    )
    panel = Panel("Setting 100, 0 at 4000 counts", "amplitude [counts]", "distance [mm]", curves)
    near = replace(panel, title="the same, low amplitudes", log=True)
    caption = "The wedge at three distances, each shifted to 0 at 4000 counts (setting 100)."
    return Picture("fig_3_26", "Fig. 3.26", caption, (panel, near))


def _between_distances(there: list[Measured]) -> Row:
    fits = [_fit(_series(there, 100, distance)) for distance in _DISTANCES]
    low, high = 400.0, 1500.0
    at = np.geomspace(low, high, 20)
    # by the fits: between the amplitudes of the fields the curves are too bent for straight lines
    values = np.array([fit.offset(at) - fit.offset(np.array([4000.0])) for fit in fits])
    largest = float(np.max(np.ptp(values, axis=0))) * 1e3
    how = (
        "eq. 3.6 through the series of each distance, shifted to 0 at 4000 counts, setting 100: largest "
        f"difference between them from {low:.0f} to {high:.0f} counts"
    )
    why = (
        "noise: it is as large without stray light; the simulated wedge stands in the dark, so that stray "
        "light comes from about the same distance as the wedge itself"
    )
    printed = Printed(10.0, 100.0, "more than a centimetre")
    return Row("wedge at three distances, difference", "fig. 3.26", printed, largest, "mm", how, why=why)
