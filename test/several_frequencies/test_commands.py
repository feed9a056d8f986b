"""Several frequencies on the command line: the whole path, and what is wrong in recordings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, RecordingWriter, Topics
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.errors import InputError
from rim_camera_ros.measurement import measurement_of
from test.diagnose.helpers import run, scene_text

CAMERA = """
format: rim_camera/1
device: two frequencies
sensor: {width: 24, height: 20, pixel_pitch: [160.0e-6, 160.0e-6], modulation_frequency: [100.0e6, 80.0e6]}
optics: {fx: 30.0, fy: 30.0, cx: 11.7, cy: 9.2}
radiometry: {gain: 200.0}
noise: {floor: 0.001, shot: 0.0, amplitude: [2.0, 2.5]}
effects:
  cyclic_error:
  - harmonics: [{order: 4, amplitude: 0.003, phase: 0.7}]
  - harmonics: [{order: 4, amplitude: 0.005, phase: -1.1}]
  fixed_pattern_offset: [{map: first.npy}, {map: second.npy}]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a wall at 18 distances from 0.9 to 4.3 m, its camera, and one with a wrong offset."""
    folder = tmp_path_factory.mktemp("frequencies")
    for name, metres in (("first", 0.004), ("second", -0.011), ("wrong", 0.019)):
        np.save(folder / f"{name}.npy", np.full((20, 24), metres, np.float32))
    (folder / "camera.yaml").write_text(CAMERA)
    (folder / "offset.yaml").write_text(CAMERA.replace("second.npy", "wrong.npy"))
    (folder / "scene.yaml").write_text(scene_text())
    run("simulate", folder / "scene.yaml", camera=folder / "camera.yaml", out=folder / "bag", seed=2)
    return folder


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


def test_simulated_corrected_and_looked_at(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("correct", folder / "bag", camera=folder / "camera.yaml", out=tmp_path / "corrected")
    with Recording(tmp_path / "corrected") as bag:
        frames = list(bag.corrected_frames())
    assert len(frames) == 72
    # the wall at the last pose is 4.3 m away, more than two ranges of either frequency
    assert np.median(frames[-1].distance[8:12, 10:14]) == pytest.approx(4.3, abs=0.03)
    assert np.isfinite(frames[-1].distance).all()
    assert main(["info", str(folder / "bag"), "--camera", str(folder / "camera.yaml")]) == 0
    text = capsys.readouterr().out
    assert "distance_1/image_raw" in text
    assert "those of distance_0 and amplitude_0" in text
    table = text[text.index("camera file [mm]") :].split("topics")[0].splitlines()[1:]
    ratios = [float(line.split()[-1]) for line in table if " .. " in line]
    assert len(ratios) > 2
    assert ratios == pytest.approx([1.0] * len(ratios), abs=0.15)


@pytest.mark.parametrize(
    ("missing", "match"),
    [
        ("amplitude_1", "distance_1 without amplitude_1: no topic /camera/amplitude_1/image_raw"),
        ("distance_0", "amplitude_0 without distance_0: no topic /camera/distance_0/image_raw"),
    ],
)
def test_a_recording_that_lacks_an_image_says_which(
    folder: Path, tmp_path: Path, missing: str, match: str
) -> None:
    topics = Topics()
    with Recording(folder / "bag") as bag, RecordingWriter(tmp_path / "bag") as writer:
        frame = next(bag.frames())
        for role, image in frame.by_role.items():
            if role != missing:
                writer._write_image(role, image, frame.stamp)
    with Recording(tmp_path / "bag", topics=topics) as bag, pytest.raises(InputError, match=match):
        list(bag.frames())


def test_frames_of_which_an_image_is_lost_are_counted(folder: Path, tmp_path: Path) -> None:
    with Recording(folder / "bag") as bag, RecordingWriter(tmp_path / "bag") as writer:
        for number, frame in zip(range(4), bag.frames(), strict=False):
            for role, image in frame.by_role.items():
                if not (number == 2 and role == "distance_1"):
                    writer._write_image(role, image, frame.stamp)
    with Recording(tmp_path / "bag") as bag:
        assert len(list(bag.frames())) == 3
        assert bag.skipped == {"distance_0 without distance_1": 1}


def test_one_frequency_of_a_recording_is_read_by_its_number(folder: Path) -> None:
    with Recording(folder / "bag") as bag:
        every = next(bag.frames())
    with Recording(folder / "bag", topics=Topics(frequency=1)) as bag:
        assert bag.frame_count == 72
        one = next(bag.frames())
    assert tuple(one.by_role) == ("distance", "amplitude")
    assert np.array_equal(one.distance, every.images["distance_1"])
    assert np.array_equal(one.amplitude, every.images["amplitude_1"])


@pytest.mark.slow
def test_each_frequency_is_calibrated(folder: Path, tmp_path: Path) -> None:
    given = {"camera": folder / "offset.yaml", "scene": folder / "scene.yaml"}
    run("calibrate", folder / "bag", out=tmp_path / "made.yaml", threads=1, **given)
    truth, made = load_camera(folder / "camera.yaml"), load_camera(tmp_path / "made.yaml")
    for one, other in zip(truth.channels, made.channels, strict=True):
        assert other.covariance is not None
        harmonic = other.effects["cyclic_error"].harmonics[0]
        assert harmonic.amplitude == pytest.approx(
            one.effects["cyclic_error"].harmonics[0].amplitude, rel=0.1
        )
        offset = other.effects["fixed_pattern_offset"].map.values.mean()
        assert offset == pytest.approx(one.effects["fixed_pattern_offset"].map.values.mean(), abs=0.0015)
    assert made.provenance.keys() == {"100MHz", "80MHz"}
    assert {one.name for one in tmp_path.glob("*.html")} == {
        "made.100MHz.report.html",
        "made.80MHz.report.html",
    }
    with Recording(folder / "bag") as bag:
        frame = list(bag.frames())[-1]
    corrected = measurement_of(made).correction(made).correct(frame)
    assert np.median(corrected.distance[8:12, 10:14]) == pytest.approx(4.3, abs=0.03)


@pytest.mark.slow
def test_nothing_is_wrong_with_the_right_camera(folder: Path, tmp_path: Path) -> None:
    given = {"camera": folder / "camera.yaml", "scene": folder / "scene.yaml"}
    run("diagnose", folder / "bag", out=tmp_path / "found", threads=1, **given)
    found = report(tmp_path / "found")
    assert (found["verdict"], found["missing"], found["adjusted"]) == ("consistent", [], [])
    assert {one["verdict"] for one in found["parts"].values()} == {"consistent"}
    for name in ("100MHz", "80MHz"):
        assert report(tmp_path / "found" / name)["verdict"] == "consistent"
        assert (tmp_path / "found" / name / "report.html").exists()
    run("diagnose", folder / "bag", "--force", out=tmp_path / "found", threads=1, **given)


@pytest.mark.slow
def test_a_wrong_offset_of_one_frequency_is_a_wrong_parameter(folder: Path, tmp_path: Path) -> None:
    given = {"camera": folder / "offset.yaml", "scene": folder / "scene.yaml"}
    run("diagnose", folder / "bag", out=tmp_path / "found", threads=1, **given)
    found = report(tmp_path / "found")
    assert (found["verdict"], found["missing"]) == ("wrong_parameters", [])
    (moved,) = found["adjusted"]
    assert (moved["effect"], moved["part"]) == ("fixed_pattern_offset", "80MHz")
    assert moved["from"]["mean"] == pytest.approx(0.019)
    assert moved["to"]["mean"] == pytest.approx(-0.011, abs=0.001)
    improved = load_camera(tmp_path / "found" / "camera.yaml")
    means = [float(one.effects["fixed_pattern_offset"].map.values.mean()) for one in improved.channels]
    assert means == pytest.approx([0.004, -0.011], abs=0.001)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["wraps", "range"])
def test_a_wrong_table_of_wraps_is_a_wrong_parameter(folder: Path, tmp_path: Path, key: str) -> None:
    rows = measurement_of(load_camera(folder / "camera.yaml")).table(load_camera(folder / "camera.yaml")).rows  # type: ignore[attr-defined]
    # from its second range on 80 MHz is taken for one range nearer
    wrong = {"wraps": [[n, m if n < 2 else m - 1] for n, m in rows], "range": [0.0, 3.0]}[key]
    text = CAMERA + f"measurement: {{type: several_frequencies, {key}: {wrong}}}\n"
    (folder / f"{key}.yaml").write_text(text)
    given = {"camera": folder / f"{key}.yaml", "scene": folder / "scene.yaml"}
    run("diagnose", folder / "bag", out=tmp_path / "found", threads=1, **given)
    found = report(tmp_path / "found")
    assert (found["verdict"], found["missing"]) == ("wrong_parameters", [])
    (moved,) = found["adjusted"]
    assert moved["effect"] == key
    assert moved["to"] == {key: None}
    assert getattr(load_camera(tmp_path / "found" / "camera.yaml").measurement, key) is None
