"""Facts as aligned text: groups of (label, value) under headings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

Lines = Sequence[tuple[str, str]]

#: Most characters in a line, where words allow it.
_WIDTH = 100


def section(heading: str, lines: Lines) -> str:
    """Return a heading with aligned lines below it; long values continue under themselves."""
    width = max((len(label) for label, _ in lines), default=0)
    body = "\n".join(_hanging(f"  {label:{width}}  ", value).rstrip() for label, value in lines)
    return f"{heading}\n{body}" if heading else body


def wrapped(sentences: Iterable[str], mark: str = "  ") -> str:
    """Return sentences one below the other, long ones over several lines."""
    return "\n".join(_hanging(mark, sentence) for sentence in sentences)


def _hanging(start: str, text: str) -> str:
    return (
        textwrap.fill(
            text,
            width=max(_WIDTH, len(start) + 40),
            initial_indent=start,
            subsequent_indent=" " * len(start),
            break_long_words=False,
            break_on_hyphens=False,
        )
        or start
    )


def table(headings: Sequence[str], rows: Sequence[Sequence[Any]], indent: str = "  ", left: int = 1) -> str:
    """Return a table whose first ``left`` columns are aligned left, the others right."""
    cells = [list(map(str, row)) for row in (headings, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(headings))]
    return "\n".join(
        indent
        + "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
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


def several(count: int, word: str) -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def percent(share: float | None) -> str:
    """Return a share in per cent; a small one is not rounded to 0."""
    if share is None:
        return "-"
    if 0 < share < 5e-5:
        return "< 0.01 %"
    return f"{share * 100:.2f} %" if 0 < share < 1 else f"{share * 100:.0f} %"


def span(low: float | None, high: float | None, unit: str = "") -> str:
    """Return a range, or the one value where both ends are the same."""
    if low is None or high is None:
        return "-"
    if number(low) == number(high):
        return number(low, unit)
    return f"{number(low)} .. {number(high, unit)}"


def listed_short(items: Sequence[str], most: int = 8) -> str:
    """Return a list of items for a sentence, only the first ones if there are many."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more


def words(value: Any) -> str:
    """Return plain data of a YAML file as words, without Python's punctuation."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {words(one)}" for key, one in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(words(one) for one in value) or "none"
    return "none" if value is None else str(value)
