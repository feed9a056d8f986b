"""What a report is worth against the truth of its case, and the gates that rates are held against."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

SHARE = 0.9
LEAST_RANKING = 5
_SETTLED = {"unknown"}

Line = Mapping[str, Any]


def region(values: np.ndarray) -> np.ndarray:
    """The smallest set of pixels that holds 90 % of a map's sum (`formats.md`, section 5)."""
    flat = np.clip(np.nan_to_num(np.asarray(values, float)), 0, None).ravel()
    order = np.argsort(-flat, kind="stable")
    filled = np.cumsum(flat[order])
    inside = np.zeros(flat.size, bool)
    if filled[-1] > 0:
        inside[order[: int(np.searchsorted(filled, SHARE * filled[-1])) + 1]] = True
    return inside.reshape(np.shape(values))


def overlap(reported: np.ndarray, true: np.ndarray) -> float | None:
    """Intersection over union of the regions of two maps of mean squares; None where one is empty."""
    if not reported.any() or not true.any():
        return None
    one, other = region(reported), region(true)
    return float((one & other).sum() / (one | other).sum())


def line(
    truth: Line, report: Line | None, error: str | None, folder: Path, root: np.ndarray
) -> dict[str, Any]:
    """One line of the results: what was said, and how it compares."""
    if report is None:
        return {
            "verdict": "failed",
            "error": error,
            "missing": [],
            "right": False,
            "wrong": False,
            "tied": False,
        }
    missing = [
        {"effect": entry["effect"], "probability": entry["probability"], "interval": entry.get("interval")}
        for entry in report["missing"]
    ]
    fit = report["fit"]
    out: dict[str, Any] = {
        "verdict": report["verdict"],
        "error": None,
        "missing": missing,
        "adjusted": [entry["effect"] for entry in report.get("adjusted", [])],
        "reason": report.get("reason"),
        "ranking": report.get("ranking", [])[:LEAST_RANKING],
        "indistinguishable": report.get("indistinguishable", []),
        "setup": report.get("setup", [])[:LEAST_RANKING],
        "fit": fit,
    }
    out |= judged(truth, out)
    out["covered"] = coverage(truth, report)
    out["explained"] = explained(fit)
    out["iou"] = None
    if truth["effects"] and out["right"] and truth["tier"] not in ("setup", "wrong_parameters"):
        out["iou"] = overlap(np.load(folder / report["where"]["pixels"]), root.astype(float) ** 2)
        out["true_region"] = float(region(root.astype(float) ** 2).mean())
    return out


def judged(truth: Line, said: Line) -> dict[str, Any]:
    """`right`, `wrong` (a name that is neither true nor tied with a true one), `tied`."""
    tier, verdict = truth["tier"], said["verdict"]
    names = {entry["effect"] for entry in said["missing"]}
    if tier == "null":
        right = verdict == "consistent"
        return {"right": right, "wrong": bool(names - _SETTLED), "tied": False}
    if tier == "setup":
        setup = said["setup"]
        ranked = bool(setup) and setup[0]["hypothesis"] == truth["hypothesis"]
        named = verdict == "inconsistent_setup"
        return {
            "right": named and ranked,
            "wrong": bool(names - _SETTLED),
            "tied": False,
            "said_as_such": named,
        }
    true = set(truth["effects"])
    if tier == "wrong_parameters":
        right = verdict == "wrong_parameters" and true <= set(said["adjusted"])
        return {"right": right, "wrong": bool(names - _SETTLED), "tied": False}
    if tier == "unknown":
        right = names == {"unknown"} or verdict == "unknown_physics"
        return {"right": right, "wrong": bool(names - _SETTLED), "tied": False}
    if not names and verdict == "wrong_parameters":
        # sections that every camera file has are adjusted rather than missing
        names = set(said["adjusted"]) & {"lens_distortion", "camera_constant", "radiometry", "noise"}
    ties = [set(group) for group in said["indistinguishable"]]
    hedged = {name for name in names if any(name in group and true & group for group in ties)}
    reached = names | {one for group in ties if names & group for one in group}
    return {
        "right": names == true,
        "wrong": bool(names - true - hedged - _SETTLED),
        "tied": names != true and true <= reached and not names - true - hedged,
    }


def coverage(truth: Line, report: Line) -> list[dict[str, Any]]:
    """Of each true value that a reported interval speaks of: whether it is inside."""
    found = []
    for entry in report["missing"]:
        intervals = entry.get("interval") or {}
        for path, value in truth["parameters"].get(entry["effect"], {}).items():
            keys = [key for key in intervals if key == path or key.endswith("." + path)]
            bounds = intervals[keys[0]] if keys else None
            if bounds and None not in bounds and isinstance(value, int | float):
                found.append(
                    {
                        "path": f"{entry['effect']}.{path}",
                        "true": value,
                        "interval": bounds,
                        "inside": bool(bounds[0] <= value <= bounds[1]),
                    }
                )
    return found


def explained(fit: Line) -> float | None:
    """Share of the excess chi-square over 1 that is gone on data that were not fitted; None below 0.02."""
    before, after = fit.get("chi2_before"), fit.get("chi2_after")
    if before is None or after is None or before < 1.02:
        return None
    return float((before - after) / (before - 1))


@dataclass(frozen=True)
class Rate:
    """A rate with its 95 % Wilson interval (Wilson 1927)."""

    hits: int
    count: int

    @property
    def share(self) -> float:
        """The rate itself."""
        return self.hits / self.count if self.count else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end."""
        if not self.count:
            return 0.0, 1.0
        z, n = float(norm.ppf(0.975)), self.count
        centre = (self.hits + z * z / 2) / (n + z * z)
        half = z / (n + z * z) * np.sqrt(self.hits * (n - self.hits) / n + z * z / 4)
        return max(0.0, centre - float(half)), min(1.0, centre + float(half))


def rate(flags: Iterable[bool]) -> Rate:
    """The rate of flags that are set."""
    found = list(flags)
    return Rate(sum(map(bool, found)), len(found))


@dataclass(frozen=True)
class Gate:
    """A demand on a rate of the lines of some tiers."""

    what: str
    tiers: tuple[str, ...]
    flag: Callable[[Line], bool]
    at_least: float = 0.0
    at_most: float = 1.0

    def met(self, found: Rate) -> bool | None:
        """Whether the rate itself is within its bounds; None without cases."""
        return self.at_least <= found.share <= self.at_most if found.count else None


def _right(one: Line) -> bool:
    return bool(one["right"])


def _wrong(one: Line) -> bool:
    return bool(one["wrong"])


def _confidently(one: Line) -> bool:
    return bool(one["wrong"]) and any(entry["probability"] >= 0.5 for entry in one["missing"])


GATES = (
    Gate("alarms where nothing is missing", ("null",), lambda one: not one["right"], at_most=0.05),
    Gate("single: named right", ("single",), _right, at_least=0.90),
    Gate("single: named wrongly", ("single",), _wrong, at_most=0.03),
    Gate("single: right, or tied with what is", ("single",), lambda one: one["right"] or one["tied"]),
    Gate("two, three, cancelled: all names right", ("two", "three", "cancelled"), _right, at_least=0.70),
    Gate("wrong set-ups said as such, right hypothesis first", ("setup",), _right, at_least=0.95),
    Gate("wrong set-ups said as such", ("setup",), lambda one: bool(one.get("said_as_such"))),
    Gate("wrong parameters said of the right term", ("wrong_parameters",), _right, at_least=0.90),
    Gate("concealed: confidently wrong", ("concealed",), _confidently, at_most=0.0),
    Gate("unknown said of what is outside the vocabulary", ("unknown",), _right, at_least=0.90),
)


def summary(lines: Iterable[Line]) -> str:
    """A table of the gates, and one of the right answers by effect, in Markdown."""
    found = list(lines)
    rows = ["| what | rate | 95 % interval | demanded | met |", "|---|---|---|---|---|"]
    for gate in GATES:
        own = rate(gate.flag(one) for one in found if one["tier"] in gate.tiers)
        demanded = (
            f">= {gate.at_least:.0%}"
            if gate.at_least
            else f"<= {gate.at_most:.0%}"
            if gate.at_most < 1
            else "-"
        )
        rows.append(_row(gate.what, own, demanded, gate.met(own) if demanded != "-" else None))
    inside = rate(entry["inside"] for one in found for entry in one.get("covered", []))
    rows.append(
        _row(
            "truth inside the 95 % interval",
            inside,
            "92-98 %",
            0.92 <= inside.share <= 0.98 if inside.count else None,
        )
    )
    overlaps = [one["iou"] for one in found if one.get("iou") is not None and one["true_region"] < 0.6]
    median = f"{np.median(overlaps):.3f}" if overlaps else "-"
    met = "-" if not overlaps else "yes" if np.median(overlaps) >= 0.9 else "no"
    rows.append(
        f"| median overlap of regions ({len(overlaps)} cases, true region below 60 %) | {median} | "
        f"| >= 0.9 | {met} |"
    )
    rows += ["", "| tier | effects | right | wrong | tied | cases |", "|---|---|---|---|---|---|"]
    for key in sorted({(one["tier"], "+".join(one["effects"])) for one in found}):
        own = [one for one in found if (one["tier"], "+".join(one["effects"])) == key]
        sums = [sum(bool(one[flag]) for one in own) for flag in ("right", "wrong", "tied")]
        rows.append(f"| {key[0]} | {key[1] or '-'} | {sums[0]} | {sums[1]} | {sums[2]} | {len(own)} |")
    return "\n".join(rows) + "\n"


def _row(what: str, found: Rate, demanded: str, met: bool | None) -> str:
    if not found.count:
        return f"| {what} | - | | {demanded} | - |"
    low, high = found.interval
    answer = "-" if met is None else "yes" if met else "no"
    share = f"{found.share:.1%} ({found.hits} of {found.count})"
    return f"| {what} | {share} | {low:.1%}-{high:.1%} | {demanded} | {answer} |"
