"""Pages that are written from the program: written, or compared with what is there."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]


def run(description: str, pages: Callable[[], Mapping[Path, str]]) -> int:
    """Write the pages, or with ``--check`` say which are out of date; return the exit status."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if a page differs")
    check = parser.parse_args().check
    made = pages()
    stale = [path for path, text in made.items() if not path.is_file() or path.read_text() != text]
    for path in stale:
        if not check:
            path.parent.mkdir(exist_ok=True)
            path.write_text(made[path])
        print(f"{path.name}: {'out of date' if check else 'written'}")
    return int(check and bool(stale))
