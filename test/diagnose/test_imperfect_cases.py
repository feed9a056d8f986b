"""Recordings of imperfect cameras by an independent program: names, verdicts, no contradiction."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rim_camera_ros.cli import main

from ..contradictions import contradictions

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases2"

#: What reports call what the truth names.
VERDICTS = {
    "null": "consistent",
    "wrong": "wrong_parameters",
    "setup": "inconsistent_setup",
    "unknown": "unknown_physics",
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
    pytest.mark.skipif(
        not CASES.is_dir(), reason="no ../shared/cases2: recordings of an independent program"
    ),
]


@pytest.mark.parametrize(
    "name", sorted(one.name for one in CASES.iterdir() if one.is_dir()) if CASES.is_dir() else ["absent"]
)
def test_imperfect_cases(name: str, tmp_path: Path) -> None:
    folder = CASES / name
    truth = json.loads((folder / "truth.json").read_text())
    given = ["--camera", folder / "camera.yaml", "--scene", folder / "scene.yaml", "--out", tmp_path / "out"]
    assert main(["diagnose", str(folder / "recording"), *map(str, given), "--quiet"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert contradictions(report) == []
    assert report["verdict"] == VERDICTS.get(truth["tier"], "missing_physics")
    if truth["tier"] in ("single", "two"):
        assert {one["effect"] for one in report["missing"]} == set(truth["effects"])
    if truth["tier"] == "wrong":
        assert truth["effects"][0] in {one["effect"] for one in report["adjusted"]}
