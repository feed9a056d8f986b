"""Configurations of other tools name the topics and diagnostics that there are."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "nodes.md").read_text()


def texts(value: Any) -> Iterator[str]:
    """Return all texts in nested keys and values."""
    if isinstance(value, dict):
        for key, one in value.items():
            yield from (key, *texts(one))
    elif isinstance(value, list):
        for one in value:
            yield from texts(one)
    elif isinstance(value, str):
        yield value


def test_every_status_is_in_one_group_of_the_aggregator() -> None:
    config = yaml.safe_load((ROOT / "config" / "diagnostic_aggregator.yaml").read_text())
    group = config["/**"]["ros__parameters"]["camera"]
    assert group["type"] == "diagnostic_aggregator/AnalyzerGroup"
    prefixes = [text for one in group["analyzers"].values() for text in one["startswith"]]
    rows = re.findall(r"^\| `((?:driver|correction|people|calibration): [^`]+)` \|", PAGE, re.MULTILINE)
    assert len(rows) >= 8
    for status in rows:
        assert sum(f"/camera/{status}".startswith(one) for one in prefixes) == 1, status
    # and no group waits for what nobody sends
    sent = {"driver", "correction", "people", "calibration"}
    assert {one.removeprefix("/camera/").partition(":")[0] for one in prefixes} == sent


def test_the_prefixes_to_change_for_several_cameras_are_those_of_the_file() -> None:
    config = yaml.safe_load((ROOT / "config" / "diagnostic_aggregator.yaml").read_text())
    analyzers = config["/**"]["ros__parameters"]["camera"]["analyzers"]
    section = PAGE[PAGE.index("## Diagnostics") : PAGE.index("## Moving people")]
    named = re.findall(r"`(/camera/\w+: )`", section)
    assert named == [prefix for group in analyzers.values() for prefix in group["startswith"]]


def test_the_layout_of_foxglove_shows_topics_that_there_are() -> None:
    layout = json.loads((ROOT / "config" / "foxglove.json").read_text())
    table = PAGE[PAGE.index("## Topics") : PAGE.index("## Parameters")]
    documented = {
        name if name.startswith("/") else f"/camera/{name}" for name in re.findall(r"`([^`\s]+)`", table)
    }
    shown = {text for text in texts(layout) if text.startswith("/")}
    assert len(shown) == 6
    assert shown <= documented
    assert {one for one in texts(layout["layout"]) if "!" in one} == set(layout["configById"])
