"""From a driver's bag with true poses to a diagnosis by the three commands that the documentation shows."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from test.calibrate import helpers
from test.calibrate.bags import frames
from test.helpers_bags import pose
from test.helpers_cli import run
from test.imports.drivers import femto_lines, write_driver_bag

ROOT = Path(__file__).resolve().parents[2]


def commands_of(page: str) -> list[list[str]]:
    """Return the arguments of the commands of a page that lead from a driver's bag to a diagnosis."""
    block = re.search(r"^    rim import my_bag.*\n(?:    rim .*\n)+", page, flags=re.MULTILINE)
    assert block is not None
    return [shlex.split(line, comments=True)[1:] for line in block[0].splitlines()]


@pytest.mark.slow
def test_from_a_femto_to_the_missing_effect(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cyclic error of 30 mm, published as a Femto does: whole millimetres along z, compressed."""
    (tmp_path / "truth").mkdir()
    truth = helpers.camera(
        tmp_path / "truth", CyclicError(harmonics=(Harmonic(order=4, amplitude=0.03, phase=0.6),))
    )
    board = helpers.scene(tmp_path)
    recorded = list(frames(truth, board))
    lines, own = femto_lines(recorded, truth, distortion=np.zeros(8))
    for frame in recorded:
        stated = pose(frame.pose_stamps["board"], frame.truth["board"])
        if not any(line.topic == stated.topic and line.time == stated.time for line in lines):
            lines.append(stated)
    write_driver_bag(tmp_path / "my_bag", lines, own, ros1=False)
    (tmp_path / "scene.yaml").rename(tmp_path / "board.yaml")
    monkeypatch.chdir(tmp_path)
    commands = commands_of((ROOT / "README.md").read_text())
    assert [one[0] for one in commands] == ["import", "camera", "diagnose"]
    assert commands_of((ROOT / "docs" / "drivers.md").read_text()) == commands
    for words in commands:
        # the poses are in the bag
        status, _, notes = run(capsys, *(word.replace("--board", "--scene") for word in words))
        assert status == 0, notes
    mine = load_camera(tmp_path / "camera.yaml")
    # 3 mm, 6 m counts, and 1 mm along z rounded
    assert mine.noise.sigma_distance(np.array([3000.0]))[0] == pytest.approx(0.0036, rel=0.15)
    report = json.loads((tmp_path / "diagnosis" / "report.json").read_text())
    assert report["verdict"] == "missing_physics"
    assert [one["effect"] for one in report["missing"]] == ["cyclic_error"]
    found = report["missing"][0]["parameters"]["harmonics"][0]
    assert found["order"] == 4
    assert found["amplitude"] == pytest.approx(0.03, abs=0.003)
