"""The sections of a calibration's report that go into detail."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.held_out import Accuracy
from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.effects import PixelMap
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.info.text import several
from rim_camera_ros.reports.calibration_text import number_of, owner_of, significant, unit_of
from rim_camera_ros.reports.curves import effect_panels
from rim_camera_ros.reports.figures import (
    AFTER,
    BEFORE,
    Covariate,
    Curve,
    Map,
    Panel,
    maps,
    matrix,
    panels,
    residuals,
)
from rim_camera_ros.reports.page import Code, Figure, Folded, Heading, Part, Table, Text
from rim_camera_ros.reports.words import joined

Array = NDArray[Any]

#: Name, label, spaced in proportion: covariates over which residuals are shown where they vary.
_COVARIATES = (
    ("distance", "distance [m]", False),
    ("amplitude", "amplitude [counts]", True),
    ("incidence", "angle of incidence [deg]", False),
    ("column", "column [px]", False),
    ("row", "row [px]", False),
    ("integration_time", "integration time", False),
    ("time", "time in the recording [s]", False),
    ("uptime", "time since power-on [s]", False),
    ("ambient_temperature", "ambient temperature [°C]", False),
    ("temperature", "camera temperature [°C]", False),
)
_MOST_LABELS = 60


def in_mm(value: float) -> str:
    """Return a length [m] in mm."""
    return f"{value * 1e3:.2f} mm"


def stated(result: Calibration) -> Accuracy:
    """Return the accuracy of the file that is written: with the effects, or with the table."""
    by_table = result.integral_accuracy
    return by_table if result.integral and by_table is not None else result.accuracy


def poses_of(accuracy: Accuracy) -> str:
    """Return the poses of an accuracy, in words."""
    return "held-out poses" if accuracy.held_out else "fitted poses"


def curves(result: Calibration) -> list[Part]:
    """Return each effect as a curve."""
    found = effect_panels(result.camera, result.paths, result.covariance, before=result.before)
    if not found:
        return []
    caption = "The error that each effect adds to the measurement, with its band of 95 %"
    alt = f"Curves of {joined([panel.title for panel in found])}"
    return [Figure(panels(found), alt, caption + "; dashed: the camera file before.")]


def pattern(result: Calibration) -> list[Part]:
    """Return the offset of each pixel."""
    effect = effect_of(result.camera, PixelMap)
    if effect is None:
        return []
    values = effect.map.values.astype(float) * 1e3
    centre = float(np.median(values))
    sigma = np.sqrt(result.pattern_variance) * 1e3
    sigma = np.where(np.isfinite(sigma), sigma, np.nan)
    picture = maps(
        [
            Map(f"fixed pattern, less its median of {centre:+.1f} mm", values - centre),
            Map("its standard deviation by the noise", sigma, from_zero=True),
        ],
        "mm",
    )
    caption = (
        f"Offset per pixel: {np.std(values):.2f} mm RMS. White: pixels that no pose covers; they have the "
        "offset of their neighbourhood."
    )
    return [Figure(picture, "Maps of the offset of each pixel and of its standard deviation", caption)]


def parameters(result: Calibration) -> list[Part]:
    """Return the fitted parameters."""
    if not result.paths:
        return []
    before, after, sigma = camera_numbers(result.before), camera_numbers(result.camera), result.sigma
    rows: list[list[str]] = []
    for owner, paths in groupby(result.paths, key=owner_of):
        rows.append([owner])
        for path in paths:
            name = path.removeprefix(f"effects.{owner}.").removeprefix(f"{owner}.")
            digits = significant(after.get(path), sigma[path])
            rows.append([name, number_of(before.get(path)), *digits, unit_of(result.camera, path)])
    words: list[Part] = []
    undetermined = [] if result.integral else result.solution.undetermined()
    kept = [path for path in undetermined if path in before and before[path] == after.get(path)]
    for names, why in (
        (kept, "as in the file before"),
        ([path for path in undetermined if path not in kept], "set by what was known before"),
    ):
        if names:
            names_said = ", ".join(path.removeprefix("effects.") for path in names)
            words.append(Text(f"Not determined by these recordings, {why}: {names_said}."))
    factor = result.solution.factor
    said = "Sigma is one standard deviation, errors of poses and fixed pattern included."
    if factor > 1.01:
        said += f" All are {np.sqrt(factor):.2f} times wider, as residuals exceed the noise by that factor."
    if any("gon" in row[-1] for row in rows):
        said += " An angle of 1 gon is 1/400 of a full turn: 100 gon = 90°."
    return [
        Text(said),
        Table(["parameter", "before", "after", "± sigma", "unit"], rows, numbers=(1, 2, 3)),
        *words,
    ]


def correlations(result: Calibration) -> list[Part]:
    """Return the correlations of the parameters."""
    if len(result.paths) < 2:
        return []
    sigma = np.sqrt(np.diag(result.covariance))
    values = result.covariance / sigma[:, None] / sigma[None, :]
    labels = [path.removeprefix("effects.") for path in result.paths]
    content: list[Part] = [Heading("Correlations")]
    if len(labels) <= _MOST_LABELS:
        alt = f"Matrix of the correlations of {len(labels)} parameters"
        content.append(Figure(matrix(labels, values), alt, "Correlations of the parameters."))
    if result.correlations:
        rows = [
            [a.removeprefix("effects."), b.removeprefix("effects."), f"{value:+.3f}"]
            for a, b, value in result.correlations
        ]
        table = Table(["parameter", "and", "correlation"], rows, numbers=(2,))
        content.append(Folded(f"{several(len(rows), 'correlation')} above 0.9", [table]))
    return content


def errors_over(result: Calibration) -> list[Part]:
    """Return the errors before and after over covariates."""
    accuracy = stated(result)
    if not accuracy.samples:
        return []
    shown = []
    for name, label, log in _COVARIATES:
        values = accuracy.samples[name].astype(float)
        known = values[np.isfinite(values)]
        if not known.size or np.ptp(known) <= 1e-6 * max(1.0, float(np.abs(known).max())):
            continue
        shown.append(Covariate(label, np.degrees(values) if name == "incidence" else values, log))
    before, after, expected = (accuracy.samples[name] * 1e3 for name in ("before", "after", "expected"))
    held = (
        "by a camera fitted without their fold of poses"
        if accuracy.held_out
        else "by the camera fitted to them"
    )
    caption = (
        "Mean frames of each pose against the scene: corrected by the camera file before (left), and "
        f"{held} (right). Dots: medians; band: the middle 68 %; dashed: expected from noise alone."
    )
    alt = f"Errors before and after over {joined([covariate.label for covariate in shown])}"
    parts: list[Part] = [Figure(residuals(shown, before, after, expected=expected), alt, caption)]
    limit = float(np.nanquantile(np.abs(accuracy.maps["after"]), 0.98)) * 1e3
    parts.append(
        Figure(
            maps(
                [
                    Map("mean error before", accuracy.maps["before"] * 1e3),
                    Map("mean error after", accuracy.maps["after"] * 1e3, limit),
                    Map("RMS error after", accuracy.maps["rms"] * 1e3, from_zero=True),
                ],
                "mm",
            ),
            "Maps of the mean error before and after, and of the RMS error after",
            f"Over the array, mean of the {poses_of(accuracy)}. Each picture has its own scale.",
        )
    )
    low, high = np.quantile(accuracy.samples["distance"], [0.002, 0.998])
    rows = [
        [
            f"{c.low:.2f} .. {c.high:.2f}",
            str(c.values),
            in_mm(c.before),
            in_mm(c.after),
            in_mm(c.expected),
        ]
        for c in accuracy.classes("distance", np.linspace(low, high, 9).tolist())
    ]
    headings = ["distance [m]", "values", "RMS before", "RMS after", "noise alone"]
    parts.append(Table(headings, rows, numbers=range(5)))
    return parts


def by_table(result: Calibration) -> list[Part]:
    """Return a table by position in comparison."""
    table = result.integral_accuracy
    if table is None:
        return []
    joint = result.accuracy
    rows = [
        ["effects, fitted together", in_mm(joint.after), in_mm(joint.systematic)],
        ["table over column, row, distance", in_mm(table.after), in_mm(table.systematic)],
    ]
    words = (
        "The integral calibration (Kahlmann 2007, sec. 3.4): errors by position as a smooth table with an "
        "offset per pixel, from the same poses. It knows neither amplitude nor angle, setting or time."
    )
    used = " The camera file holds the table." if result.integral else ""
    headings = [poses_of(table), "RMS error", "systematic"]
    return [Text(words + used), Table(headings, rows, numbers=(1, 2))]


def noise(result: Calibration) -> list[Part]:
    """Return the noise by repeated frames."""
    fit = result.noise
    if fit is None:
        return [Text("There are too few repeated frames: noise as in the camera file before.")]
    x = np.array([group.amplitude for group in fit.classes])
    grid = np.geomspace(x.min(), x.max(), 200)
    background = result.before.background
    curves = [
        Curve(grid, fit.noise.sigma_distance(grid, background=background) * 1e3, None, "model", colour=AFTER),
        Curve(
            x,
            np.array([group.sigma for group in fit.classes]) * 1e3,
            np.array([group.error for group in fit.classes]) * 1e3,
            "repeated frames",
            points=True,
            colour="#1d2733",
        ),
    ]
    if not fit.confirmed:
        old = fit.before.sigma_distance(grid, background=background) * 1e3
        curves.insert(1, Curve(grid, old, None, "model before", colour=BEFORE, dashed=True))
    panel = Panel(
        "noise of one distance", "amplitude [counts]", "sigma [mm]", tuple(curves), log=True, log_y=True
    )
    own = fit.noise
    verdict = "The model of the file is confirmed" if fit.confirmed else "Fitted to repeated frames"
    words = (
        f"{verdict}: floor {own.floor * 1e3:.3g} mm, shot {own.shot:.3g} m sqrt(counts), amplitude "
        f"{own.amplitude:.4g} m counts; RMS of the classes about the model {fit.misfit:.1%}."
    )
    alt = "Standard deviation of one distance over the amplitude: repeated frames and the model"
    return [Text(words), Figure(panels([panel], width=5.2, height=3.0), alt)]


def validity(result: Calibration) -> list[Part]:
    """Return the range that the recordings cover."""
    limits = result.camera.validity
    rows = []
    for name, unit in (
        ("distance", "m"),
        ("amplitude", "counts"),
        ("integration_time", ""),
        ("temperature", "°C, ambient"),
        ("region", "px: u0 v0 u1 v1"),
    ):
        value = getattr(limits, name)
        if value is not None:
            rows.append([name.replace("_", " "), " .. ".join(f"{x:g}" for x in value), unit])
    words = "Supported by the data; outside, corrected pixels are flagged (bit 8)."
    return [Text(words), Table(["of", "range", "unit"], rows, numbers=(1,))] if rows else []


def provenance(result: Calibration) -> list[Part]:
    """Return the sources of the calibration."""
    rows = [[source.path, str(source.frames), str(source.poses), source.sha256] for source in result.sources]
    command = result.camera.provenance.get("command", "")
    program = result.camera.provenance.get("program", "")
    return [
        *([Code(command)] if command else []),
        Text(f"{program}, {result.camera.provenance.get('date', '')}"),
        Table(["recording", "frames", "poses", "sha256"], rows, numbers=(1, 2)),
    ]
