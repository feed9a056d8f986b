"""Simulator, playback and timeline as devices, without ROS."""

from __future__ import annotations

import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.playback import Playback
from rim_camera_ros.devices.simulator import Simulator
from rim_camera_ros.devices.source import Source
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.errors import DeviceError, InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import NANOSECONDS, RawFrame
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Station, Surface

START = 5_000_000_000_000


@pytest.fixture(scope="module")
def camera() -> Camera:
    return load_camera(find_camera("sr3000"))


def scene(*stations: Station, z: float = 2.0, motion: CameraMotion | None = None) -> Scene:
    wall = Surface(name="wall", type="plane", pose=ScenePose((0.0, 0.0, z)))
    return Scene((wall,), camera_motion=motion or CameraMotion(), schedule=stations)


TWO = (
    Station(frames=3, rate=10.0, integration_time=60.0, uptime=5.0, ambient=30.0),
    Station(frames=2, rate=20.0, integration_time=100.0, uptime=65.0, poses={"wall": ScenePose((0, 0, 3.0))}),
)


def taken(device: Any, count: int) -> list[RawFrame]:
    frames = [device.next_frame() for _ in range(count)]
    assert all(frames)
    return frames


# --- simulator ----------------------------------------------------------------------------------


def test_as_fast_as_possible_is_the_simulation_of_the_schedule(camera: Camera) -> None:
    device = Simulator(scene(*TWO), camera, seed=4, real_time=False, start=START)
    device.open()
    frames = taken(device, 5)
    assert device.next_frame() is None
    simulation = Simulation(camera, scene(*TWO), seed=4)
    for frame, exposure in zip(frames, Timeline(scene(*TWO), camera, start=START), strict=True):
        expected = simulation.frame(exposure)
        assert np.array_equal(frame.distance, expected.distance)
        assert np.array_equal(frame.amplitude, expected.amplitude)
        assert frame.settings == expected.settings
        assert (frame.stamp, frame.pose_stamps) == (expected.stamp, expected.pose_stamps)
    assert [one.stamp - START for one in frames] == [0, 10**8, 2 * 10**8, 60 * 10**9, 60_050_000_000]
    assert [one.settings.uptime for one in frames] == pytest.approx([5.0, 5.1, 5.2, 65.0, 65.05])
    assert [one.settings.integration_time for one in frames] == [60.0, 60.0, 60.0, 100.0, 100.0]
    assert [one.truth["wall"].position[2] for one in frames] == [2.0, 2.0, 2.0, 3.0, 3.0]


def test_frames_of_a_station_carry_one_pose_message(camera: Camera) -> None:
    device = Simulator(scene(*TWO), camera, real_time=False, start=START)
    device.open()
    stamps = [one.pose_stamps["wall"] - START for one in taken(device, 5)]
    assert stamps == [0, 0, 0, 60 * 10**9, 60 * 10**9]
    moving = Simulator(scene(motion=CameraMotion((0.0, 0.0, 0.1))), camera, real_time=False, start=START)
    moving.open()
    frames = taken(moving, 3)
    assert [one.pose_stamps["wall"] for one in frames] == [one.stamp for one in frames]
    assert [one.truth["wall"].position[2] for one in frames] == pytest.approx([2.0, 1.996, 1.992])


def test_a_schedule_that_repeats_begins_with_everything_as_at_first(camera: Camera) -> None:
    device = Simulator(scene(*TWO), camera, real_time=False, start=START, repeat=True)
    device.open()
    frames = taken(device, 12)
    assert [one.truth["wall"].position[2] for one in frames] == [2, 2, 2, 3, 3, 2, 2, 2, 3, 3, 2, 2]
    assert [one.settings.integration_time for one in frames[5:8]] == [60.0] * 3
    assert frames[5].settings.uptime == 5.0
    assert all(a.stamp < b.stamp for a, b in pairwise(frames))
    moving = Simulator(
        scene(motion=CameraMotion((0.0, 0.0, 0.1))), camera, real_time=False, start=START, repeat=True
    )
    moving.open()
    depths = [one.truth["wall"].position[2] for one in taken(moving, 102)]
    assert depths[100:] == pytest.approx(depths[:2])


def test_settings_change_from_the_next_frame_on(camera: Camera) -> None:
    device = Simulator(scene(*TWO), camera, real_time=False, start=START, repeat=True)
    device.open()
    first = taken(device, 1)[0]
    device.set_integration_time(16.0)
    device.set_frame_rate(50.0)
    assert device.frame_rate == 50.0
    frames = taken(device, 4)
    assert [one.settings.integration_time for one in frames] == [16.0] * 4  # also in the next station
    assert frames[1].stamp - frames[0].stamp == 20_000_000
    assert frames[0].amplitude.mean() < first.amplitude.mean() / 3
    device.set_integration_time(None)
    assert taken(device, 1)[0].settings.integration_time == 60.0
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"integration_time: integration time .* is not positive"):
            device.set_integration_time(wrong)
        with pytest.raises(InputError, match=r"frame rate .* Hz is not positive"):
            device.set_frame_rate(wrong)
    assert device.frame_rate == 50.0


def test_real_time_has_no_drift_and_stamps_are_now(camera: Camera) -> None:
    device = Simulator(scene(*TWO), camera, frame_rate=100.0, repeat=True)
    device.open()
    device.next_frame()
    frames, late = [], []
    # on a machine that is busy every one of a few may be late
    while len(frames) < 20 or (min(late) >= 10_000_000 and len(frames) < 2000):
        frames += taken(device, 1)
        late.append(time.time_ns() - frames[-1].stamp)
    steps = np.diff([one.stamp for one in frames])
    assert set((steps % 10_000_000).tolist()) == {0}
    assert 0 <= min(late) < 10_000_000  # the least late of them is not of an earlier period
    uptimes = [one.settings.uptime or 0.0 for one in frames]
    # nobody waits a minute for the second station: the camera runs on, also when the schedule repeats
    since = [(one.stamp - frames[0].stamp) / NANOSECONDS for one in frames]
    assert np.subtract(uptimes, uptimes[0]) == pytest.approx(since, abs=1e-6)
    assert 5.0 < uptimes[0] < 6.0
    assert len({one.settings.integration_time for one in frames}) == 2
    missed = (frames[-1].stamp - frames[0].stamp) // 10_000_000 - (len(frames) - 1)
    assert device.skipped == missed or device.skipped > 0


def test_late_frames_are_skipped_not_queued(camera: Camera) -> None:
    device = Simulator(scene(), camera, frame_rate=200.0)
    device.open()
    before = taken(device, 2)[-1].stamp
    time.sleep(0.1)  # somebody is slow
    assert time.time_ns() - taken(device, 1)[0].stamp < 50_000_000
    assert device.skipped >= 15
    assert (taken(device, 1)[0].stamp - before) % 5_000_000 == 0


def test_stamps_follow_a_wall_clock_that_is_set(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Simulator(scene(), camera, frame_rate=100.0)
    device.open()
    first = taken(device, 1)[0]
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() - 3600 * NANOSECONDS)
    second = taken(device, 1)[0]
    assert -3601 < (second.stamp - first.stamp) / NANOSECONDS < -3599
    uptimes = [one.settings.uptime or 0.0 for one in (first, second)]
    assert 0 < uptimes[1] - uptimes[0] < 1  # the camera knows nothing of that


def test_closing_ends_the_wait_in_another_thread(camera: Camera) -> None:
    device = Simulator(scene(), camera, frame_rate=0.01)
    device.open()
    device.next_frame()
    timer = threading.Timer(0.05, device.close)
    begun = time.monotonic()
    timer.start()
    assert device.next_frame() is None
    assert time.monotonic() - begun < 5
    assert device.next_frame() is None
    device.close()
    device.open()
    assert device.next_frame() is not None


def test_scenes_that_cannot_be_simulated_are_reported_on_opening(camera: Camera) -> None:
    with pytest.raises(InputError, match="no ray of the camera meets a surface"):
        Simulator(scene(z=-2.0), camera).open()
    nameless = Scene((Surface(name="board", type="plane", pose="truth"),))
    with pytest.raises(InputError, match="surface 'board' has pose: truth"):
        Simulator(nameless, camera).open()
    with pytest.raises(DeviceError, match="not open"):
        Simulator(scene(), camera).next_frame()


def test_a_waveform_makes_another_distance(camera: Camera) -> None:
    means = []
    for waveform in (None, Waveform.square(0.5)):
        device = Simulator(scene(), camera, real_time=False, waveform=waveform)
        device.open()
        means.append(taken(device, 1)[0].distance.astype(float).mean())
    assert abs(means[0] - means[1]) > 1.0


# --- playback -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(camera: Camera, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[RawFrame]]:
    device = Simulator(scene(*TWO), camera, real_time=False, start=START)
    device.open()
    frames = taken(device, 5)
    path = tmp_path_factory.mktemp("bag") / "recording"
    with RecordingWriter(path) as writer:
        for frame in frames:
            writer.write_raw(frame)
    return path, frames


def test_playback_is_what_was_recorded(recording: tuple[Path, list[RawFrame]]) -> None:
    path, frames = recording
    device = Playback(path, real_time=False)
    device.open()
    for expected in frames:
        frame = taken(device, 1)[0]
        assert np.array_equal(frame.distance, expected.distance)
        assert np.array_equal(frame.amplitude, expected.amplitude)
        assert frame.settings.uptime == expected.settings.uptime
        assert frame.settings.ambient_temperature == 30.0
        assert (frame.stamp, frame.pose_stamps) == (expected.stamp, expected.pose_stamps)
        assert frame.intrinsics == expected.intrinsics
    assert device.next_frame() is None
    device.close()


def test_stamps_of_a_loop_go_on_increasing(recording: tuple[Path, list[RawFrame]]) -> None:
    path, frames = recording
    device = Playback(path, real_time=False, loop=True)
    device.open()
    played = taken(device, 13)
    stamps = [one.stamp for one in played]
    assert all(a < b for a, b in pairwise(stamps))
    assert [b - a for a, b in pairwise(stamps[5:10])] == [b - a for a, b in pairwise(stamps[:5])]
    period = (frames[-1].stamp - frames[0].stamp) / 4
    assert stamps[5] - stamps[4] == pytest.approx(period, rel=1e-6)
    assert all(one.pose_stamps["wall"] <= one.stamp for one in played)
    assert len({one.pose_stamps["wall"] for one in played[:5]}) == 2


def test_playback_in_real_time(recording: tuple[Path, list[RawFrame]]) -> None:
    path, frames = recording
    device = Playback(path, frame_rate=100.0, loop=True)
    device.open()
    assert device.frame_rate == 100.0
    played = taken(device, 12)
    assert 0 <= time.time_ns() - played[-1].stamp < 50_000_000
    assert np.allclose(np.diff([one.stamp for one in played]), 10_000_000, atol=100_000_000)
    assert [np.array_equal(a.distance, b.distance) for a, b in zip(played, frames * 2, strict=False)] == [
        True
    ] * 10
    assert played[2].pose_stamps["wall"] == played[0].stamp
    with pytest.raises(
        InputError, match="integration_time: the integration time of a recording cannot be changed"
    ):
        device.set_integration_time(60.0)
    device.set_integration_time(None)
    intervals = Playback(path, rate=10.0)
    intervals.open()
    first, second = taken(intervals, 2)
    assert second.stamp - first.stamp == pytest.approx(10_000_000, abs=5_000_000)
    threading.Timer(0.05, intervals.close).start()  # the gap of a minute comes in 6 s
    taken(intervals, 1)
    assert intervals.next_frame() is None


def test_recorded_stamps_in_real_time(recording: tuple[Path, list[RawFrame]]) -> None:
    path, frames = recording
    device = Playback(path, frame_rate=200.0, stamps="recorded")
    device.open()
    assert [one.stamp for one in taken(device, 5)] == [one.stamp for one in frames]


def test_a_recording_that_cannot_be_read(recording: tuple[Path, list[RawFrame]], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        Playback(tmp_path / "nowhere").open()
    (file,) = recording[0].glob("*.mcap")
    data = file.read_bytes()
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[: len(data) * 6 // 10])
    device = Playback(damaged, real_time=False)
    device.open()
    with pytest.raises(DeviceError, match=r"damaged\.mcap.*frames read before it: [1-4]"):
        taken(device, 5)
    device.close()
    damaged.write_bytes(data)
    device.open()  # somebody has mended it
    assert len(taken(device, 5)) == 5


def test_a_loop_over_a_file_that_vanishes_is_a_device_error(
    recording: tuple[Path, list[RawFrame]], tmp_path: Path
) -> None:
    (file,) = recording[0].glob("*.mcap")
    path = tmp_path / "there.mcap"
    path.write_bytes(file.read_bytes())
    device = Playback(path, real_time=False, loop=True)
    device.open()
    taken(device, 4)
    path.unlink()
    with pytest.raises(DeviceError, match=r"there\.mcap"):
        taken(device, 5)


# --- source -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"source": "simulater"}, r"source: no source 'simulater' \(did you mean 'simulator'\?\)"),
        ({"source": "playback"}, "recording: source playback needs a recording"),
        ({"waveform": "saw"}, "waveform: unknown waveform 'saw'"),
        ({"camera": "sr3001"}, "sr3001: no camera file of this name"),
        ({"scene": "attic"}, "attic: no scene file of this name"),
        (
            {"source": "playback", "recording": "x", "integration_time": 5.0},
            "integration time of a recording",
        ),
    ],
)
def test_sources_that_cannot_be_opened(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Source(**values).open()


def test_a_source_opens_what_it_says(recording: tuple[Path, list[RawFrame]]) -> None:
    device = Source(scene="wall", frame_rate=12.5, integration_time=60.0, as_fast_as_possible=True).open()
    frames = taken(device, 2)
    assert frames[0].settings.integration_time == 60.0
    assert frames[1].stamp - frames[0].stamp == 80_000_000
    played = Source(
        source="playback", recording=str(recording[0]), as_fast_as_possible=True, loop=False
    ).open()
    assert [one.stamp for one in taken(played, 5)] == [one.stamp for one in recording[1]]
    assert played.next_frame() is None
