"""Results of the reproduction as text, JSON, HTML page and Markdown page."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from rim_camera_ros import __version__
from rim_camera_ros.reports.page import Bullets, Figure, Folded, Mood, Part, Table, render
from rim_camera_ros.reproduce.results import Picture, Row
from rim_camera_ros.reproduce.run import Done

FORMAT = "rim_reproduction/1"
_HEADINGS = ("#", "quantity", "thesis", "ours", "deviation", "unit", "source")
_WIDTH = 110
#: Mark after the deviation of a row that is outside its tolerance.
OUTSIDE = " !"
#: Columns of numbers, aligned to the right.
_RIGHT = (0, 3, 4)
_INTRODUCTION = (
    "The set-ups of T. Kahlmann, Range Imaging Metrology (ETH Zurich, 2007), simulated with the shipped "
    "camera files "
    "and reduced as the thesis reduced them. No number is read out of a camera file: each is fitted to, or "
    "counted "
    "in, simulated measurements. The camera files hold what the thesis prints, so that agreement says that "
    "simulation and "
    "reduction are consistent with it, not that a camera was measured; where the thesis prints nothing the "
    "files "
    "state an assumption. Modulation frequency and pixel pitch are taken as known, as in the thesis. "
    "Deviations from a printed range are those from its nearer end. Angles are in gon, as in the thesis: "
    "100 gon are 90 degrees."
)


def json_report(done: Sequence[Done]) -> dict[str, Any]:
    """Return all results except the pictures; numbers that are not finite become None."""
    return {
        "format": FORMAT,
        "version": __version__,
        "rows": [_row(figure, row) for figure in done for row in figure.outcome.rows],
        "tables": [
            {
                "experiment": figure.experiment.name,
                "title": table.title,
                "headings": list(table.headings),
                "rows": [list(row) for row in table.rows],
            }
            for figure in done
            for table in figure.outcome.tables
        ],
    }


def _row(figure: Done, row: Row) -> dict[str, Any]:
    return {
        "experiment": figure.experiment.name,
        "quantity": row.quantity,
        "source": row.source,
        "thesis": {
            "text": row.printed.text,
            "low": _finite(row.printed.low),
            "high": _finite(row.printed.high),
        },
        "ours": _finite(row.ours),
        "sigma": _finite(row.sigma),
        "deviation": _finite(row.deviation),
        "unit": row.unit,
        "tolerance": _finite(row.tolerance),
        "within_tolerance": row.within_tolerance,
        "how": row.how,
        "why": row.why,
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def outside(done: Sequence[Done]) -> list[int]:
    """Return the numbers of the rows that deviate by more than their tolerance."""
    return [i for _, rows in numbered(done) for i, row in rows.items() if row.within_tolerance is False]


def first_sentence(done: Sequence[Done]) -> str:
    """Return a sentence on the number of rows within tolerance, and on the tolerance."""
    rows = [row for figure in done for row in figure.outcome.rows]
    compared = [row for row in rows if row.within_tolerance is not None]
    within = sum(row.within_tolerance is True for row in compared)
    words = (
        f"{within} of {len(compared)} rows within tolerance: a tenth of the printed number, or two standard "
        "deviations of ours"
    )
    absent = len(rows) - len(compared)
    if absent:
        words += f"; {absent} not reproduced"
    return f"{words}."


# --- text ------------------------------------------------------------------------------------------


def numbered(done: Sequence[Done]) -> list[tuple[Done, dict[int, Row]]]:
    """Return each experiment with its rows by the number that they have in the report."""
    result, number = [], 1
    for figure in done:
        result.append((figure, dict(enumerate(figure.outcome.rows, number))))
        number += len(figure.outcome.rows)
    return result


def cells(number: int, row: Row) -> tuple[str, ...]:
    """Return number, quantity, thesis, ours, deviation, unit, source as text."""
    lead = (str(number), row.quantity, row.printed.text)
    if row.ours is None:
        return *lead, "not reproduced", "-", row.unit, row.source
    ours = f"{row.ours:.{row.digits}f}"
    if row.sigma is not None:
        ours += f" +- {row.sigma:.2g}"
    deviation = row.deviation
    if deviation is None:
        shown = "-"
    elif deviation == 0 and row.printed.low != row.printed.high:
        shown = "within"
    else:
        shown = f"{round(deviation, row.digits) + 0.0:+.{row.digits}f}"
    # a mark in every form of the report, as text has no colours
    mark = OUTSIDE if row.within_tolerance is False else ""
    return *lead, ours, shown + mark, row.unit, row.source


def text_report(done: Sequence[Done]) -> str:
    """Return a table for each experiment, with explanations below it."""
    experiments = numbered(done)
    lines = [_HEADINGS, *(cells(i, row) for _, rows in experiments for i, row in rows.items())]
    widths = [max(len(line[i]) for line in lines) for i in range(len(_HEADINGS))]

    def line(row: Sequence[str]) -> str:
        columns = enumerate(zip(row, widths, strict=True))
        return "  ".join(x.rjust(w) if i in _RIGHT else x.ljust(w) for i, (x, w) in columns).rstrip()

    shown = [first_sentence(done), "Rows outside are marked with an exclamation mark.", "", line(_HEADINGS)]
    for figure, rows in experiments:
        shown += ["", f"{figure.experiment.title} [{figure.experiment.name}]"]
        shown += [line(cells(i, row)) for i, row in rows.items()]
        for words in explanations(rows):
            shown += textwrap.wrap(words, _WIDTH, initial_indent="    ", subsequent_indent="      ")
    return "\n".join(shown)


def explanations(rows: Mapping[int, Row]) -> list[str]:
    """Return descriptions and reasons of deviations, each text once, after the numbers of its rows."""
    result = []
    for name, lead in (("how", ""), ("why", "deviation: ")):
        texts = dict.fromkeys(text for row in rows.values() if (text := getattr(row, name)))
        for text in texts:
            mine = [i for i, row in rows.items() if getattr(row, name) == text]
            result.append(f"{_ranges(mine)}: {lead}{text}.")
    return result


def _ranges(numbers: Sequence[int]) -> str:
    """Return numbers as text, runs shortened: 1-3, 5."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


# --- pages -----------------------------------------------------------------------------------------


def file_name(picture: Picture) -> str:
    """Return the name of a picture's file."""
    return f"{picture.name}.png"


def html_page(done: Sequence[Done]) -> str:
    """Return the page for the folder with the pictures."""
    experiments = []
    for figure, rows in numbered(done):
        moods: dict[int, Mood] = {
            i: "warn" for i, row in enumerate(rows.values()) if row.within_tolerance is False
        }
        parts: list[Part] = [
            Table(_HEADINGS, [cells(i, row) for i, row in rows.items()], numbers=_RIGHT, moods=moods),
            Bullets(explanations(rows)),
            *(
                Figure(file_name(picture), picture.title, f"{picture.title}: {picture.caption}")
                for picture in figure.outcome.pictures
            ),
            *(Folded(table.title, [Table(table.headings, table.rows)]) for table in figure.outcome.tables),
        ]
        experiments.append((figure.experiment.title, parts))
    return render(
        "reproduction",
        title="Reproduction of the thesis",
        under=f"rim reproduce, version {__version__}",
        first=first_sentence(done),
        mood="warn" if outside(done) else "good",
        introduction=_INTRODUCTION,
        experiments=experiments,
    )


def markdown_page(done: Sequence[Done], folder: PurePath, command: str) -> str:
    """Return the page for the documentation; ``folder`` of the pictures relative to the page."""
    lines = [
        "# Reproduction of the thesis",
        "",
        f"<!-- Written by `{command}`; changes here are lost. -->",
        "",
        f"**{first_sentence(done)}** Rows outside are marked with an exclamation mark.",
        "",
        *textwrap.wrap(_INTRODUCTION, 140),
        "",
        f"    {command}",
        "",
        "runs the laboratory anew, about two minutes on one core, with fixed seeds, and writes this page; "
        "`--json` prints the rows with",
        "what was done, `--only NAME ...` runs some of the experiments.",
    ]
    for figure, rows in numbered(done):
        lines += ["", f"## {figure.experiment.title}", "", f"`--only {figure.experiment.name}`", ""]
        lines += _markdown_table(_HEADINGS, [cells(i, row) for i, row in rows.items()])
        lines.append("")
        for words in explanations(rows):
            lines += textwrap.wrap(f"- {words}", 140, subsequent_indent="  ", break_on_hyphens=False)
        for picture in figure.outcome.pictures:
            place = (folder / file_name(picture)).as_posix()
            lines += ["", f"![{picture.title}]({place})", "", f"*{picture.title}: {picture.caption}*"]
        for table in figure.outcome.tables:
            lines += ["", f"{table.title}", "", *_markdown_table(table.headings, table.rows)]
    return "\n".join(lines) + "\n"


def _markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(row: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"

    return [line(headings), line(["---"] * len(headings)), *(line(row) for row in rows)]
