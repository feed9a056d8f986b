"""The sections of a diagnosis' report on candidates: the gain of each, and gains by chance."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.diagnose.result import Diagnosis, Ranked
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.reports.diagnosis import words
from rim_camera_ros.reports.page import Figure, Folded, Part
from rim_camera_ros.reports.words import joined
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.thresholds import ALARM_RATE

_MOST_SMOOTH = 3
#: Share of an effect's energy that is identifiable, above which it is not stated.
_PLAIN = 0.2
#: Label, gain [nats], own threshold, kind of bar.
Row = tuple[str, float, float | None, str]

_GAIN = (
    "Gain: how much more probable poses become that the model was not fitted to, as a natural logarithm "
    "(nats): 1 is a factor of 2.7, 10 one of 22,000. "
)


def _with_share(rival: Ranked) -> str:
    label = words.label_of(rival.effect)
    if rival.identifiability is None or rival.identifiability > _PLAIN:
        return label
    return f"{label} ({rival.identifiability:.1%})"


def ranking(result: Diagnosis) -> list[Part]:
    """Return the gains of candidates given the named effects; without names, of each alone."""
    alone = _alone(result)
    if not result.found or result.final is result.baseline:
        return alone
    from rim_camera_ros.reports.diagnosis import figures

    step = result.final
    found = {finding.effect for finding in result.found}
    rows: list[Row] = [
        (f"{words.label_of(finding.effect)}: named {_order(i)}", finding.gain, None, "named")
        for i, finding in enumerate(result.found)
    ]
    rest: list[Row] = [
        (words.label_of(effect), float(step.gains[k]), float(step.thresholds[k]), "other")
        for effect, k in step.best().items()
        if effect not in found
    ]
    rest += [(_smooth_label(variant), gain, own, "smooth") for gain, variant, own in _smooth(step)]
    rest.sort(key=lambda row: -row[1])
    over = [row[0] for row in rest if row[2] is not None and row[1] > row[2] and row[3] == "other"]
    caption = (
        f"{_GAIN}Coloured: what is named, each given those above it. Below: what every further effect would "
        "gain given all that is named; red: what chance may bring it. "
        + (
            f"Beyond that {'are' if len(over) > 1 else 'is'} {joined(over)}, but the poses do not agree that "
            "it gains, or it is a part of what is named in another form. "
            if over
            else "No other exceeds it. "
        )
        + "Sand: smooth functions without physics, as a check of the vocabulary. Logarithmic."
    )
    best = f"; given it, the most: {rest[0][0]}, {max(rest[0][1], 0.0):,.0f} nats" if rest else ""
    alt = f"Bars of what is named ({joined(sorted(found))}) and of what further effects would gain{best}"
    picture = figures.ranking([*rows, *rest], threshold=step.threshold)
    return [Figure(picture, alt, caption), Folded("What each would gain alone, with nothing named", alone)]


def _order(number: int) -> str:
    return ("first", "second", "third")[number] if number < 3 else f"as number {number + 1}"


def _smooth(step: Exploration) -> list[tuple[float, str, float]]:
    """Return gain, covariates and threshold of the best smooth functions."""
    rows = (
        (float(step.gains[k]), step.candidates[k].variant, float(step.thresholds[k]))
        for k in range(step.named, len(step.candidates))
    )
    return sorted(rows, reverse=True)[:_MOST_SMOOTH]


def _smooth_label(variant: str) -> str:
    return f"any smooth function of {joined([words.plain_name(name) for name in variant.split(',')])}"


def _alone(result: Diagnosis) -> list[Part]:
    """Return the gain of each candidate alone."""
    from rim_camera_ros.reports.diagnosis import figures

    step = result.baseline
    own = {effect: float(step.thresholds[k]) for effect, k in step.best().items() if step.thresholds.size}
    named = {effect.effect for effect in result.missing}
    rows: list[Row] = [
        (_with_share(rival), rival.gain, own.get(rival.effect), "named" if rival.effect in named else "other")
        for rival in result.ranking
    ]
    smooth = _smooth(step)
    dependent = {c for effect in result.missing if effect.effect == UNKNOWN for c in effect.covariates}
    for gain, variant, threshold in smooth:
        kind = "named" if dependent and set(variant.split(",")) <= dependent else "smooth"
        rows.append((_smooth_label(variant), gain, threshold, kind))
    if not rows:
        return []
    if any(kind == "named" for _, _, _, kind in rows[len(result.ranking) :]):
        # the smooth function is the unknown physics: one row suffices
        rows = [row for row in rows if row[0] != words.label_of(UNKNOWN)]
    rows.sort(key=lambda row: -row[1])
    absent = len([row for row in rows if row[3] == "named"]) == 0
    caption = (
        f"{_GAIN}Here of each effect alone, everything else fitted with it; logarithmic. "
        "Red: its threshold; with nothing missing chance brings one effect or another beyond its own in "
        "about 2 % of recordings. "
        + ("No effect is named." if absent else "Coloured: what is named.")
        + " Sand: smooth functions without physics, as a check of the vocabulary. "
        "In brackets, where it is small: the share of an effect's signal that no other parameter could "
        "imitate in this recording; a large effect is still seen by a small share."
    )
    alt = f"Bars of what each effect alone would gain; the most: {rows[0][0]}, {rows[0][1]:,.0f} nats"
    return [Figure(figures.ranking(rows, threshold=step.threshold), alt, caption)]


def nulls(result: Diagnosis) -> list[Part]:
    """Return the gains by chance alone, with those of the best effects."""
    from rim_camera_ros.reports.diagnosis import figures

    items = []
    steps = [result.baseline] if result.final is result.baseline else [result.baseline, result.final]
    for step in steps:
        if not step.null_maxima.size or not step.named:
            continue
        leader, k = next(iter(step.best().items()))
        limit = (float(step.thresholds[k]), "its threshold")
        rare = float(np.quantile(step.null_maxima, 1 - ALARM_RATE))
        score = (float(step.gains[k]), f"best effect, {leader}")
        title = "before" if step is result.baseline else "after: is anything left?"
        items.append((title if len(steps) > 1 else "", step.null_maxima, limit, score, rare))
    if not items:
        return []
    caption = (
        "Grey: the best gain of any effect in recordings simulated from the fitted camera, with noise and "
        "errors of poses like those found but nothing missing. Red: what the best effect must exceed; "
        "dashed: what any effect exceeds by chance in 2 % of the cases. Effects that gain much by chance "
        "have high thresholds of their own (marks above)."
    )
    if len(steps) > 1:
        caption += (
            " A further effect must also gain two standard errors of its gains over groups of poses, "
            "and more than any smooth curve of what the effects before it depend on."
        )
    return [
        Figure(
            figures.nulls(items),
            "Histograms of the best gain by chance, with that of the best effect",
            caption,
        )
    ]
