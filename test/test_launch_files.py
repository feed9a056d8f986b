"""The launch files, run against stand-ins: `launch` and `launch_ros` exist only where ROS came from apt."""

import logging
import py_compile
import runpy
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from rim_camera_ros.errors import InputError
from rim_camera_ros.launch_files import SHARED
from rim_camera_ros.launch_parameters import for_node

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
        self.description = description


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
    parameters: list[str] = field(default_factory=list)
    output: str = "log"
    ros_arguments: list[str] = field(default_factory=list)
    arguments: list[str] = field(default_factory=list)
    remappings: list[tuple[str, str]] = field(default_factory=list)
    respawn: bool = False
    respawn_delay: float | None = None

    def given(self) -> dict[str, Any]:
        """The parameters by the name of the node that heeds them, later ones over earlier ones."""
        found: dict[str, Any] = {}
        for file in self.parameters:
            for node, values in read(file).items():
                found.setdefault(node, {}).update(values["ros__parameters"])
        return found


def read(path: str) -> Any:
    return yaml.safe_load(Path(path).read_text())


@pytest.fixture
def launch_stand_ins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The log folder of launches that use the stand-ins."""
    folder = tmp_path / "log_of_launch"
    folder.mkdir()
    put_stand_ins(monkeypatch, folder)
    return folder


def put_stand_ins(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let launch files import the classes of this module; ``folder``: that of launch's logs."""
    contents: dict[str, list[type]] = {
        "launch": [LaunchContext, LaunchDescription],
        "launch.actions": [DeclareLaunchArgument, OpaqueFunction],
        "launch.substitutions": [LaunchConfiguration],
        "launch_ros": [],
        "launch_ros.actions": [Node],
    }
    for name, classes in contents.items():
        module = ModuleType(name)
        for cls in classes:
            setattr(module, cls.__name__, cls)
        monkeypatch.setitem(sys.modules, name, module)
    logs = ModuleType("launch.logging")
    logs.launch_config = SimpleNamespace(log_dir=str(folder))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, logs.__name__, logs)


def described(file: str) -> LaunchDescription:
    """What a launch file describes."""
    description = runpy.run_path(str(LAUNCH / file))["generate_launch_description"]()
    assert isinstance(description, LaunchDescription)
    return description


def declared_in(description: LaunchDescription) -> dict[str, DeclareLaunchArgument]:
    """The arguments of a launch file by name."""
    found = [entity for entity in description.entities if isinstance(entity, DeclareLaunchArgument)]
    assert len({argument.name for argument in found}) == len(found)
    return {argument.name: argument for argument in found}


def nodes_of(file: str, **arguments: str) -> list[Node]:
    """The nodes that a launch file starts."""
    description = described(file)
    declared = declared_in(description)
    assert set(arguments) <= set(declared)
    for name, value in arguments.items():
        choices = declared[name].choices
        assert choices is None or value in choices, name
    context = LaunchContext({name: e.default_value for name, e in declared.items()} | arguments)
    nodes = [
        node
        for entity in description.entities
        if isinstance(entity, OpaqueFunction)
        for node in entity.function(context)
    ]
    assert all(isinstance(node, Node) for node in nodes)
    return nodes


def launched(**arguments: str) -> dict[str, Node]:
    """The nodes that camera.launch.py starts, by executable."""
    return {node.executable: node for node in nodes_of("camera.launch.py", **arguments)}


@pytest.mark.parametrize("path", sorted(LAUNCH.glob("*.launch.py")), ids=lambda path: path.name)
def test_compiles(path: Path, tmp_path: Path) -> None:
    py_compile.compile(str(path), cfile=str(tmp_path / "compiled.pyc"), doraise=True)


@pytest.mark.usefixtures("launch_stand_ins")
def test_arguments_that_the_launch_files_share_are_the_same_in_both() -> None:
    several, single = (declared_in(described(file)) for file in ("cameras.launch.py", "camera.launch.py"))
    shared = {"source", "preset", "people", "separate", "respawn", "log_level"}
    assert {argument.name for argument in SHARED} == several.keys() & single.keys() == shared
    assert several.keys() - shared == {"cameras", "parameters"}
    for name in shared:
        assert vars(several[name]) == vars(single[name]), name
    for name in ("people", "separate", "respawn"):
        assert {"true", "True", "false", "False"} == set(several[name].choices or ())


@pytest.mark.usefixtures("launch_stand_ins")
def test_without_arguments_one_process_with_the_nodes_own_defaults() -> None:
    nodes = launched()
    assert set(nodes) == {"camera_node"}
    node = nodes["camera_node"]
    assert (node.package, node.namespace, node.respawn) == ("rim_camera_ros", "camera", False)
    assert node.parameters == node.ros_arguments == []


ARGUMENTS = {
    "namespace": "front",
    "source": "playback",
    "scene": "room.yaml",
    "recording": "2024",
    "camera": "true.yaml",
    "correction_camera": "calibrated.yaml",
    "frame_id": "front_optical",
}
DRIVER = {
    "source": "playback",
    "scene": "room.yaml",
    "recording": "2024",  # text, though it looks like a number
    "camera": "true.yaml",
    "frame_id": "front_optical",
}


@pytest.mark.usefixtures("launch_stand_ins")
def test_arguments_become_parameters_of_the_right_node_of_one_process() -> None:
    (node,) = launched(**ARGUMENTS, people="true").values()
    assert node.namespace == "front"
    assert node.given() == {
        "/**/driver": DRIVER,
        "/**/correction": {"camera": "calibrated.yaml", "people": True},
    }


@pytest.mark.usefixtures("launch_stand_ins")
def test_arguments_become_parameters_of_separate_processes() -> None:
    nodes = launched(**ARGUMENTS, people="true", separate="true", respawn="true")
    assert set(nodes) == {"driver_node", "correction_node", "people_node"}
    assert {(one.namespace, one.respawn, one.respawn_delay) for one in nodes.values()} == {
        ("front", True, 2.0)
    }
    assert nodes["driver_node"].given() == {"/**/driver": DRIVER}
    assert nodes["correction_node"].given() == {"/**/correction": {"camera": "calibrated.yaml"}}
    assert nodes["people_node"].given() == {}


@pytest.mark.usefixtures("launch_stand_ins")
def test_arguments_override_the_parameter_file_which_overrides_the_preset(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "/**: {ros__parameters: {scene: wall, integration_time: 33.0}}\n"
        "/front/correction: {ros__parameters: {minimum_amplitude: 70.0}}\n"
    )
    (node,) = launched(preset="fast", driver_parameters=str(file), scene="corner").values()
    given = node.given()
    assert given["/**/driver"] == {"integration_time": 33.0, "frame_rate": 50.0, "scene": "corner"}
    assert given["/front/correction"] == {"minimum_amplitude": 70.0}  # stays as it is
    assert given["/**/correction"]["effects"] == {"scattering": False, "incidence_angle": False}
    assert "/**" not in given


@pytest.mark.usefixtures("launch_stand_ins")
def test_levels_of_the_log_for_all_and_for_some() -> None:
    (node,) = launched(log_level="warn").values()
    assert node.ros_arguments == [
        "--log-level",
        "camera.driver:=warn",
        "--log-level",
        "camera.correction:=warn",
    ]
    (node,) = launched(log_level="correction=debug", namespace="/robot/front").values()
    assert node.ros_arguments == ["--log-level", "robot.front.correction:=debug"]


@pytest.mark.usefixtures("launch_stand_ins")
@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"preset": "quick"}, "preset: no preset 'quick': presets: fast, outdoors, precise"),
        ({"log_level": "loud"}, "log_level: 'loud' is no level: one of: debug, info, warn, error, fatal"),
        ({"log_level": "people=info"}, "log_level: no node 'people': one of: driver, correction"),
        ({"correction_parameters": "/nowhere.yaml"}, "/nowhere.yaml: cannot be read: No such file"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, str], problem: str) -> None:
    with pytest.raises(InputError) as refused:
        launched(**arguments)
    assert problem.split(": ")[0] in str(refused.value)
    assert problem.split(": ")[1] in str(refused.value)


@pytest.fixture
def logger_of_launch() -> Iterator[logging.Logger]:
    """The logger by which launch says what ended it, with its own filters alone."""
    logger = logging.getLogger("launch")
    before = list(logger.filters)
    yield logger
    logger.filters[:] = before


@pytest.mark.usefixtures("launch_stand_ins")
@pytest.mark.parametrize("file", ["camera.launch.py", "cameras.launch.py"])
def test_launch_says_a_wrong_argument_in_its_sentence_alone(
    logger_of_launch: logging.Logger, caplog: pytest.LogCaptureFixture, file: str
) -> None:
    sentence = "preset: no preset 'quick' (presets: fast, outdoors, precise)"
    with pytest.raises(InputError, match=r"^preset: no preset 'quick' \(presets: ") as refused:
        nodes_of(file, preset="quick")
    # as launch.launch_service writes it
    before = "Caught exception in launch (see debug for traceback): "
    logger_of_launch.error(f"{before}{refused.value}")
    logger_of_launch.error(f"{before}another error")
    assert [record.msg for record in caplog.records] == [sentence, f"{before}another error"]


@pytest.mark.parametrize("file", ["camera.launch.py", "cameras.launch.py"])
@pytest.mark.parametrize("separate", ["false", "true"])
def test_files_are_written_to_the_log_folder_of_the_launch_alone(
    launch_stand_ins: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, separate: str
) -> None:
    elsewhere = tmp_path / "temporary"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    nodes = nodes_of(file, source="playback", preset="fast", people="true", separate=separate)
    given = {parameter for node in nodes for parameter in node.parameters}
    # launch_ros writes what is no path to a temporary file
    assert all(isinstance(parameter, str) for parameter in given)
    preset = str(LAUNCH.parent / "config" / "presets" / "fast.yaml")
    assert given - {preset} == {str(path) for path in launch_stand_ins.iterdir()}
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("text", ["- 1\n", "a: 1\n", "a: [\n"])
def test_a_file_that_is_no_parameter_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"bad\.yaml.*is no (parameter file|YAML)"):
        for_node("driver", folder=tmp_path, file=str(file))
