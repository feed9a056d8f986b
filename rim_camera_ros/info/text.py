"""Facts as aligned text: groups of (label, value) under headings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Lines = Sequence[tuple[str, str]]


def section(heading: str, lines: Lines) -> str:
    """Return a heading with aligned lines below it."""
    width = max((len(label) for label, _ in lines), default=0)
    body = "\n".join(f"  {label:{width}}  {value}".rstrip() for label, value in lines)
    return f"{heading}\n{body}" if heading else body


def table(headings: Sequence[str], rows: Sequence[Sequence[Any]], indent: str = "  ") -> str:
    """Return a table whose first column is aligned left, the others right."""
    cells = [list(map(str, row)) for row in (headings, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(headings))]
    return "\n".join(
        indent
        + "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    )


def number(value: float | None, unit: str = "", digits: int = 4) -> str:
    """Return a number with its unit, a dash where there is none."""
    if value is None:
        return "-"
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{value:.0f}"
    return f"{text} {unit}".rstrip()


def span(low: float | None, high: float | None, unit: str = "") -> str:
    """Return a range, or the one value where both ends are the same."""
    if low is None or high is None:
        return "-"
    if number(low) == number(high):
        return number(low, unit)
    return f"{number(low)} .. {number(high, unit)}"
