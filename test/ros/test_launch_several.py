"""Several cameras side by side: the launch file's nodes, and two real chains in one domain; QoS overrides."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import PointCloud2

from test.ros.harness import BEST_EFFORT, RELIABLE, World
from test.test_launch_files import (
    LAUNCH,
    LaunchContext,
    Node,
    OpaqueFunction,
    ParameterValue,
    launch_stand_ins,  # noqa: F401 -- a fixture
)
from test.test_launch_files import launched as launched_one


def launched(**arguments: str) -> list[Node]:
    description = runpy.run_path(str(LAUNCH / "cameras.launch.py"))["generate_launch_description"]()
    declared = {one.name: one.default_value for one in description.entities if hasattr(one, "default_value")}
    assert set(arguments) <= set(declared)
    context = LaunchContext(declared | arguments)
    (start,) = [one for one in description.entities if isinstance(one, OpaqueFunction)]
    return list(start.function(context))


@pytest.mark.usefixtures("launch_stand_ins")
def test_each_camera_has_its_namespace_frame_and_file(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / f"{name}.yaml").write_text("/**: {ros__parameters: {}}\n")
    nodes = launched(cameras="left, right", parameters=str(tmp_path), source="sr3000")
    assert [(one.namespace, one.executable) for one in nodes] == [
        ("left", "driver_node"),
        ("left", "correction_node"),
        ("right", "driver_node"),
        ("right", "correction_node"),
    ]
    frame: Any = {
        "frame_id": ParameterValue("right_optical_frame", str),
        "source": ParameterValue("sr3000", str),
    }
    assert nodes[2].parameters == [frame, str(tmp_path / "right.yaml")]
    assert nodes[3].parameters == [str(tmp_path / "right.yaml")]


@pytest.mark.usefixtures("launch_stand_ins")
@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"cameras": "left,left"}, "'left' is no namespace, or is given twice"),
        ({"cameras": "left;rm"}, "'left;rm' is no namespace"),
        ({"cameras": "left", "parameters": "/nowhere"}, "/nowhere/left.yaml: no such file"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, str], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        launched(**arguments)


@pytest.mark.usefixtures("launch_stand_ins")
def test_one_camera_with_the_nodes_that_follow_people_and_calibrate() -> None:
    nodes = launched_one(
        namespace="front",
        correction_camera="mine.yaml",
        people="true",
        people_parameters="people.yaml",
        calibration="true",
        calibration_parameters="calibration.yaml",
        calibration_scene="board_by_hand_experiment",
    )
    assert set(nodes) == {"driver_node", "correction_node", "people_node", "calibration_node"}
    assert {node.namespace for node in nodes.values()} == {"front"}
    assert nodes["people_node"].parameters == ["people.yaml"]
    given = {
        "camera": ParameterValue("mine.yaml", str),
        "scene": ParameterValue("board_by_hand_experiment", str),
    }
    assert nodes["calibration_node"].parameters == ["calibration.yaml", given]


def test_two_chains_side_by_side(world: World) -> None:
    clouds = {}
    for name, scene in (("left", "wall"), ("right", "corner")):
        world.start(
            "driver_node",
            "-r",
            f"__ns:=/{name}",
            scene=scene,
            frame_id=f"{name}_optical_frame",
            frame_rate=10,
        )
        world.start("correction_node", "-r", f"__ns:=/{name}")
        clouds[name] = world.collect(PointCloud2, f"/{name}/points", BEST_EFFORT)
    said = world.diagnostics()
    assert world.until(lambda: all(len(one) > 5 for one in clouds.values())), world.output()
    assert {one.header.frame_id for one in clouds["left"]} == {"left_optical_frame"}
    assert {one.header.frame_id for one in clouds["right"]} == {"right_optical_frame"}
    assert clouds["left"].last.data != clouds["right"].last.data
    names = [f"/{one}/{node}: frames" for one in clouds for node in ("driver", "correction")]
    assert world.until(lambda: all(said.level(one) >= 0 for one in names))


def test_a_publisher_is_overridden_the_ros_way(world: World) -> None:
    world.start("driver_node", scene="wall")
    overrides = {"qos_overrides./camera/points.publisher.reliability": "reliable"}
    correction = world.start("correction_node", **overrides)
    points = world.collect(PointCloud2, "points", RELIABLE)
    assert world.until(lambda: len(points) > 2), world.output()
    assert "receives nothing" not in correction.text
