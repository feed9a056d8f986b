"""Playback as a robot needs it: pause, rate, loop, simulated time, stamps that jump."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2

from test.helpers_bags import STEP, exposure, flat, pair, stamp_at, write_bag
from test.ros.harness import BEST_EFFORT, LOSSLESS_CORRECTION, LOSSLESS_DRIVER, World, stamp_of

SIZE = (144, 176)


def recording(folder: Path, frames: int = 40) -> str:
    return str(write_bag(folder / "day", flat(exposure(i, SIZE) for i in range(frames))))


def test_pause_rate_and_loop_while_running(world: World, tmp_path: Path) -> None:
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    world.start("driver_node", source="playback", recording=recording(tmp_path), stamps="recorded")
    assert world.until(lambda: len(images) > 5), world.output()
    assert world.set("driver", pause=True) == ""
    world.until(lambda: False, 0.3)
    count = len(images)
    assert not world.until(lambda: len(images) > count, 0.5)
    assert world.set("driver", pause=False) == ""
    assert world.until(lambda: len(images) > count), world.output()
    # nothing was skipped: it goes on with the next frame
    assert stamp_of(images.messages[count]) - stamp_of(images.messages[count - 1]) == STEP
    before = len(images)
    assert world.set("driver", playback_rate=4.0) == ""
    assert world.until(lambda: len(images) > before + 60), world.output()
    stamps = np.array([stamp_of(one) for one in images])
    # over the end of the recording and on: recorded stamps go on increasing
    assert (np.diff(stamps) > 0).all()
    assert stamps[-1] > stamp_at(39)


def test_simulated_time_follows_the_recording_and_stands_with_it(world: World, tmp_path: Path) -> None:
    clock = world.collect(Clock, "/clock", BEST_EFFORT)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    world.start("correction_node", use_sim_time=True)
    said = world.diagnostics()
    world.start(
        "driver_node",
        use_sim_time=True,
        source="playback",
        recording=recording(tmp_path),
        stamps="recorded",
        publish_clock=True,
    )

    def times() -> list[int]:
        return [one.clock.sec * 10**9 + one.clock.nanosec for one in clock]

    # topics are found one by one: of the clock's first message on
    assert world.until(lambda: clock and sum(stamp_of(one) > times()[0] for one in points) > 10), (
        world.output()
    )
    clock_times = times()
    assert set(clock_times) >= {
        stamp_of(one) for one in points if clock_times[0] <= stamp_of(one) < clock_times[-1]
    }
    assert world.set("driver", pause=True) == ""
    # with the clock standing still diagnostics go on, and say so
    name = "/camera/driver: frames"
    assert world.until(lambda: said.message(name) == "playback stands still"), said.message(name)
    assert world.until(lambda: "no frame for" in said.message("/camera/correction: frames"))
    assert world.set("driver", pause=False) == ""
    count = len(points)
    assert world.until(lambda: len(points) > count + 5), world.output()
    assert world.until(lambda: said.level("/camera/correction: frames") == 0), said.message(name)
    stamps = [one.header.stamp.sec for one in said._collected.messages]
    assert abs(stamps[-1] - stamp_at(0) // 10**9) < 120  # in the recording's time


def test_stamps_that_jump_in_a_recording(world: World, tmp_path: Path) -> None:
    hour = 90_000  # frames of 40 ms
    order = [*range(10), *range(hour, hour + 10), *range(20, 30)]
    lines = []
    for received, index in enumerate(order):
        for line in pair(index, size=SIZE):
            line.time = stamp_at(received)
            lines.append(line)
    bag = write_bag(tmp_path / "jumps", lines)
    points = world.collect(PointCloud2, "points")
    world.start("correction_node", **LOSSLESS_CORRECTION)
    assert world.until(lambda: points.matched), world.output()
    driver = world.start(
        "driver_node",
        source="playback",
        recording=str(bag),
        frame_rate=25.0,  # constant: a step of an hour is not waited for
        loop=False,
        stamps="recorded",
        wait_for_subscribers=1,
        **LOSSLESS_DRIVER,
    )
    assert world.until(lambda: "is at its end, 30 frames published" in driver.text), world.output()
    assert world.until(lambda: len(points) == 30), world.output()
    assert [stamp_of(one) for one in points] == [stamp_at(index) for index in order]
