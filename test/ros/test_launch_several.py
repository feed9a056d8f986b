"""Several cameras side by side: the launch file's nodes, and two real chains in one domain; QoS overrides."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from rim_camera_ros.errors import InputError
from test.ros.harness import BEST_EFFORT, LATCHED, RELIABLE, World
from test.test_launch_files import launch_stand_ins, launched, nodes_of  # noqa: F401 -- one is a fixture


@pytest.mark.usefixtures("launch_stand_ins")
def test_each_camera_has_its_namespace_frame_and_file(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / f"{name}.yaml").write_text("/**: {ros__parameters: {serial_number: 7}}\n")
    arguments = {"cameras": "left, right", "parameters": str(tmp_path), "source": "sr3000"}
    nodes = nodes_of("cameras.launch.py", **arguments)
    assert [(one.namespace, one.executable) for one in nodes] == [
        ("left", "camera_node"),
        ("right", "camera_node"),
    ]
    assert nodes[1].given() == {
        "/**/driver": {"frame_id": "right_optical_frame", "source": "sr3000"},
        "/**": {"serial_number": 7},
    }
    nodes = nodes_of("cameras.launch.py", **arguments, separate="True")
    assert [(one.namespace, one.executable) for one in nodes] == [
        ("left", "driver_node"),
        ("left", "correction_node"),
        ("right", "driver_node"),
        ("right", "correction_node"),
    ]
    assert nodes[3].given()["/**"] == {"serial_number": 7}


@pytest.mark.usefixtures("launch_stand_ins")
def test_shared_arguments_hold_for_every_camera(tmp_path: Path) -> None:
    (tmp_path / "left.yaml").write_text("/**/driver: {ros__parameters: {frame_rate: 15.0}}\n")
    (tmp_path / "right.yaml").write_text("/**/people: {ros__parameters: {trail: 3}}\n")
    arguments = {"cameras": "left,right", "parameters": str(tmp_path), "preset": "fast"}
    arguments |= {"people": "true", "respawn": "True", "log_level": "correction=debug,people=warn"}
    left, right = nodes_of("cameras.launch.py", **arguments)
    for name, node in {"left": left, "right": right}.items():
        assert (node.executable, node.respawn, node.respawn_delay) == ("camera_node", True, 2.0)
        assert node.ros_arguments[1::2] == [f"{name}.correction:=debug", f"{name}.people:=warn"]
        assert node.given()["/**/correction"] == {
            "effects": {"scattering": False, "incidence_angle": False},
            "people": True,
        }
    # the file of a camera overrides the preset
    rates = [node.given()["/**/driver"]["frame_rate"] for node in (left, right)]
    assert rates == [15.0, 50.0]
    assert right.given()["/**/people"] == {"trail": 3}
    separate = nodes_of("cameras.launch.py", **arguments, separate="true")
    executables = [node.executable for node in separate]
    assert executables == ["driver_node", "correction_node", "people_node"] * 2
    assert all(node.respawn for node in separate)


@pytest.mark.usefixtures("launch_stand_ins")
@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"cameras": "left,left"}, "'left' is no namespace, or is given twice"),
        ({"cameras": "left;rm"}, "'left;rm' is no namespace"),
        ({"cameras": "left", "parameters": "/nowhere"}, "/nowhere/left.yaml: parameters: no such file"),
        ({"preset": "quick"}, "preset: no preset 'quick'"),
        ({"log_level": "people=info"}, "log_level: no node 'people'"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, str], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        nodes_of("cameras.launch.py", **arguments)


@pytest.mark.usefixtures("launch_stand_ins")
def test_one_camera_with_the_nodes_that_follow_people_and_calibrate(tmp_path: Path) -> None:
    files = {}
    for name in ("people", "calibration"):
        files[name] = tmp_path / f"{name}.yaml"
        files[name].write_text(
            f"/**: {{ros__parameters: {{{'trail' if name == 'people' else 'niceness'}: 3}}}}\n"
        )
    nodes = launched(
        namespace="front",
        correction_camera="mine.yaml",
        people="true",
        people_parameters=str(files["people"]),
        calibration="true",
        calibration_parameters=str(files["calibration"]),
        calibration_scene="board_by_hand_experiment",
    )
    assert set(nodes) == {"camera_node", "calibration_node"}
    assert {node.namespace for node in nodes.values()} == {"front"}
    assert nodes["camera_node"].given()["/**/people"] == {"trail": 3}
    assert nodes["calibration_node"].given() == {
        "/**/calibration": {"niceness": 3, "camera": "mine.yaml", "scene": "board_by_hand_experiment"}
    }


def test_two_chains_side_by_side(world: World) -> None:
    clouds, poses = {}, {}
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
        surface = "wall" if scene == "wall" else "floor"
        poses[name] = world.collect(PoseStamped, f"/{name}/ground_truth/{surface}/pose", LATCHED)
    said = world.diagnostics()
    assert world.until(lambda: all(len(one) > 5 for one in clouds.values())), world.output()
    assert {one.header.frame_id for one in clouds["left"]} == {"left_optical_frame"}
    assert {one.header.frame_id for one in clouds["right"]} == {"right_optical_frame"}
    assert world.until(lambda: all(poses.values())), world.output()
    assert {one.header.frame_id for one in poses["right"]} == {"right_optical_frame"}
    # no pose of one camera reaches a listener of the other's
    assert not [
        name for name, _ in world.node.get_topic_names_and_types() if name.startswith("/ground_truth")
    ]
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
