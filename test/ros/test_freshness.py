"""Where the correction is too slow for all frames the newest wins; what is dropped is counted and said."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from rim_camera_ros.bags.topics import ROLES
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.nodes.common import messages
from rim_camera_ros.nodes.common.handover import Handover
from rim_camera_ros.nodes.common.run import Throttle
from rim_camera_ros.nodes.correction.freshness import Freshness
from rim_camera_ros.nodes.correction.input import MessageInput, Receiver
from test.ros.harness import BEST_EFFORT, RELIABLE, World, stamp_of

MILLISECOND = 10**6


@dataclass(frozen=True)
class Frame:
    stamp: int


def frames(*milliseconds: int) -> list[Frame]:
    return [Frame(one * MILLISECOND) for one in milliseconds]


def taken_of(*given: int, maximum_age: float = 0.0, queue_depth: int = 5, now: int = 0) -> list[int]:
    """Return the stamps [ms] that are taken of frames that all came before the first was taken."""
    values = {"maximum_age": maximum_age, "queue_depth": queue_depth}
    handover, taken = Handover[Any](), list[int]()
    fresh = Freshness(values, lambda: now * MILLISECOND)
    handover.begin(lambda one: taken.append(one.stamp // MILLISECOND), keep_all=False, surplus=fresh.surplus)
    handover.put(Frame((given[0] - 3_600_000) * MILLISECOND))
    handover.take_waiting()  # drops count from the first that is taken on
    taken.clear()
    for frame in frames(*given):
        handover.put(frame)
    for _ in given:
        handover.take_waiting()
    assert handover.dropped == len(given) - len(taken)
    return taken


@pytest.mark.parametrize(
    ("given", "settings", "expected"),
    [
        ((1000, 1040, 1080, 1120), {}, [1000, 1040, 1080, 1120]),  # three periods behind: none is too old
        ((1000, 1040, 1080, 1120, 1160), {}, [1160]),  # four: the correction catches up
        ((1000, 1040, 1080, 1120, 1160, 1200, 1240), {}, [1160, 1200, 1240]),
        ((1000, 1010, 1020, 1030), {"queue_depth": 3}, [1030]),
        ((1000, 1040, 1080), {"maximum_age": 0.05}, [1080]),
        ((1000, 1040), {"maximum_age": 0.05, "now": 1085}, [1040]),
        ((1000, 1040), {"maximum_age": 0.05, "now": 1091}, []),  # the newest is too old, too
        ((1000, 1040), {"now": 1900}, [1000, 1040]),  # clocks of computers may differ
        ((1000, 1040), {"maximum_age": 0.05, "now": 86_400_000}, [1000, 1040]),  # a recording's own stamps
        ((5_000_000, 1000, 1040), {}, [5_000_000, 1000, 1040]),  # a clock that was set
        ((7,), {}, [7]),
    ],
)
def test_what_is_taken_of_frames_that_wait(
    given: tuple[int, ...], settings: dict[str, Any], expected: list[int]
) -> None:
    assert taken_of(*given, **settings) == expected


@pytest.mark.parametrize(
    ("maximum_age", "now", "expected"),
    [
        (0.05, 1051, True),
        (0.05, 1049, False),
        (0.0, 1900, False),  # what the clock says does not matter unless a limit is set
        (0.05, 86_400_000, False),  # a recording's own stamps
    ],
)
def test_a_stamp_is_held_against_the_clock(maximum_age: float, now: int, expected: bool) -> None:
    fresh = Freshness({"maximum_age": maximum_age, "queue_depth": 5}, lambda: now * MILLISECOND)
    assert fresh.expired(1000 * MILLISECOND) is expected


@pytest.mark.parametrize("maximum_age", [0.0005, 1e-6])  # to correct, or to hand over, takes longer
def test_nothing_older_than_the_limit_leaves_the_node(world: World, maximum_age: float) -> None:
    process = world.start("camera_node", scene="wall", frame_rate=25.0, maximum_age=maximum_age)
    points, said = world.collect(PointCloud2, "points", BEST_EFFORT), world.diagnostics()
    name = "/camera/correction: frames"
    assert world.until(lambda: int(said.values(name).get("dropped_frames", 0)) > 20), process.text
    assert not points.messages
    assert world.until(lambda: "maximum_age was over" in process.text), process.text
    assert "is a driver running" not in process.text  # there is one: its frames are too old
    assert world.set("correction", maximum_age=0.0) == ""
    assert world.until(lambda: len(points) > 5), process.text


def test_a_rate_is_learned_from_the_stamps() -> None:
    fresh = Freshness({"maximum_age": 0.0, "queue_depth": 100}, lambda: 0)
    for stamp in range(0, 2000, 200):  # 5 Hz
        assert fresh.surplus(frames(stamp)) == 0
    assert fresh.surplus(frames(1400, 1600, 1800, 2000)) == 0
    assert fresh.surplus(frames(1200, 1600, 1800, 2000)) == 3


def test_of_messages_that_wait_only_the_newest_frame_is_corrected(world: World) -> None:
    """What comes while a frame is corrected waits in the middleware, in the order in which it came."""
    delivered: list[int] = []
    camera = load_camera(find_camera("sr3000"))
    watched, executor = watcher(world)
    roles = {"frame_info": DiagnosticArray, "amplitude": Image, "distance": Image}
    to = {role: world.node.create_publisher(kind, ROLES[role][0], RELIABLE) for role, kind in roles.items()}

    def send(stamp: int) -> None:
        image = messages.image(np.full(camera.shape, 9000, np.uint16), messages.header(stamp, "optical"))
        to["frame_info"].publish(messages.frame_info(Settings(integration_time=100.0), stamp, "", ""))
        to["amplitude"].publish(image)
        to["distance"].publish(image)

    def correct(ready: list[RawFrame], frame_id: str) -> None:
        delivered.extend(one.stamp // MILLISECOND for one in ready)
        if len(delivered) == 1:  # a slow one: thirty frames come meanwhile
            for number in range(1, 31):
                send((1000 + 40 * number) * MILLISECOND)
            end = time.monotonic() + 30.0
            while 2200 not in watched and time.monotonic() < end:
                executor.spin_once(timeout_sec=0.02)

    fresh = Freshness({"maximum_age": 0.0, "queue_depth": 5}, time.time_ns)
    throttle: Any = Throttle(world.node)
    node: Any = world.node
    receiver = Receiver(node, throttle, Counter(), lambda: camera, correct, fresh, samples=lambda: False)
    source = MessageInput(receiver)
    source.begin("sensor_data")
    assert world.until(lambda: all(one.get_subscription_count() >= 1 for one in to.values()))
    assert world.until(lambda: to["distance"].get_subscription_count() == 2)
    send(1000 * MILLISECOND)
    assert world.until(lambda: 2200 in delivered), delivered
    executor.shutdown()
    source.end()
    assert delivered[0] == 1000
    assert delivered[-1] == 2200
    assert len(delivered) <= 5, delivered
    assert source.dropped == {
        "a newer frame was there, or maximum_age was over": 31 - len(delivered),
    }


def watcher(world: World) -> tuple[list[int], SingleThreadedExecutor]:
    """Return the stamps [ms] of the distances that arrive at another node, which the executor spins."""
    context = world.node.context
    node = Node("watcher", context=context)
    watched: list[int] = []
    node.create_subscription(
        Image, ROLES["distance"][0], lambda one: watched.append(stamp_of(one) // MILLISECOND), RELIABLE
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    return watched, executor
