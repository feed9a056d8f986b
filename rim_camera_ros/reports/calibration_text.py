"""The result of a calibration on a terminal: table of parameters, accuracy, what is not determined."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from itertools import groupby
from typing import Any

from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.info.text import section, table, wrapped

_CORRELATIONS = 8


def calibration_text(result: Calibration) -> str:
    """Return the table of results for a terminal."""
    parts = []
    if result.paths:
        parts.append(parameter_table(result))
    parts.append(accuracy_text(result))
    if result.correlations:
        shown = [f"{a} and {b}: {value:+.3f}" for a, b, value in result.correlations[:_CORRELATIONS]]
        more = len(result.correlations) - len(shown)
        shown += [f"and {more} more, see the report"] if more > 0 else []
        parts.append("correlations above 0.9\n" + wrapped(_short(one) for one in shown))
    for heading, status in (
        ("absent or not fitted", ("absent", "left out")),
        ("not determined by these recordings", ("undetermined",)),
        ("kept as in the file", ("kept",)),
    ):
        lines = [
            (effect_status.effect, _plain(effect_status.text))
            for effect_status in result.statuses
            if effect_status.status in status
        ]
        if (
            status == ("undetermined",)
            and not result.integral
            and (undetermined := result.solution.undetermined())
        ):
            lines.append(("of the parameters", ", ".join(_short(name) for name in undetermined)))
        if lines:
            parts.append(section(heading, lines))
    return "\n\n".join(parts)


def parameter_table(result: Calibration) -> str:
    """Return the fitted parameters by effect: before, after, 1-sigma, unit."""
    before, after, sigma = camera_numbers(result.before), camera_numbers(result.camera), result.sigma
    rows: list[list[str]] = []
    for owner, paths in groupby(result.paths, key=owner_of):
        rows.append([owner, "", "", "", ""])
        for path in paths:
            name = path.removeprefix(f"effects.{owner}.").removeprefix(f"{owner}.")
            digits = significant(after.get(path), sigma[path])
            rows.append([f"  {name}", number_of(before.get(path)), *digits, unit_of(result.camera, path)])
    return table(["parameter", "before", "after", "+- sigma", "unit"], rows, indent="")


def accuracy_text(result: Calibration) -> str:
    """Return the accuracy on held-out poses in lines."""
    accuracy = result.integral_accuracy if result.integral and result.integral_accuracy else result.accuracy
    whose = (
        f"{accuracy.poses} held-out poses"
        if accuracy.held_out
        else "the fitted poses (too few to hold any out)"
    )
    lines = [
        ("as measured", f"{accuracy.raw * 1e3:.2f} mm RMS"),
        ("by the file before", f"{accuracy.before * 1e3:.2f} mm RMS"),
        ("corrected", f"{accuracy.after * 1e3:.2f} mm RMS"),
        (
            "of which noise",
            f"{accuracy.noise * 1e3:.2f} mm, reference instrument {accuracy.reference * 1e3:.2f} mm",
        ),
        ("systematic", f"{accuracy.systematic * 1e3:.2f} mm"),
        (
            "apart from offset and tilts of each pose",
            f"{accuracy.rigid_before * 1e3:.2f} mm before, {accuracy.rigid_after * 1e3:.2f} mm RMS corrected",
        ),
    ]
    table_ = result.integral_accuracy
    if table_ is not None and not result.integral:
        lines.append(
            (
                "by a table instead",
                f"{table_.after * 1e3:.2f} mm RMS, systematic {table_.systematic * 1e3:.2f}",
            )
        )
    chi_square = result.chi_square
    # those of the effects, which the table replaces
    if chi_square is not None and not result.integral:
        lines.append(("chi-square per value", f"{chi_square:.3f} (1: down to the noise)"))
    if not result.integral:
        outliers = f"{result.solution.outliers} of {result.solution.values} distances"
        lines.append(("beyond 4 sigma", outliers))
    if result.noise is not None:
        what = "confirmed" if result.noise.confirmed else "fitted"
        own = result.noise.noise
        lines.append(
            (
                "noise",
                f"{what}: floor {own.floor * 1e3:.3g} mm, shot {own.shot:.3g}, amplitude {own.amplitude:.4g}",
            )
        )
    return section(f"distances of {whose}", lines)


def owner_of(path: str) -> str:
    """Return the effect or section of a dotted path."""
    parts = path.split(".")
    return parts[1] if parts[0] == "effects" else parts[0]


def _plain(text: str) -> str:
    return text.removeprefix("absent: ").removeprefix("cannot be determined from these recordings: ")


def _short(text: str) -> str:
    return text.replace("effects.", "")


def number_of(value: float | None) -> str:
    """Return a number with six digits, a dash for none."""
    return "-" if value is None else f"{value:.6g}"


def significant(value: float | None, sigma: float) -> list[str]:
    """Return value and sigma as text, the sigma with two digits and the value with as many decimals."""
    if value is None or not sigma > 0:
        return [number_of(value), number_of(sigma)]
    from math import floor, log10

    decimals = 1 - floor(log10(sigma))
    if 0 <= decimals <= 7:
        return [f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"]
    if decimals < 0:
        return [f"{value:.0f}", f"{sigma:.0f}"]
    digits = max(2, floor(log10(max(abs(value), sigma))) - floor(log10(sigma)) + 2)
    return [f"{value:.{digits - 1}e}", f"{sigma:.1e}"]


def unit_of(camera: Camera, path: str) -> str:
    """Return the unit of a parameter by its dotted path, empty where it has none."""
    owner, _, rest = path.removeprefix("effects.").partition(".")
    value: Any = camera.effects.get(owner) if path.startswith("effects.") else getattr(camera, owner, None)
    unit = ""
    for part in rest.split("."):
        if is_dataclass(value):
            known = {field.name: field.metadata.get("unit", "") for field in fields(value)}
            unit = known.get(part, unit) or unit
            value = getattr(value, part, None)
        elif isinstance(value, tuple) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        elif hasattr(value, "items"):
            value = {f"{key:g}": one for key, one in value.items()}.get(part)
        else:
            break
    parts = unit.split(", ")
    last = path.rsplit(".", 1)[-1]
    if len(parts) > 1 and last.isdigit() and int(last) < len(parts):
        unit = parts[int(last)]
    return "" if unit == "-" else unit
