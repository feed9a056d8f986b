"""docs/proof.md from the results of a run."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from . import prose
from .figures import CONFUSION, IDENTIFIABILITY, SENSITIVITY, draw_all
from .plan import FAINT, MASTER_SEED
from .run_case import LEDGER
from .score import (
    LEAST_EXCESS,
    Rate,
    Result,
    covariate_right,
    covered,
    first_word,
    named,
    named_right,
    rate,
)
from .table import (
    CERTAIN,
    WHO,
    Score,
    confusion,
    is_visible,
    label,
    local_strength,
    overlapping,
    right_word,
    same_verdict,
    score,
    written,
)

_COMMENT = """\
<!-- Written by `make proof` from the results of the run and from proof/history.md; changes here are lost. -->
"""

#: What people say of a run (Markdown): what it was; from its first heading on what came before and after.
HISTORY = "history.md"


def write_page(
    results: Sequence[Result], folder: Path, *, ledger: Path, command: str, not_run: Sequence[str] = ()
) -> Path:
    """Write `proof.md`, and the pictures and the ledger into `proof/` beside it; return the page's path.

    What people say of the run, in `proof/history.md`, becomes part of the page: its sections the last ones.
    """
    pictures = folder / "proof"
    pictures.mkdir(parents=True, exist_ok=True)
    found = score(results)
    drawn = draw_all(results, found, pictures)
    if ledger.exists():
        shutil.copyfile(ledger, pictures / LEDGER)
    path = folder / "proof.md"
    said = pictures / HISTORY
    history = said.read_text(encoding="utf-8") if said.exists() else ""
    text = page(results, found, drawn, command=command, not_run=not_run, history=history)
    path.write_text(text, encoding="utf-8")
    return path


def page(
    results: Sequence[Result],
    found: Score,
    drawn: Sequence[str],
    *,
    command: str,
    not_run: Sequence[str],
    history: str = "",
) -> str:
    """The page's text."""
    about, heading, sections = history.partition("\n## ")
    parts = [
        "# Proof: does `rim diagnose` name the right physics?",
        _COMMENT,
        _about(results, command),
        about,
        "## What was reached",
        _table(
            ["measure", "demanded", "measured (95 % interval)", "met"],
            [
                [row.measure, row.demand, row.value, {True: "yes", False: "**no**", None: "-"}[row.met]]
                for row in found.rows
            ],
        ),
        _definitions(results),
        "## Tiers",
        _table(
            ["tier", "noticed", "named right", "named wrongly", "truth among the rivals"],
            [[tier, *map(written, rates)] for tier, *rates in found.tiers],
        ),
        _nulls(results),
        "## Effects, and how small they may be",
        _visible(results, found, drawn),
        "## Confusion, and two common methods on the same recordings",
        _confusion(results, drawn),
        "## Size of the array",
        _sizes(found),
        "## Effort",
        _effort(results),
        _trouble(results, not_run),
        "## Misses",
        _misses(found.misses),
        heading + sections,
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _about(results: Sequence[Result], command: str) -> str:
    states = {tuple(sorted(one["state"].items())) for one in results}
    state = f"**{len(states)} different states of the program** (these results are not of one run)"
    if len(states) == 1:
        state = prose.STATE.format(**dict(next(iter(states))))
    forms = sorted({one["case"]["forms"] for one in results})
    return prose.ABOUT.format(
        count=len(results),
        forms=" and ".join(forms),
        warning="" if forms == ["scoring"] else prose.NOT_SCORING,
        ledger=LEDGER,
        state=state,
        command=command,
    )


def _definitions(results: Sequence[Result]) -> str:
    counted = Counter(path for one in results for path, _ in covered(one))
    inside = Counter(path for one in results for path, good in covered(one) if good)
    of = ", ".join(f"{path} {inside[path]} of {count}" for path, count in sorted(counted.items()))
    other = [one["iou_of_root"] for one in overlapping(results)]
    root = f" (against the region of the root itself the median is {np.median(other):.2f})" if other else ""
    return prose.DEFINITIONS.format(
        certain=CERTAIN,
        excess=LEAST_EXCESS,
        covered=of or "none",
        root=root,
    )


def _nulls(results: Sequence[Result]) -> str:
    nulls = [one for one in results if one["case"]["kind"] == "null"]
    if not nulls:
        return ""
    said = Counter((one["truth"]["masked"], first_word(one)) for one in nulls)
    text = "; ".join(
        ("masked" if masked else "not masked")
        + ": "
        + ", ".join(f"{word} {count}" for (m, word), count in sorted(said.items()) if m == masked)
        for masked in sorted({m for m, _ in said})
    )
    text = f"What was said of the nulls: {text}."
    said_unknown = [
        one for one in results if one["truth"]["tier"] == "unknown" and named(one) == ("unknown",)
    ]
    if said_unknown:
        right = rate(map(covariate_right, said_unknown))
        text += f" Of the cases rightly called unknown, a true covariate is named in {written(right)}."
    return text


def _fraction(one: Rate | None) -> str:
    return "" if one is None else f"{one.successes}/{one.count}"


def _visible(results: Sequence[Result], found: Score, drawn: Sequence[str]) -> str:
    rows = []
    right = {truth: total for truth, _, total in found.effects}
    for name in sorted(found.seen.points):
        ones = [
            one
            for one in results
            if label(one) == name and one["case"]["kind"] in ("plain", "masked", FAINT, "unknown")
        ]
        above = [one for one in ones if is_visible(one, found.seen)]
        strengths = [local_strength(one) for one in ones]
        rows.append(
            [
                name,
                _fraction(right.get(name)),
                f"{min(strengths):.2g} to {max(strengths):.2g}",
                _point(found.seen.points[name], strengths),
                _point(found.named.points[name], strengths),
                _fraction(rate(map(named_right, above))),
            ]
        )
    if not rows:
        return "No single effects in this run."
    text = prose.VISIBLE.format(slope=found.named.slope) + "\n\n"
    text += _table(["missing", "right", "sizes tried", "half noticed", "half named", "named at twice"], rows)
    if SENSITIVITY in drawn:
        text += f"\n\n![Share of cases noticed and named over the size of the effect](proof/{SENSITIVITY})"
    if IDENTIFIABILITY in drawn:
        picture = f"![Named right or not, by identifiability and size](proof/{IDENTIFIABILITY})"
        text += f"\n\n{prose.IDENTIFIABILITY}\n\n{picture}"
    return text


def _point(value: float, strengths: Sequence[float]) -> str:
    if value < min(strengths):
        return f"< {min(strengths):.2g}"
    if value > max(strengths):
        return f"> {max(strengths):.2g}"
    return f"{value:.2g}"


def _confusion(results: Sequence[Result], drawn: Sequence[str]) -> str:
    tables = [confusion(results, who) for who in WHO]
    totals = []
    for one in tables:
        right = sum(counts[right_word(truth)] for truth, counts in one.items())
        totals.append(written(Rate(right, sum(sum(counts.values()) for counts in one.values()))))
    alarms = []
    for one in tables:
        null = one.get("null", Counter())
        alarms.append(written(Rate(sum(null.values()) - null["consistent"], sum(null.values()))))
    text = prose.CONFUSION + "\n\n"
    text += _table(["", *WHO], [["first name right", *totals], ["alarms on nulls", *alarms]])
    if CONFUSION in drawn:
        text += f"\n\n![Three confusion matrices: missing against named first](proof/{CONFUSION})"
    return text


def _sizes(found: Score) -> str:
    if not found.sizes:
        return "No case of this run was made at 176 x 144 as well."
    rows = [
        [
            f"{small['case']['name']}, {large['case']['name']}",
            label(small),
            _answer(small),
            _answer(large),
        ]
        for small, large in found.sizes
        if not same_verdict(small, large)
    ]
    same = rate(same_verdict(*pair) for pair in found.sizes)
    head = ["cases", "missing", "88 x 72", "176 x 144"]
    text = prose.SIZES.format(same=written(same))
    return text + "\n\n" + _table(head, rows) if rows else text


def _answer(result: Result) -> str:
    if result["error"] is not None:
        return f"failed: {result['error']}"
    names = named(result)
    verdict = result["report"]["verdict"]
    return verdict if set(names) <= {"unknown"} else f"{verdict}: {', '.join(names)}"


def _effort(results: Sequence[Result]) -> str:
    rows = []
    for size in sorted({tuple(one["truth"]["size"]) for one in results}):
        ones = [one for one in results if tuple(one["truth"]["size"]) == size]
        cpu, memory = ([one[key] for one in ones] for key in ("cpu_seconds", "peak_mb"))
        rows.append(
            [
                f"{size[0]} x {size[1]}",
                str(len(ones)),
                f"{np.median(cpu):.1f} s",
                f"{np.quantile(cpu, 0.95):.1f} s",
                f"{max(cpu):.1f} s",
                f"{max(memory):.0f} MB",
            ]
        )
    return (
        prose.EFFORT
        + "\n\n"
        + _table(["array", "cases", "median", "95 %", "longest", "memory at most"], rows)
    )


def _trouble(results: Sequence[Result], not_run: Sequence[str]) -> str:
    """Cases that are missing, and comparisons that failed: they belong on the page."""
    lines = [f"- not run: {one}" for one in not_run]
    lines += [f"- {one['case']['name']}: {text}" for one in results for text in one.get("trouble", ())]
    return "\n".join(["Cases without a result, and comparisons that failed:", "", *lines]) if lines else ""


def _misses(misses: Sequence[Result]) -> str:
    if not misses:
        return "None."
    tiers: dict[str, list[str]] = {}
    for one in misses:
        name, _, number = one["case"]["name"].rpartition("-")
        tiers.setdefault(name, []).append(f"{number} {label(one)}: {_answer(one)}")
    lines = [f"- {tier}: {'; '.join(found)}." for tier, found in tiers.items()]
    first = misses[0]["case"]
    forms, name = first["forms"], first["name"]
    seed = "" if first["master_seed"] == MASTER_SEED else f" --seed {first['master_seed']}"
    text = prose.MISSES.format(count=len(misses), forms=forms, seed=seed, name=name)
    return text + "\n\n" + "\n".join(lines)
