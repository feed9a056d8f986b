"""docs/decision.md states the numbers that the program decides by."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "decision.md"
ROWS = re.findall(r"^\| `([a-z_.]+)\.([A-Z_]+)` \| ([0-9., ]+) \|", PAGE.read_text(), re.MULTILINE)


def test_the_table_is_there() -> None:
    assert len(ROWS) >= 10


@pytest.mark.parametrize(("module", "name", "value"), ROWS, ids=[f"{a}.{b}" for a, b, _ in ROWS])
def test_numbers_of_the_page(module: str, name: str, value: str) -> None:
    stated = getattr(importlib.import_module(f"rim_camera_ros.{module}"), name)
    several = [float(one) for one in value.split(",")]
    if isinstance(stated, tuple):
        assert several == pytest.approx(stated, rel=1e-3)
    else:
        assert several == [stated]
