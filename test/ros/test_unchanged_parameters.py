"""A parameter that is set to the value it has does nothing: ``ros2 param load`` of a dump, say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from rim_camera_ros.devices.source import Source
from rim_camera_ros.nodes.calibration import node as calibration_node
from rim_camera_ros.nodes.calibration.node import CalibrationNode
from rim_camera_ros.nodes.correction import node as correction_node
from rim_camera_ros.nodes.correction.node import CorrectionNode
from rim_camera_ros.nodes.driver.node import DriverNode
from rim_camera_ros.nodes.people.node import PeopleNode
from rim_camera_ros.tracking.people import PeopleTracker
from test.ros.harness import BEST_EFFORT, World, next_domain

#: Nodes with what they call to act on parameters, and a value that is another than the default.
NODES = [
    (DriverNode, Source, "open", {"seed": 3}),
    (CorrectionNode, correction_node, "correction_of", {"effects.scattering": False}),
    (PeopleNode, PeopleTracker, "use", {"mount.z": 1.7}),
    (CalibrationNode, calibration_node.parameters, "check", {"niceness": 3}),
]


@pytest.fixture
def context(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    rclpy.init(domain_id=next_domain())
    yield
    rclpy.shutdown()


def counted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, calls: Counter[str]) -> None:
    """Count the calls of a function."""
    function: Callable[..., Any] = getattr(owner, name)

    def counting(*arguments: Any, **options: Any) -> Any:
        calls[name] += 1
        return function(*arguments, **options)

    monkeypatch.setattr(owner, name, counting)


def dump(node: Any) -> list[Parameter]:
    """Return all parameters that can be set, as a dump of the node holds them."""
    listed = node.list_parameters([], 0).names
    return [node.get_parameter(name) for name in listed if not node.describe_parameter(name).read_only]


@pytest.mark.parametrize(
    ("kind", "owner", "function", "change"), NODES, ids=["driver", "correction", "people", "calibration"]
)
@pytest.mark.usefixtures("context")
def test_only_values_that_change_act(
    monkeypatch: pytest.MonkeyPatch, kind: Any, owner: Any, function: str, change: dict[str, Any]
) -> None:
    calls: Counter[str] = Counter()
    made = kind()
    try:
        counted(monkeypatch, owner, function, calls)
        everything = dump(made.node)
        assert len(everything) > 5
        # one after the other, as the service does it for `ros2 param load`, and all at once
        assert all(one.successful for one in made.node.set_parameters(everything))
        assert made.node.set_parameters_atomically(everything).successful
        assert calls[function] == 0
        changed = [Parameter(name, value=value) for name, value in change.items()]
        for _ in range(2):
            assert made.node.set_parameters_atomically(changed).successful
            assert calls[function] == 1
        assert made.node.set_parameters_atomically(dump(made.node)).successful
        assert calls[function] == 1
    finally:
        made.close()
        made.node.destroy_node()


@pytest.mark.usefixtures("context")
def test_a_camera_file_is_read_anew_by_its_service_only(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: Counter[str] = Counter()
    correction = CorrectionNode()
    try:
        counted(monkeypatch, correction_node, "load_camera", calls)
        camera = Parameter("camera", value="sr3000")
        assert correction.node.set_parameters_atomically([camera]).successful
        assert not calls
        answer = correction._load_camera(Trigger.Request(), Trigger.Response())
        assert (answer.success, answer.message) == (True, "now correcting with sr3000")
        assert calls["load_camera"] == 2  # which effects it has, and the file itself
        assert correction.node.set_parameters_atomically([camera]).successful
        assert calls["load_camera"] == 2
    finally:
        correction.close()
        correction.node.destroy_node()


def test_the_simulated_camera_goes_on_when_a_dump_is_loaded(world: World) -> None:
    infos = world.collect(DiagnosticArray, "frame_info", BEST_EFFORT)
    driver = world.start("driver_node", scene="wall", frame_rate=20.0)
    assert world.until(lambda: len(infos) > 3), world.output()
    described = world.describe("driver")
    names = [name for name, one in described.items() if not one.read_only and "qos" not in name]
    values = dict(zip(names, world.get("driver", *names), strict=True))
    assert {"source", "camera", "scene", "seed", "loop"} <= set(values)
    for name, value in values.items():
        assert world.set("driver", **{name: value}) == "", name
    count = len(infos)
    assert world.until(lambda: len(infos) > count + 3), world.output()
    uptimes = [float({one.key: one.value for one in m.status[0].values}["uptime"]) for m in infos]
    assert uptimes == sorted(uptimes)  # a source that is opened anew begins at its first uptime
    assert "now publishing" not in driver.text
