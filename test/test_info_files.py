"""``rim info`` of camera and scene files, and the printing of facts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.info.statistics import Histogram, Timing
from rim_camera_ros.info.text import listed_short, number, percent, section, span, table, words

from .helpers_cli import CAMERA, SCENE, run, write_text

Capture = pytest.CaptureFixture[str]

EFFECTS = """
minimum_amplitude: 150
effects:
  distance_scale: {scale: 0.002}
  integration_time_offset: {offset: {20: 0.01, 80: -0.03}}
  motion: {sample_interval: 0.01}
validity: {distance: [0.5, 6.5], region: [1, 2, 10, 8]}
provenance: {fitted_by: nobody, recordings: [a, b], extra: {x: 1, y: null}}
"""


def test_a_camera_file(capsys: Capture, tmp_path: Path) -> None:
    camera = write_text(tmp_path / "camera.yaml", CAMERA + EFFECTS)
    status, out, err = run(capsys, "info", camera, "--json")
    assert (status, err) == (0, "")
    facts = json.loads(out)
    assert facts["kind"] == "camera"
    assert (facts["width"], facts["height"], facts["wraps"]) == (12, 9, True)
    # 11 px between the outer pixel centres of a row, 8 in a column
    across = np.degrees(np.arctan(5.3 / 14) + np.arctan(5.7 / 14))
    down = np.degrees(np.arctan(4.1 / 15) + np.arctan(3.9 / 15))
    assert facts["field_of_view_deg"] == pytest.approx([across, down], abs=0.2)
    assert facts["noise_m"]["1000.0"] == pytest.approx(np.hypot(0.004, 0.02))
    assert facts["minimum_amplitude_counts"] == {"20": 150, "80": 150}
    assert list(facts["effects"]) == ["motion", "integration_time_offset", "distance_scale"]
    assert facts["validity"] == {"distance": [0.5, 6.5], "region": [1, 2, 10, 8]}
    text = run(capsys, "info", camera)[1]
    for part in (
        "12 x 9 px", "20 MHz: unambiguous to 7.495 m", "counts wrap there", "mm per metre",
        "- motion ", "integration time   20   80", "0.5 .. 6.5 m", "1 2 10 8", "a, b", "x 1, y none",
    ):  # fmt: skip
        assert part in text, part
    assert max(map(len, text.splitlines())) <= 100
    assert "{" not in text


def test_a_camera_that_resolves_the_ambiguity(capsys: Capture, tmp_path: Path) -> None:
    text = CAMERA.replace("20.0e6}", "80.0e6, distance_lsb: 1.0e-4, amplitude_threshold: 30}")
    out = run(capsys, "info", write_text(tmp_path / "camera.yaml", text))[1]
    assert "the camera resolves the ambiguity itself" in " ".join(out.split())
    assert "nothing delivered below 30 counts" in out
    assert "none: distances are taken as measured" in out


def test_the_content_tells_the_kind(capsys: Capture, tmp_path: Path) -> None:
    """Not the name of the file."""
    for name, text, kind in (("a.txt", CAMERA, "camera"), ("b", SCENE, "scene"), ("c.yml", CAMERA, "camera")):
        status, out, _ = run(capsys, "info", write_text(tmp_path / name, text), "--json")
        assert (status, json.loads(out)["kind"]) == (0, kind)


def test_a_scene_with_a_camera(capsys: Capture, tmp_path: Path) -> None:
    scene = write_text(
        tmp_path / "scene.yaml",
        """
format: rim_scene/1
surfaces:
- {name: board, type: rectangle, size: [0.8, 9.0], pose: {position: [-1.0, 0, 2]}, reflectivity: 0.2}
- {name: wall, type: plane, pose: {position: [0, 0, 4]}, texture: {cell: [0.1, 0.1], values: [[0.3, 0.6]]}}
- {name: ball, type: sphere, radius: 0.15, pose: {position: [0, 0, -3]}}
schedule:
- {frames: 5, rate: 10, integration_time: 40, ambient: 18}
- {frames: 7, rate: 20, integration_time: 90, poses: {board: {position: [1, 0, 2]}}}
""",
    )
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    facts = json.loads(run(capsys, "info", scene, "--camera", camera, "--json")[1])
    assert (facts["stations"], facts["frames"], facts["duration_s"]) == (2, 12, pytest.approx(0.85))
    seen = facts["seen"]
    # x / z of the columns: (u - 5.3) / 14 within (-1.4 .. -0.6) / 2 for u = 0, 1
    assert seen["share_of_pixels"] == pytest.approx({"board": 2 / 12, "wall": 10 / 12, "ball": 0.0})
    assert seen["integration_time"] == 40
    assert 2.0 < seen["distance_m"][0] < 2.2
    assert 4.0 < seen["distance_m"][1] < 5.0
    text = run(capsys, "info", scene, "--camera", camera)[1]
    for part in ("2 stations, 12 frames, 0.85 s", "0.3 .. 0.6", "r 0.15", "16.67 %", "at setting 40"):
        assert part in text, part


def test_a_dark_scene(capsys: Capture, tmp_path: Path) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE.replace("0.7", "0.0"))
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    status, out, err = run(capsys, "info", scene, "--camera", camera)
    assert (status, err) == (0, "")
    assert "distances" in out


def test_a_scene_of_a_recording(capsys: Capture, tmp_path: Path) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE.replace("{position: [0, 0, 2.5]}", "truth"))
    status, out, _ = run(capsys, "info", scene, "--camera", write_text(tmp_path / "camera.yaml", CAMERA))
    assert status == 0
    assert "poses from a recording  wall (--poses BAG)" in out


def test_texts() -> None:
    assert section("head", [("a", "1"), ("long", "2")]) == "head\n  a     1\n  long  2"
    assert table(["x", "y"], [["ab", 1], ["c", 22]]) == "  x    y\n  ab   1\n  c   22"
    assert (number(123456.0), number(0.00012345, "m"), number(None)) == ("123456", "0.0001234 m", "-")
    shares = [percent(one) for one in (0.0, 1e-6, 0.12345, 1.0, None)]
    assert shares == ["0 %", "< 0.01 %", "12.35 %", "100 %", "-"]
    assert (span(1.0, 1.0, "m"), span(1.0, 2.5, "m"), span(None, None)) == ("1 m", "1 .. 2.5 m", "-")
    assert listed_short(list("abcdefghij")) == "a, b, c, d, e, f, g, h and 2 more"
    assert words({"a": [1, 2], "b": []}) == "a 1, 2, b none"


def test_histograms() -> None:
    histogram = Histogram(0.5)
    histogram.add(np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 2.0, 2.0, 3.0]))
    assert histogram.percentiles(0.5, (0.25, 0.5, 0.75)) == [2.0, 2.0, 3.0]
    assert Histogram(1.0).percentiles(1.0) is None


def test_timing_of_few_frames() -> None:
    timing = Timing()
    assert timing.facts()["rate_hz"] is None
    timing.add(5 * 10**9)
    assert (timing.facts()["start_s"], timing.facts()["duration_s"]) == (5.0, 0.0)
    timing.add(5 * 10**9)  # one stamp twice
    assert timing.facts()["rate_hz"] is None
