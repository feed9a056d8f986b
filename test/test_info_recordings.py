"""``rim info`` of recordings: what is computed, and what is reported of recordings that are not whole."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.bags.messages import image_message, temperature_message
from rim_camera_ros.frame import Pose, RawFrame

from .helpers_cli import CAMERA, raw_frame, run, write_bag, write_text

Capture = pytest.CaptureFixture[str]
STEP = 40_000_000
#: Metres per count of CAMERA.
LSB = 299_792_458.0 / 40e6 / 65536


def refuse(token: str) -> None:
    raise AssertionError(token)


@pytest.fixture
def facts(capsys: Capture) -> Callable[..., dict[str, Any]]:
    """Return what ``rim info --json`` says; NaN and Infinity in it are refused."""

    def of(*arguments: str | Path) -> dict[str, Any]:
        status, out, err = run(capsys, "info", "--json", *arguments)
        assert (status, err) == (0, "")
        result: dict[str, Any] = json.loads(out, parse_constant=refuse)
        return result

    return of


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return write_text(tmp_path / "camera.yaml", CAMERA)


def noisy(
    count: int, *, sigma: float, amplitude: float, speed: float = 0.0, shape: tuple[int, int] = (9, 12)
) -> Iterator[RawFrame]:
    """Frames of white noise of ``sigma`` counts around a slope, moving by ``speed`` counts a frame."""
    rng = np.random.default_rng(4)
    base = raw_frame(0, shape)
    for i in range(count):
        distance = base.distance + speed * i + sigma * rng.standard_normal(shape)
        yield replace(
            base,
            stamp=10**9 + i * STEP,
            distance=np.rint(distance).astype(np.uint16),
            amplitude=np.full(shape, amplitude).astype(np.uint16),
        )


def test_noise_is_measured_and_held_against_the_model(
    facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    bag = write_bag(tmp_path / "bag", list(noisy(120, sigma=70.0, amplitude=3000)))
    found = facts(bag, "--camera", camera)["noise"]
    (row,) = found["classes"]
    assert (found["unit"], found["moving"]) == ("m", False)
    assert row["amplitude_counts"] == [1600, 3200]
    assert row["values"] == 119 * 9 * 12
    assert row["sigma"] == pytest.approx(70.0 * LSB, rel=0.02)
    assert row["model"] == pytest.approx(np.hypot(0.004, 20.0 / 3000), rel=1e-6)
    (row,) = facts(bag)["noise"]["classes"]
    assert row["sigma"] == pytest.approx(70.0, rel=0.02)
    assert "model" not in row


def test_outliers_do_not_enter_the_noise(
    facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    frames = list(noisy(120, sigma=30.0, amplitude=500))
    rng = np.random.default_rng(7)
    for frame in frames:
        where = rng.random(frame.distance.shape)
        frame.distance[where < 0.01] += 3000
        frame.distance[where > 0.99] = 0
        frame.amplitude[where > 0.98] = 0
    bag = write_bag(tmp_path / "bag", frames)
    (row,) = facts(bag, "--camera", camera)["noise"]["classes"]
    assert row["sigma"] == pytest.approx(30.0 * LSB, rel=0.03)


def test_distances_that_wrap_are_not_noise(
    facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    frames = list(noisy(60, sigma=20.0, amplitude=500))
    for frame in frames:
        frame.distance[...] = frame.distance - np.uint16(20200)  # around 0
    bag = write_bag(tmp_path / "bag", frames)
    (row,) = facts(bag, "--camera", camera)["noise"]["classes"]
    assert row["sigma"] == pytest.approx(20.0 * LSB, rel=0.05)


def test_a_scene_that_moves_is_reported(
    capsys: Capture, facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    bag = write_bag(tmp_path / "bag", list(noisy(30, sigma=10.0, amplitude=500, speed=40.0)))
    assert facts(bag, "--camera", camera)["noise"]["moving"] is True
    assert "the scene or the camera moves" in run(capsys, "info", bag)[1]


def test_a_new_pose_is_no_noise(
    capsys: Capture, facts: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    frames = [
        replace(
            one,
            truth={"board": Pose((0.0, 0.0, 1.0 + i))},
            pose_stamps={"board": one.stamp},
        )
        for i, one in enumerate(noisy(5, sigma=10.0, amplitude=500, speed=300.0))
    ]
    bag = write_bag(tmp_path / "bag", frames)
    found = facts(bag)
    assert (found["noise"]["classes"], found["poses"], found["truth_surfaces"]) == ([], 5, ["board"])
    text = run(capsys, "info", bag)[1]
    assert "not known: no two successive frames of one pose and setting" in text
    assert "board, 5 different" in text


def test_distances_in_metres(facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path) -> None:
    rng = np.random.default_rng(3)
    frames = []
    for i in range(60):
        distance = (8.5 + 0.006 * rng.standard_normal((9, 12))).astype(np.float32)
        distance[0, 0] = np.nan
        distance[0, 1] = 0.0
        frames.append(replace(raw_frame(10**9 + i * STEP), distance=distance))
    bag = write_bag(tmp_path / "bag", frames)
    for more in ((), ("--camera", camera)):
        found = facts(bag, *more)
        assert found["distance_unit"] == "m"
        low, median, high = found["distance_percentiles_1_50_99"]
        assert (low, median, high) == pytest.approx((8.486, 8.5, 8.514), abs=0.002)
        assert found["no_measurement_share"] == pytest.approx(2 / 108)
        (row,) = [one for one in found["noise"]["classes"] if one["amplitude_counts"][0] == 800]
        assert row["sigma"] == pytest.approx(0.006, rel=0.03)


def test_settings_gaps_and_shares(
    capsys: Capture, facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    frames = []
    for i, at in enumerate([0, 1, 2, 3, 7, 8, 9, 11]):
        frame = raw_frame(
            10**9 + at * STEP,
            integration_time=16.0 if i < 3 else 60.0,
            uptime=5.0 + i,
            ambient_temperature=20.5,
            body_temperature=30.0 + i / 2,
        )
        frame.distance[2, :3] = 0
        frame.amplitude[4, 5] = 65535
        frames.append(frame)
    bag = write_bag(tmp_path / "bag", frames)
    found = facts(bag, "--camera", camera)
    assert (found["frames"], found["width"], found["height"]) == (8, 12, 9)
    assert (found["rate_hz"], found["duration_s"]) == (25.0, pytest.approx(0.44))
    assert (found["gaps"], found["missing_frames"], found["longest_gap_s"]) == (2, 4, pytest.approx(0.16))
    assert found["jitter_s"] == 0.0
    assert found["settings"]["integration_times"] == {"16": 3, "60": 5}
    assert found["settings"]["uptime"] == [5.0, 12.0]
    assert found["settings"]["body_temperature"] == [30.0, 33.5]
    assert found["no_measurement_share"] == pytest.approx(3 / 108)
    assert found["saturated_share"] == pytest.approx(1 / 108)
    assert found["distance_percentiles_1_50_99"][1] == pytest.approx(20248 * LSB, rel=0.01)
    text = run(capsys, "info", bag)[1]
    for part in ("16 (3 frames), 60 (5 frames)", "5 .. 12 s", "2, the longest 0.16 s", "20.5 degC", "2.78 %"):
        assert part in text


def test_frames_in_groups_are_none_that_are_missing(
    capsys: Capture, facts: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    """Three poses of three frames, a minute apart: at 25 Hz 2998 would fit between them."""
    at = [t for start in (0, 1500, 3000) for t in (start, start + 1, start + 2)]
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9 + t * STEP) for t in at])
    assert facts(bag)["missing_frames"] == 2 * 1497
    text = run(capsys, "info", bag)[1]
    assert "frames come in groups with pauses between them" in " ".join(text.split())
    assert "are missing" not in text


def test_a_camera_of_another_modulation_is_reported(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9, modulation_frequency=30e6)])
    status, out, _ = run(capsys, "info", bag, "--camera", camera)
    assert status == 0
    assert "modulation at 30 MHz, but the camera file is for 20 MHz" in out


def test_a_corrected_recording(
    capsys: Capture, facts: Callable[..., dict[str, Any]], tmp_path: Path, camera: Path
) -> None:
    raw = [
        replace(
            raw_frame(10**9 + i * STEP), truth={"wall": Pose((0.0, 0.0, 2.0))}, pose_stamps={"wall": 10**9}
        )
        for i in range(3)
    ]
    for one in raw:
        one.distance[3, 4] = 0
    bag = write_bag(tmp_path / "bag", raw)
    out = tmp_path / "out"
    assert run(capsys, "correct", bag, "--camera", camera, "--out", out, "--quiet")[0] == 0
    found = facts(out)
    assert found["frames"] == 0
    corrected = found["corrected"]
    assert (corrected["frames"], corrected["rate_hz"], corrected["width"]) == (3, 25.0, 12)
    assert corrected["flag_shares"]["no_measurement"] == pytest.approx(1 / 108)
    assert corrected["distance_percentiles_1_50_99_m"][1] == pytest.approx(20248 * LSB, abs=0.003)
    assert found["truth_surfaces"] == ["wall"]
    assert "corrected frames, no raw ones" in run(capsys, "info", out)[1]


def test_a_truncated_recording_is_reported_as_far_as_it_goes(capsys: Capture, tmp_path: Path) -> None:
    frames = list(noisy(40, sigma=5.0, amplitude=700, shape=(72, 88)))
    whole = next(write_bag(tmp_path / "bag", frames).glob("*.mcap")).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    status, out, err = run(capsys, "info", cut)
    assert status == 2
    count = int(out.partition("frames ")[2].split()[0])
    assert 15 <= count <= 20
    assert err.startswith(f"rim: {cut}: ")
    assert f"frames read before it: {count}" in err
    assert len(err.splitlines()) == 1
    status, out, _ = run(capsys, "info", cut, "--json")
    assert status == 2
    assert json.loads(out)["fault"] == err.removeprefix("rim: ").strip()


def test_a_foreign_recording_lists_its_topics(capsys: Capture, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write_message(
            "/tof/range", "sensor_msgs/msg/Image", 10**9, image_message(raw_frame(1).distance, 10**9)
        )
        writer.write_message(
            "/weather", "sensor_msgs/msg/Temperature", 10**9, temperature_message(21.5, 10**9)
        )
    status, out, err = run(capsys, "info", tmp_path / "bag")
    assert status == 2
    assert "/tof/range" in out
    assert "/weather" in out
    assert "no topic /camera/distance/image_raw" in err
    assert "--topic distance=name" in err


def test_another_topic(facts: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for topic in ("/tof/range", "/tof/brightness"):
            image = image_message(raw_frame(1).distance, 10**9)
            writer.write_message(topic, "sensor_msgs/msg/Image", 10**9, image)
    found = facts(tmp_path / "bag", "--topic", "distance=/tof/range", "--topic", "amplitude=/tof/brightness")
    assert found["frames"] == 1
    assert found["topics"]["/tof/range"]["role"] == "distance"


def test_by_the_metadata_and_by_the_file(facts: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9)])
    for path in (bag, bag / "metadata.yaml", next(bag.glob("*.mcap"))):
        assert facts(path)["frames"] == 1
