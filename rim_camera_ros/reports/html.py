"""Pages that stand alone: one HTML file with style and pictures in it."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_STYLE = """
:root { --ink: #1d2733; --soft: #5b6878; --line: #dde3ea; --panel: #f6f8fa; --accent: #1f6f8b;
  --good: #2e7d4f; --warn: #b3541e; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: var(--ink); margin: 0;
  background: #fff; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 64px; }
h1 { font-size: 26px; margin: 0 0 2px; letter-spacing: -0.01em; }
h2 { font-size: 19px; margin: 40px 0 8px; padding-bottom: 5px; border-bottom: 2px solid var(--line); }
h3 { font-size: 15px; margin: 22px 0 4px; }
p { margin: 6px 0 10px; max-width: 78ch; }
.under { color: var(--soft); margin: 0 0 18px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 10px;
  margin: 16px 0; }
.card { background: var(--panel); border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; }
.card b { display: block; font-size: 21px; font-weight: 600; font-variant-numeric: tabular-nums; }
.card span { color: var(--soft); font-size: 12.5px; line-height: 1.35; display: block; }
.card.good b { color: var(--good); } .card.warn b { color: var(--warn); }
table { border-collapse: collapse; font-size: 13.5px; margin: 8px 0 14px; }
th { text-align: left; font-weight: 600; color: var(--soft); border-bottom: 1.5px solid var(--line); }
th, td { padding: 3px 16px 3px 0; vertical-align: top; }
td { border-bottom: 1px solid #eef1f4; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.group td { font-weight: 600; padding-top: 10px; border-bottom: 1px solid var(--line); }
figure { margin: 12px 0 20px; } figure img { max-width: 100%; display: block; }
figcaption { color: var(--soft); font-size: 13px; max-width: 90ch; margin-top: 2px; }
code { font: 12.5px ui-monospace, "DejaVu Sans Mono", monospace; background: var(--panel); padding: 1px 4px;
  border-radius: 3px; word-break: break-all; }
.notes li { margin-bottom: 4px; max-width: 90ch; }
.tag { display: inline-block; border-radius: 10px; padding: 0 9px; font-size: 12px; background: var(--panel);
  border: 1px solid var(--line); color: var(--soft); white-space: nowrap; }
.tag.good { color: var(--good); border-color: #bcdcc8; background: #f0f8f3; }
.tag.warn { color: var(--warn); border-color: #ecd0bd; background: #fdf5ef; }
details summary { cursor: pointer; color: var(--accent); }
@media print { main { max-width: none; } h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


@dataclass(frozen=True)
class Card:
    """A number that matters at a glance: ``mood`` is empty, ``good`` or ``warn``."""

    value: str
    label: str
    mood: str = ""


def text(value: object) -> str:
    """Return plain text as HTML."""
    return html.escape(str(value))


def page(title: str, under: str, parts: Iterable[str]) -> str:
    """Return a complete page; ``under`` is the line below the title, plain text."""
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{_STYLE}</style></head>\n<body><main>\n"
        f'<h1>{text(title)}</h1>\n<p class="under">{text(under)}</p>\n{body}\n</main></body></html>\n'
    )


def section(heading: str, *parts: str) -> str:
    """Return a section; nothing where all its parts are empty."""
    content = "\n".join(part for part in parts if part)
    return f"<h2>{text(heading)}</h2>\n{content}" if content else ""


def paragraph(words: str) -> str:
    """Return a paragraph of plain text."""
    return f"<p>{text(words)}</p>"


def cards(items: Iterable[Card]) -> str:
    """Return numbers at a glance, side by side."""
    cells = "".join(
        f'<div class="card {one.mood}"><b>{text(one.value)}</b><span>{text(one.label)}</span></div>'
        for one in items
    )
    return f'<div class="cards">{cells}</div>'


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Iterable[int] = ()) -> str:
    """Return a table of plain text: columns of ``numbers`` aligned right, rows of one cell as headings."""
    right = set(numbers)

    def cells(row: Sequence[str], tag: str) -> str:
        marks = ['class="n"' if i in right else "" for i in range(len(row))]
        return "".join(f"<{tag} {mark}>{text(cell)}</{tag}>" for cell, mark in zip(row, marks, strict=True))

    lines = [f"<tr>{cells(headings, 'th')}</tr>"]
    for row in rows:
        if len(row) == 1:
            lines.append(f'<tr class="group"><td colspan="{len(headings)}">{text(row[0])}</td></tr>')
        else:
            lines.append(f"<tr>{cells(row, 'td')}</tr>")
    return "<table>" + "\n".join(lines) + "</table>"


def tagged(rows: Iterable[tuple[str, str, str, str]]) -> str:
    """Return a table of (name, tag, mood, words)."""
    lines = [
        f'<tr><td><b>{text(name)}</b></td><td><span class="tag {mood}">{text(tag)}</span></td>'
        f"<td>{text(words)}</td></tr>"
        for name, tag, mood, words in rows
    ]
    return "<table>" + "\n".join(lines) + "</table>" if lines else ""


def figure(svg: bytes, caption: str) -> str:
    """Return a picture (SVG) with its caption."""
    data = base64.b64encode(svg).decode()
    words = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{text(caption)}" src="data:image/svg+xml;base64,{data}">{words}</figure>'


def bullets(items: Iterable[str]) -> str:
    """Return a list of plain text, empty for none."""
    lines = "".join(f"<li>{text(one)}</li>" for one in items)
    return f'<ul class="notes">{lines}</ul>' if lines else ""


def folded(summary: str, content: str) -> str:
    """Return content that opens on a click."""
    return f"<details><summary>{text(summary)}</summary>{content}</details>"
