"""What every page must be, judged by its HTML alone: well formed, whole, each picture described."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from itertools import pairwise

#: Elements without an end tag.
_VOID = {"meta", "link", "img", "br", "hr"}


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.faults: list[str] = []
        self.alternatives: list[str] = []
        self.sources: list[str] = []
        self.headings: list[int] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        if tag == "img":
            self.alternatives.append(given.get("alt") or "")
            self.sources.append(given.get("src") or "")
        if tag == "script":
            self.faults.append("a script")
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        for name, value in given.items():
            if name in ("src", "href") and str(value).startswith(("http:", "https:", "//")):
                self.faults.append(f"needs the network: {value}")
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> closes nothing")

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text.append(data)


def text_of(page: str) -> str:
    """Return what is to be read on a page."""
    reader = _Reader()
    reader.feed(page)
    return " ".join(" ".join(reader.text).split())


def faults_of(page: str) -> list[str]:
    """Return what is wrong with a page, in words."""
    reader = _Reader()
    reader.feed(page)
    reader.close()
    found = [*reader.faults, *(f"<{tag}> is not closed" for tag in reader.open)]
    found += [f"picture {i} has no alt text" for i, alt in enumerate(reader.alternatives) if len(alt) < 12]
    found += [f"the source of picture {i} is empty" for i, one in enumerate(reader.sources) if not one]
    if reader.headings.count(1) != 1 or reader.headings[0] != 1:
        found.append("there is not one heading of the first level, and that first")
    found += [f"h{b} follows h{a}" for a, b in pairwise(reader.headings) if b > a + 1]
    if not page.startswith("<!DOCTYPE html>"):
        found.append("no document type")
    for needed in ('<meta name="viewport"', '<html lang="en">', "prefers-color-scheme: dark"):
        if needed not in page:
            found.append(f"{needed} is absent")
    words = " ".join(reader.text)
    for one in ("{{", "{%", "None", "nan", "inf"):
        if re.search(rf"(?<!\w){re.escape(one)}(?!\w)", words):
            found.append(f"'{one}' is read")
    return found
