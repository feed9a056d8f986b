"""The scorer: what one result is worth, and rates with 95 % Wilson intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

#: Effects whose section every camera file has: naming them among the `adjusted` with the verdict
#: `wrong_parameters` counts as naming them.
MERELY_WRONG = ("noise", "radiometry", "camera_constant", "lens_distortion")
REGION_SHARE = 0.9
#: A leading false name with less than this probability is not confidently wrong.
CONFIDENT = 0.5
UNKNOWN, CONSISTENT, FAILED, SETUP = "unknown", "consistent", "failed", "inconsistent_setup"
_Z = float(norm.ppf(0.975))

Result = Mapping[str, Any]


@dataclass(frozen=True)
class Rate:
    """A number of successes with its 95 % Wilson interval."""

    successes: int
    count: int

    @property
    def share(self) -> float:
        """The share, NaN of nothing."""
        return self.successes / self.count if self.count else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's score interval (Wilson 1927), 95 %; all of 0 to 1 without cases."""
        if not self.count:
            return 0.0, 1.0
        n, p = self.count, self.share
        middle = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
        half = _Z / (1 + _Z**2 / n) * np.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
        return max(0.0, middle - float(half)), min(1.0, middle + float(half))

    def meets(self, *, at_least: float = 0.0, at_most: float = 1.0) -> bool | None:
        """Whether the rate itself is in the demanded range; None without cases."""
        return at_least <= self.share <= at_most if self.count else None


def rate(flags: Iterable[bool]) -> Rate:
    """The rate of flags that are set."""
    flags = list(flags)
    return Rate(sum(map(bool, flags)), len(flags))


def median_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Median with a distribution-free 95 % interval from order statistics (binomial); NaN of nothing."""
    ordered = np.sort(np.asarray(values, float))
    n = len(ordered)
    if not n:
        return float("nan"), float("nan"), float("nan")
    from scipy.stats import binom

    low = max(int(binom.ppf(0.025, n, 0.5)) - 1, 0)
    return float(np.median(ordered)), float(ordered[low]), float(ordered[n - 1 - low])


def region(values: np.ndarray, share: float = REGION_SHARE) -> np.ndarray:
    """The smallest set of pixels that holds `share` of the sum; nothing where the sum is not positive."""
    flat = np.nan_to_num(np.asarray(values, float)).clip(min=0.0).ravel()
    total = flat.sum()
    inside = np.zeros(flat.shape, bool)
    if total > 0.0:
        order = np.argsort(-flat, kind="stable")
        count = int(np.searchsorted(np.cumsum(flat[order]), share * total * (1 - 1e-12))) + 1
        inside[order[:count]] = True
    return inside.reshape(np.shape(values))


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two sets of pixels; 1 of two empty ones."""
    union = np.logical_or(one, other).sum()
    return float(np.logical_and(one, other).sum() / union) if union else 1.0


# what one result says


def _report(result: Result) -> Mapping[str, Any]:
    return result["report"] or {"verdict": FAILED, "missing": [], "adjusted": [], "indistinguishable": []}


def named(result: Result) -> tuple[str, ...]:
    """The effects that a report names, the most important first."""
    report = _report(result)
    names = tuple(entry["effect"] for entry in report["missing"])
    if not names and report["verdict"] == "wrong_parameters":
        moved = {entry["effect"] for entry in report["adjusted"]}
        names = tuple(name for name in MERELY_WRONG if name in moved)
    return names


def first_word(result: Result) -> str:
    """What a report says first: an effect, `unknown`, or the verdict where it names none."""
    return next(iter(named(result)), _report(result)["verdict"])


def truth_of(result: Result) -> frozenset[str]:
    """What had to be named: the left-out effects, or `unknown` for physics outside the vocabulary."""
    truth = result["truth"]
    return frozenset({UNKNOWN} if truth["tier"] == "unknown" else truth["effects"])


def named_right(result: Result) -> bool:
    """The named effects are exactly those omitted; of a null, the verdict is `consistent`."""
    if not truth_of(result):
        return bool(_report(result)["verdict"] == CONSISTENT)
    return frozenset(named(result)) == truth_of(result)


def named_wrongly(result: Result) -> bool:
    """An effect is named that was not omitted; `unknown` is not a name."""
    return bool(frozenset(named(result)) - truth_of(result) - {UNKNOWN})


def seen(result: Result) -> bool:
    """Whether the tool noticed that something is wrong at all."""
    return bool(_report(result)["verdict"] not in (CONSISTENT, FAILED))


def inside_rivals(result: Result) -> bool:
    """Every left-out effect is named, or stands in a set of `indistinguishable` with one that is."""
    reported = set(named(result))
    for tie in _report(result)["indistinguishable"]:
        if reported & set(tie):
            reported |= set(tie)
    return truth_of(result) <= reported


def confidently_wrong(result: Result) -> bool:
    """A false name that no reported set ties to a true one; the first may be hedged by a low probability.

    Effects after the first are claimed by standing there: their probability is that of being the only one.
    """
    report, truth = _report(result), truth_of(result)
    for place, entry in enumerate(report["missing"]):
        name = entry["effect"]
        if name in truth or name == UNKNOWN or (place == 0 and entry["probability"] < CONFIDENT):
            continue
        if not any(name in tie and truth & set(tie) for tie in report["indistinguishable"]):
            return True
    return False


def identifiability(result: Result) -> float | None:
    """Share of the effect's energy that nothing else could take on.

    As the report states it for the left-out effects (the least); otherwise from the truth, for what was
    masked: the squared share of RMS that the refit of the known terms left.
    """
    report, truth = _report(result), truth_of(result)
    stated = [
        entry["identifiability"]
        for entry in report.get("ranking", [])
        if entry["effect"] in truth and entry.get("identifiability") is not None
    ]
    if stated:
        return float(min(stated))
    left = result["truth"]["left_after_masking"]
    return None if left is None else float(left) ** 2


LEAST_EXCESS = 0.005
"""Excess of chi-square per value from which on a share of it can be stated."""


def explained_share(result: Result) -> float | None:
    """(chi2_before - chi2_after) / (chi2_before - chi2 of the truth), held out; None where too small."""
    report, true = result["report"], result.get("chi2_of_truth")
    if report is None or true is None or report["fit"]["chi2_before"] is None:
        return None
    before, after = report["fit"]["chi2_before"], report["fit"]["chi2_after"]
    if before - true < LEAST_EXCESS or after is None:
        return None
    return float((before - after) / (before - true))


def covariate_right(result: Result) -> bool:
    """Of physics outside the vocabulary, one of the reported covariates is a true one."""
    reported = {name for entry in _report(result)["missing"] for name in entry.get("covariates", ())}
    return bool(reported & set(result["truth"]["covariates"]))


# truth inside the interval

Bounds = dict[str, tuple[float, float]]


def _signed(drawn: Mapping[str, Any], low: float, high: float) -> tuple[float, float]:
    ends = sorted((drawn["sign"] * drawn["amount"] * low, drawn["sign"] * drawn["amount"] * high))
    return ends[0], ends[1]


def _scale(drawn: Mapping[str, Any], forms: str) -> Bounds:
    return {"scale": _signed(drawn, 1.0, 1.0 if forms == "tuning" else 1.1)}


def _integration(drawn: Mapping[str, Any], forms: str) -> Bounds:
    settings = np.array([16.0, 60.0, 100.0])
    shape = np.sqrt(16.0 / settings) if forms == "tuning" else np.exp(-settings / 45.0) - 0.35
    return {
        f"offset.{int(setting)}": _signed(drawn, float(value), float(value))
        for setting, value in zip(settings, shape, strict=True)
    }


def _motion(drawn: Mapping[str, Any], forms: str) -> Bounds:
    # light under the samples that does not cancel, as in the scoring form, is no time between samples
    return {"sample_interval": (drawn["amount"], drawn["amount"])} if forms == "tuning" else {}


def _bounce(drawn: Mapping[str, Any], forms: str) -> Bounds:
    return {"strength": (drawn["amount"], drawn["amount"])} if forms == "tuning" else {}


def _air(drawn: Mapping[str, Any], forms: str) -> Bounds:
    return {"coefficient": _signed(drawn, 1.0, 1.0)} if forms == "tuning" else {}


COUNTERPARTS: dict[str, Callable[[Mapping[str, Any], str], Bounds]] = {
    "distance_scale": _scale,
    "integration_time_offset": _integration,
    "motion": _motion,
    "multipath": _bounce,
    "ambient_temperature": _air,
}
"""Parameters of the vocabulary that mean the same in a hidden form, with their true value.

A range where the hidden form's local slope varies (scale of distance, whose clock warms up by a tenth)."""


def covered(result: Result) -> list[tuple[str, bool]]:
    """Of each parameter with a counterpart, whether its 95 % interval reaches the truth."""
    truth, report = result["truth"], _report(result)
    found = []
    for entry in report["missing"]:
        name = entry["effect"]
        if name not in COUNTERPARTS or name not in truth["effects"]:
            continue
        for path, (low, high) in COUNTERPARTS[name](truth["parameters"][name], truth["forms"]).items():
            bounds = entry["interval"].get(path)
            if bounds is not None and None not in bounds:
                found.append((f"{name}.{path}", bounds[0] <= high and low <= bounds[1]))
    return found
