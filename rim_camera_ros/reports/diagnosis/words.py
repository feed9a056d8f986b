"""Words, units and tables of the report of a diagnosis, for readers who do not know the vocabulary."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.formula import formula_terms
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.effects import SECTIONS, CovariateTable, vocabulary
from rim_camera_ros.effects.covariates import AXIS
from rim_camera_ros.effects.rows import row_name
from rim_camera_ros.reports.page import Part, Table
from rim_camera_ros.reports.words import joined, noise_words

Array = NDArray[Any]

_TITLES = {
    UNKNOWN: "physics that no known effect describes",
    CovariateTable.name: "unknown physics, as a smooth function",
}
#: Probability of named effects below which, and remaining chi-square per value above which, a verdict is
#: unsure.
_SURE, _LEFT = 0.95, 1.5
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
#: Name of a covariate -> label with unit, factor to that unit, drawn on a logarithmic axis.
_AXES = {
    "distance": ("distance [m]", 1.0, False),
    "amplitude": ("amplitude [counts]", 1.0, True),
    "row": ("row [px]", 1.0, False),
    "column": ("column [px]", 1.0, False),
    "incidence": ("angle of incidence [deg]", 180 / np.pi, False),
    "time": ("time since the first frame [s]", 1.0, False),
    "uptime": ("time since power-on [s]", 1.0, False),
    "temperature": ("camera temperature [°C]", 1.0, False),
    "ambient_temperature": ("ambient temperature [°C]", 1.0, False),
    "integration_time": ("integration time [device unit]", 1.0, False),
    "row_amplitude": ("mean amplitude of the row [counts]", 1.0, True),
    "column_amplitude": ("mean amplitude of the column [counts]", 1.0, True),
    "contrast": ("local contrast of the amplitude [-]", 1.0, False),
    "height": ("height above the camera [m]", 1.0, False),
    "edge": ("distance from the nearest edge [px]", 1.0, False),
    "saturation": ("saturated pixels in row and column [px]", 1.0, False),
    AXIS: ("angle from the optical axis [deg]", 180 / np.pi, False),
}


def title_of(effect: str) -> str:
    """Return the title of an effect, in words."""
    if effect in _TITLES:
        return _TITLES[effect]
    known = vocabulary().get(effect)
    return effect.replace("_", " ") if known is None else known.title


def label_of(effect: str) -> str:
    """Return words and, where they differ, the name in camera files."""
    title = title_of(effect)
    return title if effect in (UNKNOWN,) else f"{title} ({effect})"


def axis_of(name: str, values: Array) -> tuple[str, float, bool]:
    """Return label, factor to its unit and whether the axis is logarithmic, for values of a covariate."""
    label, factor, log = _AXES.get(name, (name, 1.0, False))
    if name in ("time", "uptime") and np.size(values) and np.nanmax(values) > 300:
        return label.replace("[s]", "[min]"), 1 / 60, False
    return label, factor, log and bool(np.nanmin(values) > 0)


def plain_name(covariate: str) -> str:
    """Return a covariate in words, without unit."""
    return _AXES.get(covariate, (covariate.replace("_", " "), 1.0, False))[0].split(" [")[0]


def verdict(result: Diagnosis) -> str:
    """Return the verdict as one sentence."""
    match result.verdict:
        case "consistent":
            return "The simulation explains this recording: no missing physics is visible."
        case "inconsistent_setup":
            reason = (result.reason or "the recording contradicts the scene").rstrip(".")
            return f"Recording, scene and camera file do not belong together: {reason}."
        case "wrong_parameters":
            names = joined([label_of(term.effect) for term in result.adjusted]) or "known effects"
            return f"No physics is missing, but the camera file has wrong parameters: {names}."
        case "unknown_physics":
            found = [effect for effect in result.missing if effect.effect == UNKNOWN]
            functions = [e for e in found if e.formula or e.model == CovariateTable.name]
            names = joined([plain_name(c) for effect in functions for c in effect.covariates])
            if found and not functions and found[0].covariates:
                # it is not described by a function of these: its sentence describes it
                said = found[0].sentence.removeprefix("unknown physics: ").split(": ")[0]
                return f"{said[:1].upper()}{said[1:]}."
            if not names:
                return "This recording differs from its simulation in a way that no known effect explains."
            return f"Distances depend on {names} in a way that no known effect explains."
    tied = {name for names in result.indistinguishable for name in names}
    sure = [label_of(effect.effect) for effect in result.missing if effect.effect not in tied]
    unsure = [
        f"one of {joined([label_of(n) for n in names], 'or')} (indistinguishable by this recording)"
        for names in result.indistinguishable
        if any(effect.effect in names for effect in result.missing)
    ]
    return f"The simulation lacks {joined([*sure, *unsure])}."


def doubts(result: Diagnosis) -> list[str]:
    """Return why the verdict is unsure, in words; nothing where it is not."""
    fit, found = result.accuracy, []
    if result.verdict == "inconsistent_setup":
        return []
    if fit.chi2_after > _LEFT:
        found.append(
            f"much of the difference stays unexplained (chi-square per value {chi(fit.chi2_after)} after "
            f"naming, {noise_words(fit.chi2_after)[0]}; noise alone: 1)"
        )
    if result.indistinguishable:
        found.append("this recording cannot distinguish some effects")
    elif result.missing and result.missing[0].probability < _SURE:
        found.append(f"the probability of what is named is {probability(result.missing[0].probability)}")
    if not fit.held_out:
        found.append("there are too few poses to check it on others")
    elif fit.got_worse:
        found.append("poses that took no part in the fit are evidence against it")
    return found


def first_line(result: Diagnosis) -> str:
    """Return the verdict, with doubts before it and what to record next after it."""
    doubted = doubts(result)
    lead = f"Unsure, as {joined(doubted)}. " if doubted else ""
    return lead + verdict(result)


def probability(value: float) -> str:
    """Return a probability in words, never as certainty."""
    if value > 0.999:
        return "above 0.999"
    return "below 0.001" if value < 0.001 else f"{value:.3f}"


def chi(value: float) -> str:
    """Return chi-square per value."""
    return f"{value:.3f}" if value < 100 else f"{value:,.0f}"


def parameter_rows(effect: Missing, camera: Camera) -> list[list[str]]:
    """Return rows of parameter, value, lower and upper end of the 95 % interval, unit, meaning."""
    rows = []
    for path, value in effect.parameters.items():
        unit, meaning = described(camera, effect.effect, path)
        interval = effect.interval.get(path)
        factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
        if interval is None:
            kept = _said(meaning, "not fitted") if effect.interval else meaning
            rows.append([path, rounded(value * factor), "-", "-", unit, kept])
            continue
        low, high = interval[0] * factor, interval[1] * factor
        digits = with_width(value * factor, low, high)
        rows.append([path, *digits, unit, meaning])
    return rows


def _said(*words: str) -> str:
    return "; ".join(word for word in words if word)


def with_width(value: float, low: float, high: float) -> list[str]:
    """Return a value and its interval with two digits of the interval's half width."""
    half = (high - low) / 2
    if not np.isfinite(half) or half <= 0:
        return [rounded(value), rounded(low), rounded(high)]
    decimals = int(1 - np.floor(np.log10(half)))
    if 0 <= decimals <= 6:
        return [f"{x:.{decimals}f}" for x in (value, low, high)]
    if decimals < 0:
        return [f"{x:.0f}" for x in (value, low, high)]
    largest = max(abs(value), abs(low), abs(high))
    digits = int(np.floor(np.log10(largest)) - np.floor(np.log10(half))) + 1
    return [power(x, max(digits, 1)) for x in (value, low, high)]


def rounded(value: float) -> str:
    """Return a number with four digits."""
    return power(value, 3) if value and not 1e-3 <= abs(value) < 1e6 else f"{value:.4g}"


def power(value: float, decimals: int) -> str:
    """Return a number with its power of ten as printed: 1.2·10⁻⁵."""
    mantissa, exponent = f"{value:.{decimals}e}".split("e")
    raised = str(int(exponent)).translate(_RAISED)
    return mantissa if int(exponent) == 0 else f"{mantissa}·10{raised}"


def described(camera: Camera, owner: str, path: str) -> tuple[str, str]:
    """Return unit and meaning of a parameter by its path within an effect or section."""
    value: Any = camera.effects.get(owner)
    if value is None:
        value = getattr(camera, SECTIONS[owner].section if owner in SECTIONS else owner, None)
    unit = meaning = ""
    parts = path.split(".")
    while parts:
        part = parts.pop(0)
        if is_dataclass(value):
            metadata: Mapping[str, Any] = next(
                (field.metadata for field in fields(value) if field.name == part), {}
            )
            unit, meaning = metadata.get("unit", ""), metadata.get("doc", "")
            value = getattr(value, part, None)
        elif isinstance(value, tuple) and part.isdigit() and int(part) < len(value):
            # "along row, along column" describes each member of a pair
            unit, meaning = (_member(text, int(part), len(value)) for text in (unit, meaning))
            value = value[int(part)]
        elif isinstance(value, Mapping):
            settings = {row_name(key): inner for key, inner in value.items()}
            if part not in settings and parts:
                part += f".{parts.pop(0)}"  # a setting of 0.5 ms
            value = settings.get(part)
    return _printed(unit), meaning


def _printed(unit: str) -> str:
    """Return a unit with raised powers, empty for none."""
    raised = re.sub(r"\^(-?[0-9])", lambda m: m[1].translate(_RAISED), unit.replace("*", "·"))
    return "" if raised == "-" else raised


def _member(text: str, number: int, count: int) -> str:
    parts = text.split(", ")
    return parts[number] if len(parts) == count else text


def adjusted_rows(result: Diagnosis) -> list[list[str]]:
    """Return rows of known terms that moved: parameter, before, after, unit; effects as headings."""
    rows: list[list[str]] = []
    for term in result.adjusted:
        rows.append([label_of(term.effect)])
        for path, before in term.before.items():
            unit, _ = described(result.camera, term.effect, path)
            factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
            after = term.after.get(path, before)
            # rows of settings that the recording does not have
            if abs(after - before) <= 1e-6 * abs(before):
                continue
            rows.append([path, rounded(before * factor), rounded(after * factor), unit])
    return rows


def formula_words(formula: str) -> str:
    """Return a closed form as printed, in mm."""
    terms = formula_terms(formula)
    covariate = formula.rsplit("x = ", 1)[-1]
    if terms is None:
        return formula
    shown = {"x^2": "x²", "x^3": "x³", "1/x": "/ x", "1/x^2": "/ x²", "sqrt(x)": "√x", "log(x)": "ln x"}
    parts: list[str] = []
    for number, form in terms:
        sign = "-" if number < 0 else "+" if parts else ""
        size = rounded(abs(number) * 1e3)
        parts.append(f"{sign} {size} {shown.get(form, form)}".strip().replace("- ", "− " if parts else "−"))
    unit = _AXES.get(covariate, ("", 1.0, False))[0].partition("[")[2].rstrip("]")
    unit = {"deg": "rad", "min": "s"}.get(unit, unit)
    return (
        f"{' '.join(parts)} mm, x = {plain_name(covariate)}{f' in {unit}' if unit not in ('', '-') else ''}"
    )


def stretches(times: Iterable[tuple[float, float]]) -> str:
    """Return stretches of time [s] in words."""
    spans = list(times)
    if len(spans) > 3:
        return f"{len(spans)} stretches of time between {spans[0][0]:.0f} s and {spans[-1][1]:.0f} s"
    words = [f"{low:.0f} s" if high - low < 1 else f"{low:.0f} to {high:.0f} s" for low, high in spans]
    return joined(words)


def unseen_table(names: Sequence[str]) -> list[Part]:
    """Return a table of effects that a recording cannot show, with what it would have to contain."""
    known = vocabulary()
    rows = [[label_of(name), known[name].observable if name in known else "-"] for name in names]
    return [Table(["effect", "what a recording must contain to show it"], rows)] if rows else []
