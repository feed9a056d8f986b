"""The table of what the tool must reach, from the results of all cases."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from .plan import FAINT, TWICE
from .score import (
    Rate,
    Result,
    confidently_wrong,
    covered,
    explained_share,
    first_word,
    identifiability,
    inside_rivals,
    median_interval,
    named,
    named_right,
    named_wrongly,
    rate,
    seen,
    truth_of,
)
from .sensitivity import Curves, fit_curves

SINGLE = ("plain", "masked", FAINT)
#: Effects of at least this strength count whatever is visible, so that never seeing one is no excuse.
CERTAIN = 1.5
WIDEST_REGION = 0.6
CONCEALED = 0.02


@dataclass(frozen=True)
class Row:
    """One line of the table: measure, demand in words, measured value with interval, whether met."""

    measure: str
    demand: str
    value: str
    met: bool | None


@dataclass
class Score:
    """All that the page tells."""

    rows: list[Row]
    tiers: list[tuple[str, Rate, Rate, Rate, Rate]]
    effects: list[tuple[str, dict[str, Rate], Rate]]
    seen: Curves
    named: Curves
    misses: list[Result]
    sizes: list[tuple[Result, Result]]
    counted: list[Result] = field(default_factory=list)


def label(result: Result) -> str:
    """The truth as one word for tables: `null`, an effect, `a + b`, or the name of the physics outside."""
    return " + ".join(sorted(result["truth"]["effects"])) or "null"


def local_strength(result: Result) -> float:
    """RMS of the effect over its own pixel's sigma."""
    return float(result["truth"]["strength_local"])


def score(results: Iterable[Result]) -> Score:
    """Score the results of a run."""
    everything = list(results)
    results = [one for one in everything if one["case"]["kind"] != TWICE]
    kinds: dict[str, list[Result]] = defaultdict(list)
    for one in results:
        kinds[one["case"]["kind"]].append(one)
    single = [one for kind in (*SINGLE, "unknown") for one in kinds[kind]]
    curves = fit_curves(_pairs(single, by=seen))
    named_curves = fit_curves(_pairs(single, by=named_right))
    visible = [one for kind in SINGLE for one in kinds[kind] if is_visible(one, curves)]
    outside = [one for one in kinds["unknown"] if is_visible(one, curves)]
    rows = [
        *_named_rows(visible),
        _at_most("alarm although nothing is missing", kinds["null"], 0.05, lambda one: not named_right(one)),
        _at_least(
            "*unknown* said for physics outside the vocabulary, at twice the smallest visible size",
            outside,
            0.90,
            named_right,
        ),
        _at_least("two effects at once, both right", kinds["two"], 0.80, named_right),
        *_explained_rows(results),
        _coverage_row(results),
        _overlap_row(results),
        *_concealed_rows(results),
    ]
    return Score(
        rows=rows,
        tiers=[
            (kind, *(rate(map(flag, ones)) for flag in (seen, named_right, named_wrongly, inside_rivals)))
            for kind, ones in kinds.items()
            if ones
        ],
        effects=_by_effect(results),
        seen=curves,
        named=named_curves,
        misses=[one for one in everything if not named_right(one)],
        sizes=_sizes(everything),
        counted=visible,
    )


def is_visible(result: Result, curves: Curves) -> bool:
    """At least twice the smallest visible size of its effect, or so strong that it counts in any case."""
    truth = result["truth"]
    point = curves.points.get(label(result))
    certain = min(truth["strength"].values()) >= CERTAIN
    return certain or (point is not None and local_strength(result) >= 2.0 * point)


def _pairs(results: Iterable[Result], *, by: Callable[[Result], bool]) -> dict[str, list[tuple[float, bool]]]:
    pairs: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    for one in results:
        pairs[label(one)].append((local_strength(one), by(one)))
    return dict(pairs)


def written(one: Rate) -> str:
    """`93 of 100 = 93.0 % (86.3 to 96.6)`."""
    if not one.count:
        return "no cases"
    low, high = one.interval
    return f"{one.successes} of {one.count} = {one.share:.1%} ({low * 100:.1f} to {high * 100:.1f})".replace(
        "%", " %"
    )


def _at_least(measure: str, ones: Sequence[Result], figure: float, flag: Callable[[Result], bool]) -> Row:
    found = rate(map(flag, ones))
    return Row(measure, f"≥ {figure:.0%}".replace("%", " %"), written(found), found.meets(at_least=figure))


def _at_most(measure: str, ones: Sequence[Result], figure: float, flag: Callable[[Result], bool]) -> Row:
    found = rate(map(flag, ones))
    return Row(measure, f"≤ {figure:.0%}".replace("%", " %"), written(found), found.meets(at_most=figure))


def _named_rows(visible: Sequence[Result]) -> list[Row]:
    return [
        _at_least(
            "missing effect named, single, at twice the smallest visible size", visible, 0.95, named_right
        ),
        _at_most("the same, named wrongly", visible, 0.02, named_wrongly),
        _at_least("the same, truth inside the reported set of rivals", visible, 0.98, inside_rivals),
    ]


def _explained_rows(results: Sequence[Result]) -> list[Row]:
    shares = [share for one in results if (share := explained_share(one)) is not None]
    measure = "held-out variance explained, relative to the truth refitted"
    if not shares:
        return [Row(measure, "≥ 90 %", "no cases", None)]
    middle, low, high = median_interval(shares)
    found = rate(share >= 0.9 for share in shares)
    return [
        Row(
            measure + " (median)",
            "≥ 90 %",
            f"{middle:.1%} ({low * 100:.1f} to {high * 100:.1f}), {len(shares)} cases".replace("%", " %"),
            middle >= 0.9,
        ),
        Row("the same, cases in which it is at least 90 %", "-", written(found), None),
    ]


def _coverage_row(results: Sequence[Result]) -> Row:
    flags = [inside for one in results for _, inside in covered(one)]
    found = rate(flags)
    return Row(
        "truth inside the 95 % interval",
        "90 to 98 %",
        written(found),
        found.meets(at_least=0.90, at_most=0.98),
    )


def _overlap_row(results: Sequence[Result]) -> Row:
    measure = "overlap (IoU) of the reported and the true region, after naming (median)"
    values = [one["iou"] for one in overlapping(results)]
    if not values:
        return Row(measure, "≥ 0.9", "no cases", None)
    middle, low, high = median_interval(values)
    written_out = f"{middle:.2f} ({low:.2f} to {high:.2f}), {len(values)} cases"
    return Row(measure, "≥ 0.9", written_out, middle >= 0.9)


def overlapping(results: Iterable[Result]) -> list[Result]:
    """Cases whose region is compared: named right, truly below 60 % of the array."""
    return [
        one
        for one in results
        if one.get("iou") is not None
        and one["case"]["kind"] != TWICE
        and one["true_region"] < WIDEST_REGION
        and named_right(one)
        and truth_of(one)
    ]


def _concealed_rows(results: Sequence[Result]) -> list[Row]:
    ones = [one for one in results if is_concealed(one)]
    wrong = rate(map(confidently_wrong, ones))
    named_or_tied = rate(inside_rivals(one) for one in ones)
    return [
        Row(
            "concealed cases confidently wrong",
            "none",
            written(wrong),
            wrong.successes == 0 if wrong.count else None,
        ),
        Row(
            "concealed cases named, or indistinguishable from what is named",
            "-",
            written(named_or_tied),
            None,
        ),
    ]


def is_concealed(result: Result) -> bool:
    """Cancelled by another effect, or less than 2 % of its energy is left by what else is fitted."""
    if result["truth"]["tier"] == "cancelled":
        return True
    left = identifiability(result)
    return bool(truth_of(result)) and left is not None and left < CONCEALED


def _by_effect(results: Sequence[Result]) -> list[tuple[str, dict[str, Rate], Rate]]:
    """Named right per truth: by scene, and in all; faint cases excluded."""
    scenes: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for one in results:
        if one["case"]["kind"] != FAINT:
            scenes[label(one)][one["truth"]["scene"]].append(named_right(one))
    return [
        (
            truth,
            {scene: rate(flags) for scene, flags in sorted(by_scene.items())},
            rate(flag for flags in by_scene.values() for flag in flags),
        )
        for truth, by_scene in sorted(scenes.items())
    ]


def _sizes(results: Sequence[Result]) -> list[tuple[Result, Result]]:
    """Pairs of the same case at 88 x 72 and 176 x 144."""
    by_name = {one["case"]["name"]: one for one in results}
    return [
        (by_name[one["case"]["twin_of"]], one)
        for one in results
        if one["case"]["kind"] == TWICE and one["case"]["twin_of"] in by_name
    ]


def same_verdict(small: Result, large: Result) -> bool:
    """Verdict and named effects are the same."""
    verdicts = {(one["report"] or {}).get("verdict") for one in (small, large)}
    return len(verdicts) == 1 and frozenset(named(small)) == frozenset(named(large))


WHO = ("rim diagnose", "independent BIC", "correlation")


def confusion(results: Iterable[Result], who: str) -> dict[str, Counter[str]]:
    """Counts of what is named first, by truth: single effects, `null`, `outside`; faint cases excluded."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    key = {"independent BIC": "bic", "correlation": "correlation"}.get(who)
    for one in results:
        kind = one["case"]["kind"]
        if kind not in ("null", "plain", "masked", "confounded", "unknown"):
            continue
        truth = "outside" if kind == "unknown" else label(one)
        if key is None:
            counts[truth][first_word(one)] += 1
        elif one.get("baselines"):
            counts[truth][one["baselines"][key]] += 1
    return dict(counts)


def right_word(truth: str) -> str:
    """What has to be said first for a row of the confusion matrix."""
    return {"null": "consistent", "outside": "unknown"}.get(truth, truth)
