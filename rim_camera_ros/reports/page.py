"""The parts of pages, and templates that become single files with style and pictures in them.

Sections of a report are lists of parts; the templates determine their order and their look.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined

Mood = Literal["", "good", "warn"]


@dataclass(frozen=True)
class Card:
    """An important number with its description."""

    value: str
    label: str
    mood: Mood = ""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    words: str


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    kind: ClassVar[str] = "heading"
    words: str


@dataclass(frozen=True)
class Code:
    """A line of code or a command."""

    kind: ClassVar[str] = "code"
    words: str


@dataclass(frozen=True)
class Table:
    """Rows of text: columns of ``numbers`` are aligned right, rows of one cell are headings.

    ``moods`` colours rows by their number, ``caption`` says what the table shows (for screen readers, too).
    """

    kind: ClassVar[str] = "table"
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Iterable[int] = ()
    moods: Mapping[int, Mood] = field(default_factory=dict)
    caption: str = ""


@dataclass(frozen=True)
class Tagged:
    """A table of (name, tag, mood, words)."""

    kind: ClassVar[str] = "tagged"
    rows: Sequence[tuple[str, str, Mood, str]]


@dataclass(frozen=True)
class Figure:
    """A picture: SVG, or the name of a file beside the page. ``alt`` describes it in words."""

    kind: ClassVar[str] = "figure"
    picture: bytes | str
    alt: str
    caption: str = ""

    @property
    def source(self) -> str:
        """The address of the picture."""
        if isinstance(self.picture, str):
            return self.picture
        return f"data:image/svg+xml;base64,{base64.b64encode(self.picture).decode()}"


@dataclass(frozen=True)
class Bullets:
    """A list."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]


@dataclass(frozen=True)
class Folded:
    """Parts that open on a click."""

    kind: ClassVar[str] = "folded"
    summary: str
    parts: Sequence[Part]


Part = Text | Heading | Code | Table | Tagged | Figure | Bullets | Folded


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("rim_camera_ros.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **values: Any) -> str:
    """Return a page by its template (the file's name without .html); text is escaped."""
    return _environment().get_template(f"{template}.html").render(**values)
