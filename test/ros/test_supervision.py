"""The acquisition's watchdog and pause, and the folders that may be read: without ROS processes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rim_camera_ros.bags.stamp_pairing import StampPairing
from rim_camera_ros.devices.acquisition import Acquisition
from rim_camera_ros.errors import DeviceError, InputError, RimError
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.nodes.common.findings import Finding, Flow, Level, Tally
from rim_camera_ros.nodes.common.folders import Folders


class Stalling:
    """A device that delivers three frames and then nothing until it is closed and opened again."""

    frame_rate = 100.0

    def __init__(self) -> None:
        self.opened = 0
        self._closed = threading.Event()
        self._left = 0
        self.open()

    def open(self) -> None:
        if self._left <= 0:
            self.opened += 1
            self._left = 3
            self._closed.clear()

    def next_frame(self) -> RawFrame | None:
        if self._left > 0:
            self._left -= 1
            pixels = np.ones((2, 3), np.uint16)
            return RawFrame(stamp=1, distance=pixels, amplitude=pixels)
        self._closed.wait(20.0)
        return None

    def set_integration_time(self, value: float | None) -> None: ...

    def set_frame_rate(self, value: float | None) -> None: ...

    def close(self) -> None:
        self._closed.set()


class Heard:
    def __init__(self) -> None:
        self.frames = 0
        self.said: list[str] = []

    def on_frame(self, frame: RawFrame) -> bool:
        self.frames += 1
        return True

    def on_end(self) -> None:
        self.said.append("end")

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        self.said.append(f"fault: {error}")

    def on_recovery(self) -> None:
        self.said.append("recovery")


def until(condition: Callable[[], object]) -> bool:
    end = time.monotonic() + 10.0
    while not condition():
        if time.monotonic() > end:
            return False
        threading.Event().wait(0.01)
    return True


def test_a_device_that_stalls_is_given_up_and_delivers_again() -> None:
    device, heard = Stalling(), Heard()
    acquisition = Acquisition(device, heard)
    acquisition.start()
    try:
        assert until(lambda: heard.frames == 3 and acquisition.waits() > 0.05)
        acquisition.give_up(DeviceError("no frame for 0.05 s"))
        assert until(lambda: heard.frames == 6)
        assert heard.said == ["fault: no frame for 0.05 s", "recovery"]
        assert device.opened == 2
    finally:
        acquisition.stop()


def test_nothing_is_requested_in_a_pause_and_it_ends_with_stop() -> None:
    device, heard = Stalling(), Heard()
    acquisition = Acquisition(device, heard, paused=True)
    acquisition.start()
    assert not until_short(lambda: heard.frames)
    assert acquisition.waits() == 0.0
    acquisition.pause(False)
    assert until(lambda: heard.frames == 3)
    acquisition.pause(True)
    acquisition.stop()
    assert not acquisition._thread.is_alive()
    paused = Acquisition(Stalling(), heard, paused=True)
    paused.start()
    paused.stop()
    assert not paused._thread.is_alive()


def until_short(condition: Callable[[], object]) -> bool:
    threading.Event().wait(0.1)
    return bool(condition())


def test_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    (outside / "given.yaml").write_text("x")
    (inside / "link").symlink_to(outside)
    folders = Folders(f"{inside}:{tmp_path / 'second'}", given=["", "sr3000", str(outside / "given.yaml")])
    for allowed in (
        "sr3000",
        "",
        f"{inside}/a.yaml",
        f"{inside}/b/../a.yaml",
        f"{outside}/given.yaml",
        "unknown",
    ):
        folders.check(allowed, kind="calibration", place="camera")
    for refused in (
        f"{outside}/other.yaml",
        f"{inside}/../out/other.yaml",
        f"{inside}/link/other.yaml",
        "/",
        "a.yaml",
    ):
        with pytest.raises(InputError, match=r"camera: lies outside of the folders that may be read"):
            folders.check(refused, kind="calibration", place="camera")
    assert folders.target("desk", place="save_as") == inside / "desk.yaml"
    assert folders.new("desk", place="save_as") == inside / "desk.yaml"
    for taken, free in (
        ("desk.yaml", "desk_2.yaml"),
        ("desk_2.fixed_pattern_offset.0123abcd.npy", "desk_3.yaml"),
        ("desk_4.yml", "desk_3.yaml"),
        ("desk_3.yml", "desk_5.yaml"),
    ):
        (inside / taken).write_text("x")
        assert folders.new("desk", place="save_as") == inside / free
    assert folders.new("desk.yml", place="save_as") == inside / "desk_5.yml"
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "home"))
    assert Folders("").target("a.yml", place="save_as") == tmp_path / "home" / "rim_camera" / "a.yml"


def test_rate_latency_and_jitter() -> None:
    flow = Flow()
    for i in range(100):
        flow.add(10.0 + i * 0.04, stamp=i * 40_000_000, latency=0.005 + (i == 99) * 0.1, processing=0.002)
    assert flow.rate(10.0 + 99 * 0.04) == pytest.approx(25.0)
    values = flow.values(13.96)
    assert float(values["latency_median_ms"]) == pytest.approx(5.0)
    assert float(values["processing_p99_ms"]) == pytest.approx(2.0)
    assert float(values["jitter_ms"]) == pytest.approx(0.0, abs=1e-6)
    assert values["stamp_jumps"] == "0"
    assert flow.rate(15.9) < 20.0  # it stopped two seconds ago
    assert flow.rate(30.0) == 0.0
    flow.add(31.0, stamp=0, latency=1e9, processing=0.0)
    assert flow.jumps == 1


def test_a_flood_of_readings_from_the_future_does_not_push_the_true_one_out() -> None:
    second = 10**9
    pairs = StampPairing(lambda role: role in ("ambient", "frame_info"))
    pixels = np.ones((2, 3), np.uint16)

    def exposure(stamp: int, ambient: float | None) -> list[RawFrame]:
        parts: list[tuple[str, object]] = [("frame_info", (Settings(integration_time=9.0), "x"))]
        parts += [("amplitude", pixels), ("distance", pixels)]
        if ambient is not None:
            parts.insert(0, ("ambient", ambient))
        frames = [frame for role, value in parts for frame in pairs.add(role, stamp, value, 0.0)]
        return frames + pairs.overdue(1.0)

    (frame,) = exposure(100 * second, 21.5)
    assert frame.settings.ambient_temperature == 21.5
    for i in range(100_000):
        assert pairs.add("ambient", 10_000 * second + i, -300.0, 0.0) == []
    (frame,) = exposure(101 * second, None)
    assert frame.settings.ambient_temperature == 21.5
    assert pairs.dropped["ambient far ahead of the images"] == 100_000
    # a clock that is set forward: the last value holds for one frame, then the new ones do
    (frame,) = exposure(4000 * second, 30.0)
    assert frame.settings.ambient_temperature == 21.5
    (frame,) = exposure(4001 * second, 30.5)
    assert frame.settings.ambient_temperature == 30.5


def test_refused_messages_do_not_push_waiting_frames_out() -> None:
    pairs = StampPairing(lambda role: False)
    pixels = np.ones((2, 3), np.uint16)
    assert pairs.add("amplitude", 5, pixels, 0.0) == []
    for i in range(1000):
        pairs.refuse(1000 + i, "distance refused")
        assert pairs.add("amplitude", 1000 + i, pixels, 0.0) == []  # the partner of a refused one
    (frame,) = pairs.add("distance", 5, pixels, 0.0)
    assert frame.stamp == 5
    assert pairs.dropped == {"distance refused": 1000}


def test_findings_and_tally() -> None:
    finding = Finding()
    finding.note("25 frames per second")
    assert (finding.level, finding.message) == (Level.OK, "25 frames per second")
    finding.worse(Level.WARN, "warm")
    finding.worse(Level.ERROR, "dead")
    assert (finding.level, finding.message) == (Level.ERROR, "dead")
    tally = Tally()
    assert tally.recent({"a": 3}, 0.0)["a"] == 0
    assert tally.recent({"a": 5, "b": 1}, 1.0) == {"a": 2, "b": 1}
    for second in range(2, 8):
        grown = tally.recent({"a": 5, "b": 1}, float(second))
    assert grown.total() == 0
