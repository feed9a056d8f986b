"""Pictures of the internal reference path, in the manner of figs. 4.4-4.13."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.reductions import moving_mean
from rim_camera_ros.reproduce.reference_paths import Paths
from rim_camera_ros.reproduce.results import Picture

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_GREY, _DARK = "#c9d3dc", "#1d2733"


def first_seconds(paths: Paths, first: Mask) -> Picture:
    """Return fig. 4.4: frame by frame; ``first`` marks the first 30 s."""
    time = paths.time[first]
    panels = []
    for title, values in (
        ("external", paths.external),
        ("reference", paths.reference),
        ("corrected (eq. 4.4)", paths.corrected),
    ):
        shown = (values[first] - values[first][:10].mean()) * 1e3
        curves = (Curve(time, shown, colour=_GREY), Curve(time, moving_mean(shown, 21), colour=_DARK))
        panels.append(Panel(title, "uptime [s]", "drift [mm]", curves))
    caption = "The first 30 s after power-on: external path, reference path, and the corrected distance."
    return Picture("fig_4_4", "Fig. 4.4", caption, tuple(panels))


def first_minutes(paths: Paths) -> Picture:
    """Return fig. 4.5."""
    minutes = paths.time / 60
    # from bursts of five frames on: their means
    panels = []
    for title, values in (("external", paths.external), ("corrected (eq. 4.4)", paths.corrected)):
        shown = (values - values[-100:].mean()) * 1e3
        curves = (Curve(minutes, shown, colour=_GREY), Curve(minutes, moving_mean(shown, 5), colour=_DARK))
        panels.append(Panel(title, "uptime [min]", "distance - final [mm]", curves))
    caption = "The first 30 min after power-on: external and corrected distance."
    return Picture("fig_4_5", "Fig. 4.5", caption, tuple(panels))


def _over_time(paths: Paths, name: str, title: str) -> Panel:
    hours = paths.time / 3600
    values = {"external": paths.external, "reference": paths.reference, "corrected": paths.corrected}[name]
    return Panel(title, "time [h]", "drift [mm]", (Curve(hours, values * 1e3),))


def _temperature(paths: Paths) -> Panel:
    return Panel("temperature", "time [h]", "temperature [degC]", (Curve(paths.time / 3600, paths.ambient),))


def _cut(paths: Paths, part: Mask) -> Paths:
    return Paths(paths.time[part], paths.external[part], paths.reference[part], paths.ambient[part])


def mild_pictures(mild: Paths, through: Mask) -> tuple[Picture, ...]:
    """Return figs. 4.6-4.8; ``through`` marks the sequence of temperatures, before the rest."""
    first = _cut(mild, through)
    sequence = (
        _over_time(mild, "external", "external, 36 h"),
        _over_time(first, "external", "external, first 12 h"),
        _over_time(first, "reference", "reference, first 12 h"),
    )
    both = (
        Curve(first.ambient, first.external * 1e3, label="external", points=True),
        Curve(first.ambient, first.corrected * 1e3, label="corrected", points=True),
    )
    corrected = (
        _over_time(first, "external", "external"),
        _over_time(first, "corrected", "corrected (eq. 4.4)"),
        _over_time(mild, "corrected", "corrected, 36 h"),
    )
    return (
        Picture(
            "fig_4_6",
            "Fig. 4.6",
            "Temperatures 10, 0, 10, 20, 30, 10 degC, then to 20 degC: distances.",
            sequence,
        ),
        Picture(
            "fig_4_7",
            "Fig. 4.7",
            "Distance over temperature: the camera lags, no function of the temperature.",
            (Panel("0 to 30 degC", "temperature [degC]", "drift [mm]", both),),
        ),
        Picture("fig_4_8", "Fig. 4.8", "Correction by the reference path, 0 to 30 degC.", corrected),
    )


def wide_pictures(wide: Paths) -> tuple[Picture, ...]:
    """Return figs. 4.9 and 4.10."""
    hours = wide.time / 3600
    drifts = (
        Curve(hours, wide.external * 1e3, label="external"),
        Curve(hours, wide.reference * 1e3, label="reference"),
    )
    corrected = (
        Curve(hours, wide.external * 1e3, label="external", colour=_GREY),
        Curve(hours, wide.corrected * 1e3, label="corrected (eq. 4.4)", colour=_DARK),
    )
    return (
        Picture(
            "fig_4_9",
            "Fig. 4.9",
            "Temperatures from -10 to 40 degC: external and reference path.",
            (_temperature(wide), Panel("distances", "time [h]", "drift [mm]", drifts)),
        ),
        Picture(
            "fig_4_10",
            "Fig. 4.10",
            "Correction by the reference path, -10 to 40 degC.",
            (Panel("-10 to 40 degC", "time [h]", "drift [mm]", corrected),),
        ),
    )


def two_pictures(far: Paths, near: Paths, scale: tuple[float, float]) -> tuple[Picture, ...]:
    """Return figs. 4.11-4.13, with the scales of eq. 4.5 at both distances."""
    hours = far.time / 3600
    overview = tuple(
        Curve(hours, values * 1e3, label=label)
        for label, values in (
            ("2.81 m", far.external),
            ("1.79 m", near.external),
            ("reference", far.reference),
        )
    )
    single = tuple(
        Panel(title, "time [h]", "drift [mm]", (Curve(hours, values * 1e3),))
        for title, values in (
            ("external, 2.81 m", far.external),
            ("external, 1.79 m", near.external),
            ("reference", far.reference),
        )
    )
    corrected = tuple(
        Panel(
            title,
            "time [h]",
            "drift [mm]",
            (
                Curve(hours, paths.external * 1e3, label="external", colour=_GREY),
                Curve(hours, paths.corrected * 1e3, label="eq. 4.4", colour=_DARK),
                Curve(hours, paths.scaled(factor) * 1e3, label=f"eq. 4.5, scale {factor:.2f}"),
            ),
        )
        for title, paths, factor in (("2.81 m", far, scale[0]), ("1.79 m", near, scale[1]))
    )
    return (
        Picture(
            "fig_4_11",
            "Fig. 4.11",
            "Two targets: temperature, distances and reference.",
            (_temperature(far), Panel("distances", "time [h]", "drift [mm]", overview)),
        ),
        Picture("fig_4_12", "Fig. 4.12", "The same one by one.", single),
        Picture(
            "fig_4_13", "Fig. 4.13", "Correction by the reference path, as it is and with a scale.", corrected
        ),
    )
