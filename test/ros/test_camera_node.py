"""Driver, correction and people in one process: the same topics, frames in memory, one start and one end."""

from __future__ import annotations

import re
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from rim_camera_ros.bags.messages import points_array
from rim_camera_ros.nodes.common.handover import Handover
from test.ros.harness import BEST_EFFORT, RELIABLE, World, stamp_of

PRESETS = Path(__file__).resolve().parents[2] / "config" / "presets"
RAW = ("distance/image_raw", "amplitude/image_raw", "frame_info", "camera_info", "temperature")


def offered(world: World, nodes: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return topics and services of each node with their types."""
    return {node: world.published_by(node) | world.served_by(node) for node in nodes}


def test_topics_services_and_parameters_are_those_of_separate_processes(world: World) -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is an optional extra, for the people node")
    nodes = ("driver", "correction", "people")
    world.start("camera_node", scene="wall", people=True)
    world.namespace = "/apart"
    for node in nodes:
        arguments = {"scene": "wall"} if node == "driver" else {}
        world.start(f"{node}_node", "-r", "__ns:=/apart", **arguments)
    said = world.diagnostics()
    for namespace in ("camera", "apart"):
        for check in ("driver: frames", "correction: frames", "people: people"):
            name = f"/{namespace}/{check}"
            assert world.until(lambda name=name: said.of(name)), world.output()

    def services(namespace: str) -> dict[str, dict[str, str]]:
        world.namespace = namespace
        return {
            node: {name.replace(namespace, "", 1): kind for name, kind in found.items()}
            for node, found in offered(world, nodes).items()
        }

    # discovery brings the services of a node one by one
    world.until(lambda: services("/camera") == services("/apart"))
    assert services("/camera") == services("/apart")
    assert len(services("/camera")["correction"]) > 15
    parameters = {}
    for namespace in ("/apart", "/camera"):
        world.namespace = namespace
        world._clients.clear()  # they are kept by the name of the node
        parameters[namespace] = {
            node: {one for one in world.describe(node) if not one.startswith("qos_overrides.")}
            for node in nodes
        }
    only_together = parameters["/camera"]["correction"] - parameters["/apart"]["correction"]
    assert only_together == {"people"}
    parameters["/camera"]["correction"].discard("people")
    assert parameters["/camera"] == parameters["/apart"]


def test_frames_go_in_memory_and_raw_topics_to_who_listens(world: World) -> None:
    process = world.start("camera_node", scene="wall", frame_rate=20)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    assert world.until(lambda: len(points) > 5), process.text
    for topic in RAW:
        name = f"/camera/{topic}"
        assert len(world.node.get_publishers_info_by_topic(name)) == 1
        assert world.node.get_subscriptions_info_by_topic(name) == []
    distance = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert world.until(lambda: len(distance) > 5), process.text
    assert world.until(lambda: stamp_of(points.last) in distance.by_stamp()), process.text
    said = world.diagnostics()
    assert world.until(lambda: said.values("/camera/correction: frames").get("dropped_frames") == "0")


def test_people_are_followed_in_memory(world: World) -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is an optional extra, for the people node")
    process = world.start(
        "camera_node", scene="walking_people", people=True, **{"background.warm_start": 5, "mount.z": 2.2}
    )
    markers = world.collect(MarkerArray, "people/markers", RELIABLE)
    assert world.until(lambda: any(one.markers for one in markers), 60.0), process.text
    for topic in ("points", "sigma/image"):
        assert world.node.get_subscriptions_info_by_topic(f"/camera/{topic}") == []
    assert markers.last.markers[0].header.frame_id == "camera_optical_frame"
    assert "no parameter" not in process.text


def test_each_node_keeps_its_own_life(world: World) -> None:
    process = world.start("camera_node", scene="wall", **{"qos.input": "reliable"})
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    distance = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert world.until(lambda: points and distance), process.text
    assert world.transition("correction", "deactivate")
    distance.messages.clear()
    points.messages.clear()
    assert world.until(lambda: len(distance) > 60), (
        process.text
    )  # more than may wait: nobody holds the driver up
    assert len(points) <= 1  # one may have been on its way
    assert world.transition("correction", "activate")
    points.messages.clear()
    assert world.until(lambda: len(points) > 2), process.text
    assert world.transition("driver", "deactivate")
    assert world.transition("driver", "activate")
    points.messages.clear()
    assert world.until(lambda: len(points) > 2), process.text
    assert world.set("correction", **{"effects.scattering": False}) == ""
    assert world.set("driver", scene="corner") == ""
    points.messages.clear()
    assert world.until(lambda: len(points) > 2), process.text
    process.send(signal.SIGINT)
    process.send(signal.SIGTERM)
    assert process.wait() == 0, process.text
    assert "Traceback" not in process.text


def test_a_driver_that_cannot_start_ends_the_process_with_one_line(world: World) -> None:
    process = world.start("camera_node", scene="wll")
    assert process.wait() == 2
    errors = [one for one in process.text.splitlines() if not re.match(r"\[(INFO|WARN)\]", one)]
    assert len(errors) == 1
    assert errors[0].startswith("camera_node: ")
    assert "wll" in errors[0]


def test_an_unknown_parameter_is_warned_of_and_one_of_another_node_is_not(world: World) -> None:
    process = world.start("camera_node", scene="wall", minimum_amplitude=90.0, sceen="wall")
    said = world.diagnostics()
    assert world.until(lambda: said.of("/camera/driver: frames")), process.text
    unknown = "no parameter 'sceen', it is ignored (did you mean 'scene'?)"
    assert world.until(lambda: unknown in process.text), process.text
    assert process.text.count("no parameter") == process.text.count("no parameter 'sceen'")
    assert world.get("correction", "minimum_amplitude") == [90.0]


@pytest.mark.parametrize("preset", ["fast", "outdoors", "precise"])
def test_presets_load(world: World, preset: str) -> None:
    file = PRESETS / f"{preset}.yaml"
    process = world.start("camera_node", "--params-file", str(file), scene="corner")
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    assert world.until(lambda: len(points) > 2), process.text
    assert "no parameter" not in process.text
    checked = 0
    for name, content in yaml.safe_load(file.read_text()).items():
        node = name.removeprefix("/**/")
        for parameter, value in flat(content["ros__parameters"]).items():
            assert world.get(node, parameter) == [value], parameter
            checked += 1
    assert checked >= 3
    valid = np.isfinite(points_array(points.last)[..., 2]).mean()
    assert valid > 0.5


def flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested parameters by their full names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{before}{name}.") if isinstance(value, dict) else {before + name: value}
    return found


def test_the_newest_value_wins_and_what_is_dropped_is_counted() -> None:
    handover, taken = Handover[int](), list[int]()
    handover.put(1)  # nobody receives
    assert not handover.wanted
    handover.begin(taken.append, keep_all=False)
    assert handover.wanted
    for value in (2, 3, 4, 5):
        handover.put(value)
    assert handover.dropped == 0  # nothing was taken yet: the receiver is still being made
    for _ in range(4):
        handover.take_waiting()
    assert taken == [4, 5]
    for value in (2, 3, 4, 5):
        handover.put(value)
    handover.take_waiting()
    handover.take_waiting()
    assert taken == [4, 5, 4, 5]
    assert handover.dropped == 2
    handover.put(6)
    handover.end()
    handover.take_waiting()
    assert taken == [4, 5, 4, 5]


def test_what_is_dropped_is_counted_where_nothing_is_ever_taken() -> None:
    handover, taken = Handover[int](), list[int]()
    handover.begin(taken.append, keep_all=False, surplus=len)  # all are too old as they come
    handover.put(1)
    assert handover.dropped == 0
    handover.take_waiting()  # the receiver is there
    for value in (2, 3, 4):
        handover.put(value)
        handover.take_waiting()
    assert (taken, handover.dropped) == ([], 3)


def test_with_all_kept_the_giver_waits_for_room_or_until_it_is_stopped() -> None:
    handover, taken, stop = Handover[int](), list[int](), threading.Event()
    handover.begin(taken.append, keep_all=True)

    def give() -> None:
        for value in range(200):
            handover.put(value, stopped=stop.is_set)

    giver = threading.Thread(target=give)
    giver.start()
    while len(taken) < 120:
        handover.take_waiting()
    stop.set()
    giver.join(10.0)
    assert not giver.is_alive()
    for _ in range(60):
        handover.take_waiting()
    assert taken == list(range(len(taken)))
    assert 120 <= len(taken) <= 200
    assert handover.dropped == 0


def test_a_value_is_not_taken_in_the_midst_of_another() -> None:
    handover, taken = Handover[int](), list[int]()

    def take(value: int) -> None:
        handover.take_waiting()
        taken.append(value)

    handover.begin(take, keep_all=False)
    handover.put(1)
    handover.put(2)
    handover.take_waiting()
    assert taken == [1]
    handover.take_waiting()
    assert taken == [1, 2]


def test_the_giver_can_wait_until_all_is_taken() -> None:
    handover = Handover[int]()
    begun, may_end = threading.Event(), threading.Event()

    def take(value: int) -> Any:
        begun.set()
        may_end.wait(10.0)

    handover.begin(take, keep_all=False)
    handover.put(1)
    receiver = threading.Thread(target=handover.take_waiting)
    receiver.start()
    assert begun.wait(10.0)
    done = threading.Event()
    giver = threading.Thread(target=lambda: (handover.wait_until_taken(10.0), done.set()))
    giver.start()
    assert not done.is_set()
    may_end.set()
    giver.join(10.0)
    receiver.join(10.0)
    assert done.is_set()
