"""The report of a calibration: what was fitted, how well, and what the recordings do not tell."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.determined import EffectStatus
from rim_camera_ros.calibrate.held_out import Accuracy
from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.info.text import several
from rim_camera_ros.reports import html
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
_MOODS = {
    "fitted": ("fitted", "good"),
    "kept": ("kept", ""),
    "absent": ("absent", ""),
    "undetermined": ("not determined", "warn"),
    "left out": ("left out", ""),
}
_MOST_LABELS = 60


def calibration_page(result: Calibration, *, title: str) -> str:
    """Return the report of a calibration as one HTML page."""
    under = (
        f"{result.camera.device}: {several(result.frames, 'frame')} of {several(result.poses, 'pose')} in "
        f"{several(len(result.sources), 'recording')}, {result.camera.provenance.get('date', '')}"
    )
    return html.page(
        f"Calibration {title}",
        under,
        [
            _glance(result),
            _notes(result),
            html.section("What the recordings say of each effect", _effects(result)),
            html.section("Effects", _curves(result), _pattern(result)),
            html.section("Parameters", _parameters(result), _correlations(result)),
            html.section(f"Residuals of {_poses_of(_stated(result))}", *_residuals(result)),
            html.section("By a table instead of physics", _integral(result)),
            html.section("Noise", _noise(result)),
            html.section("Range of validity", _validity(result)),
            html.section("Provenance", _provenance(result)),
        ],
    )


def _mm(value: float) -> str:
    return f"{value * 1e3:.2f} mm"


def _stated(result: Calibration) -> Accuracy:
    by_table = result.integral_accuracy
    return by_table if result.integral and by_table is not None else result.accuracy


def _poses_of(one: Accuracy) -> str:
    return "held-out poses" if one.held_out else "fitted poses"


def _glance(result: Calibration) -> str:
    one = _stated(result)
    whose = f"{one.poses} held-out poses" if one.held_out else "the poses of the fit"
    items = [
        html.Card(_mm(one.after), f"RMS error of corrected mean frames, {whose}"),
        html.Card(_mm(one.systematic), "of it systematic: beyond noise and reference instrument"),
        html.Card(_mm(one.before), "RMS error by the camera file before"),
        html.Card(_mm(one.single), "predicted noise of one frame (median)"),
    ]
    chi_square = result.chi_square
    if chi_square is not None and not result.integral:
        mood = "good" if chi_square < 1.1 else "warn"
        items.append(
            html.Card(
                f"{chi_square:.3f}", "chi-square per value of held-out poses (1: down to the noise)", mood
            )
        )
    solution = result.solution
    if not result.integral:
        items.append(html.Card(f"{solution.outliers}", f"of {solution.values} distances beyond 4 sigma"))
    return html.cards(items)


def _notes(result: Calibration) -> str:
    return html.section("Notes", html.bullets(result.notes)) if result.notes else ""


def _effects(result: Calibration) -> str:
    rows = [(one.effect, *_MOODS[one.status], _words(result, one)) for one in result.statuses]
    order = list(_MOODS)
    rows.sort(key=lambda row: [_MOODS[name][0] for name in order].index(row[1]))
    words = html.paragraph(
        "Limits are for the RMS over the distances of these recordings, with 95 % probability, and hold "
        "for the forms of each effect that were tried."
    )
    return words + html.tagged(rows)


def _words(result: Calibration, one: EffectStatus) -> str:
    effect = result.camera.effects.get(one.effect)
    if one.status == "fitted" and effect is not None:
        more = one.text.removeprefix("fitted").removeprefix("; ")
        return f"{effect.sentence()}{f' ({more})' if more else ''}"
    return one.text.removeprefix("absent: ").removeprefix("cannot be determined from these recordings: ")


def _curves(result: Calibration) -> str:
    found = effect_panels(result.camera, result.paths, result.covariance, before=result.before)
    if not found:
        return ""
    caption = "The error that each effect adds to the measurement, with its band of 95 %"
    return html.figure(panels(found), caption + "; dashed: the camera file before.")


def _pattern(result: Calibration) -> str:
    effect: Any = result.camera.effects.get("fixed_pattern_offset")
    if effect is None:
        return ""
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
        f"offset "
        "of their neighbourhood."
    )
    return html.figure(picture, caption)


def _parameters(result: Calibration) -> str:
    if not result.paths:
        return ""
    before, after, sigma = camera_numbers(result.before), camera_numbers(result.camera), result.sigma
    rows: list[list[str]] = []
    for owner, paths in groupby(result.paths, key=owner_of):
        rows.append([owner])
        for path in paths:
            name = path.removeprefix(f"effects.{owner}.").removeprefix(f"{owner}.")
            digits = significant(after.get(path), sigma[path])
            rows.append([name, number_of(before.get(path)), *digits, unit_of(result.camera, path)])
    words = ""
    untold = [] if result.integral else result.solution.untold()
    kept = [one for one in untold if one in before and before[one] == after.get(one)]
    for names, why in (
        (kept, "as in the file before"),
        ([one for one in untold if one not in kept], "set by what was known before"),
    ):
        if names:
            told = ", ".join(one.removeprefix("effects.") for one in names)
            words += html.paragraph(f"Not determined by these recordings, {why}: {told}.")
    factor = result.solution.factor
    scaled = (
        f" They are scaled by the square root of {factor:.2f}, chi-square per value." if factor > 1.01 else ""
    )
    return (
        html.paragraph(
            "Standard deviations are 1 sigma, errors of poses and fixed pattern included." + scaled
        )
        + html.table(["parameter", "before", "after", "± sigma", "unit"], rows, numbers=(1, 2, 3))
        + words
    )


def _correlations(result: Calibration) -> str:
    if len(result.paths) < 2:
        return ""
    sigma = np.sqrt(np.diag(result.covariance))
    values = result.covariance / sigma[:, None] / sigma[None, :]
    labels = [one.removeprefix("effects.") for one in result.paths]
    content = ""
    if len(labels) <= _MOST_LABELS:
        content += html.figure(matrix(labels, values), "Correlations of the parameters.")
    if result.correlations:
        rows = [
            [a.removeprefix("effects."), b.removeprefix("effects."), f"{value:+.3f}"]
            for a, b, value in result.correlations
        ]
        content += html.folded(
            several(len(rows), "correlation") + " above 0.9",
            html.table(["parameter", "and", "correlation"], rows, numbers=(2,)),
        )
    return "<h3>Correlations</h3>" + content


def _residuals(result: Calibration) -> list[str]:
    one = _stated(result)
    if not one.samples:
        return []
    shown = []
    for name, label, log in _COVARIATES:
        values = one.samples[name].astype(float)
        known = values[np.isfinite(values)]
        if not known.size or np.ptp(known) <= 1e-6 * max(1.0, float(np.abs(known).max())):
            continue
        shown.append(Covariate(label, np.degrees(values) if name == "incidence" else values, log))
    before, after, expected = (one.samples[name] * 1e3 for name in ("before", "after", "expected"))
    held = (
        "by a camera fitted without their fold of poses" if one.held_out else "by the camera fitted to them"
    )
    parts = [
        html.paragraph(
            "Mean frames of each pose against the scene: corrected by the camera file before (left), and "
            f"{held} (right). Dots: medians; band: the middle 68 %; dashed: what noise alone makes."
        ),
        html.figure(residuals(shown, before, after, expected=expected), ""),
    ]
    limit = float(np.nanquantile(np.abs(one.maps["after"]), 0.98)) * 1e3
    parts.append(
        html.figure(
            maps(
                [
                    Map("mean error before", one.maps["before"] * 1e3),
                    Map("mean error after", one.maps["after"] * 1e3, limit),
                    Map("RMS error after", one.maps["rms"] * 1e3, from_zero=True),
                ],
                "mm",
            ),
            f"Over the array, mean of the {_poses_of(one)}. Each picture has its own scale.",
        )
    )
    low, high = np.quantile(one.samples["distance"], [0.002, 0.998])
    rows = [
        [f"{c.low:.2f} .. {c.high:.2f}", str(c.values), _mm(c.before), _mm(c.after), _mm(c.expected)]
        for c in one.classes("distance", np.linspace(low, high, 9).tolist())
    ]
    headings = ["distance [m]", "values", "RMS before", "RMS after", "noise alone"]
    parts.append(html.table(headings, rows, numbers=range(5)))
    return parts


def _integral(result: Calibration) -> str:
    table = result.integral_accuracy
    if table is None:
        return ""
    joint = result.accuracy
    rows = [
        ["effects, fitted together", _mm(joint.after), _mm(joint.systematic)],
        ["table over column, row, distance", _mm(table.after), _mm(table.systematic)],
    ]
    words = (
        "The integral calibration (Kahlmann 2007, sec. 3.4): errors by position as a smooth table with an "
        "offset per pixel, from the same poses. It knows neither amplitude nor angle, setting or time."
    )
    used = " The camera file holds the table." if result.integral else ""
    headings = [_poses_of(table), "RMS error", "systematic"]
    return html.paragraph(words + used) + html.table(headings, rows, numbers=(1, 2))


def _noise(result: Calibration) -> str:
    fit = result.noise
    if fit is None:
        return html.paragraph("There are too few repeated frames: noise as in the camera file before.")
    x = np.array([one.amplitude for one in fit.classes])
    grid = np.geomspace(x.min(), x.max(), 200)
    background = result.before.background
    curves = [
        Curve(grid, fit.noise.sigma_distance(grid, background=background) * 1e3, None, "model", colour=AFTER),
        Curve(
            x,
            np.array([one.sigma for one in fit.classes]) * 1e3,
            np.array([one.error for one in fit.classes]) * 1e3,
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
    return html.paragraph(words) + html.figure(panels([panel], width=5.2, height=3.0), "")


def _validity(result: Calibration) -> str:
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
    return html.paragraph(words) + html.table(["of", "range", "unit"], rows, numbers=(1,)) if rows else ""


def _provenance(result: Calibration) -> str:
    rows = [[one.path, str(one.frames), str(one.poses), one.sha256] for one in result.sources]
    command = result.camera.provenance.get("command", "")
    said = f"<p><code>{html.text(command)}</code></p>" if command else ""
    program = result.camera.provenance.get("program", "")
    return (
        said
        + html.paragraph(f"{program}, {result.camera.provenance.get('date', '')}")
        + html.table(["recording", "frames", "poses", "sha256"], rows, numbers=(1, 2))
    )
