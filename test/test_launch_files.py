"""The launch files, run against stand-ins: `launch` and `launch_ros` exist only where ROS came from apt."""

import py_compile
import runpy
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

LAUNCH = Path(__file__).resolve().parents[1] / "launch"


class LaunchDescription:
    def __init__(self, entities: list[Any]) -> None:
        self.entities = entities


class LaunchContext:
    def __init__(self, values: dict[str, str]) -> None:
        self.values = values


class DeclareLaunchArgument:
    def __init__(
        self, name: str, *, default_value: str, description: str, choices: list[str] | None = None
    ) -> None:
        assert choices is None or default_value in choices
        assert description
        self.name, self.default_value, self.choices = name, default_value, choices


class OpaqueFunction:
    def __init__(self, *, function: Any) -> None:
        self.function = function


class LaunchConfiguration:
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: LaunchContext) -> str:
        return context.values[self.name]


@dataclass
class Node:
    package: str
    executable: str
    namespace: str
    parameters: list[Any] = field(default_factory=list)
    output: str = "log"


@dataclass(frozen=True)
class ParameterValue:
    value: str
    value_type: type


@pytest.fixture
def launch_stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    contents: dict[str, list[type]] = {
        "launch": [LaunchContext, LaunchDescription],
        "launch.actions": [DeclareLaunchArgument, OpaqueFunction],
        "launch.substitutions": [LaunchConfiguration],
        "launch_ros": [],
        "launch_ros.actions": [Node],
        "launch_ros.parameter_descriptions": [ParameterValue],
    }
    for name, classes in contents.items():
        module = ModuleType(name)
        for cls in classes:
            setattr(module, cls.__name__, cls)
        monkeypatch.setitem(sys.modules, name, module)


def launched(**arguments: str) -> dict[str, Node]:
    """The nodes that camera.launch.py starts, by executable."""
    description = runpy.run_path(str(LAUNCH / "camera.launch.py"))["generate_launch_description"]()
    declared = {e.name: e for e in description.entities if isinstance(e, DeclareLaunchArgument)}
    assert set(arguments) <= set(declared)
    context = LaunchContext({name: e.default_value for name, e in declared.items()} | arguments)
    nodes = [
        node
        for entity in description.entities
        if isinstance(entity, OpaqueFunction)
        for node in entity.function(context)
    ]
    assert all(isinstance(node, Node) for node in nodes)
    return {node.executable: node for node in nodes}


@pytest.mark.parametrize("path", sorted(LAUNCH.glob("*.launch.py")), ids=lambda path: path.name)
def test_compiles(path: Path, tmp_path: Path) -> None:
    py_compile.compile(str(path), cfile=str(tmp_path / "compiled.pyc"), doraise=True)


@pytest.mark.usefixtures("launch_stand_ins")
def test_without_arguments_the_nodes_keep_their_own_defaults() -> None:
    nodes = launched()
    assert set(nodes) == {"driver_node", "correction_node"}
    for node in nodes.values():
        assert node.package == "rim_camera_ros"
        assert node.namespace == "camera"
        assert node.parameters == []


@pytest.mark.usefixtures("launch_stand_ins")
def test_arguments_become_parameters_of_the_right_node() -> None:
    nodes = launched(
        namespace="front",
        source="playback",
        scene="room.yaml",
        recording="2024",
        driver_parameters="driver.yaml",
        camera="true.yaml",
        correction_camera="calibrated.yaml",
        frame_id="front_optical",
    )
    assert {node.namespace for node in nodes.values()} == {"front"}
    file, driver = nodes["driver_node"].parameters
    assert file == "driver.yaml"  # before the arguments, which override it
    assert driver == {
        "source": ParameterValue("playback", str),
        "scene": ParameterValue("room.yaml", str),
        "recording": ParameterValue("2024", str),
        "camera": ParameterValue("true.yaml", str),
        "frame_id": ParameterValue("front_optical", str),
    }
    assert nodes["correction_node"].parameters == [{"camera": ParameterValue("calibrated.yaml", str)}]
