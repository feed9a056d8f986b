"""The launch files with real nodes: by ``ros2 launch`` where it is (apt, colcon), else by a minimal runner.

The runner reads the launch file with stand-ins for ``launch`` and ``launch_ros``, which no wheel has, and
starts the nodes that it names with their arguments, namespaces and parameters.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import PointCloud2

from test.ros.harness import BEST_EFFORT, Process, World
from test.test_launch_files import LAUNCH, Node, nodes_of, put_stand_ins


class Launched(Protocol):
    """Nodes that were started by a launch file."""

    @property
    def text(self) -> str: ...

    def send(self, number: signal.Signals) -> None: ...

    def wait(self) -> int: ...


class Several:
    """The processes of the runner, as one."""

    def __init__(self, processes: list[Process]) -> None:
        self._processes = processes

    @property
    def text(self) -> str:
        return "\n".join(one.text for one in self._processes)

    def send(self, number: signal.Signals) -> None:
        for one in self._processes:
            one.send(number)

    def wait(self) -> int:
        return max(one.wait() for one in self._processes)


def installed() -> bool:
    """Whether ``ros2 launch`` finds this package."""
    if shutil.which("ros2") is None or importlib.util.find_spec("launch_ros") is None:
        return False
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        get_package_prefix("rim_camera_ros")
    except PackageNotFoundError:
        return False
    return True


def start(world: World, node: Node) -> Process:
    """Start a node of a launch file."""
    arguments = ["-r", f"__ns:=/{node.namespace.strip('/')}"]
    for file in node.parameters:
        arguments += ["--params-file", file]
    return world.start(node.executable, *arguments, *node.ros_arguments)


@pytest.fixture
def launch(world: World, tmp_path: Path) -> Callable[..., Launched]:
    if installed():
        return lambda file, **arguments: world.launch(LAUNCH / file, **arguments)

    def run(file: str, **arguments: str) -> Launched:
        with pytest.MonkeyPatch.context() as patch:
            put_stand_ins(patch, tmp_path)
            nodes = nodes_of(file, **arguments)
        return Several([start(world, node) for node in nodes])

    return run


@pytest.mark.parametrize("separate", ["false", "true"])
def test_the_line_of_the_readme(world: World, launch: Callable[..., Launched], separate: str) -> None:
    launched = launch("camera.launch.py", scene="room", camera="sr3000", separate=separate)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    said = world.diagnostics()
    assert world.until(lambda: len(points) > 20), launched.text
    assert (points.last.width, points.last.height) == (176, 144)
    assert points.last.header.frame_id == "camera_optical_frame"
    names = ("driver: device", "correction: pixels", "correction: publishers")
    assert world.until(lambda: all(said.level(f"/camera/{one}") == 0 for one in names)), launched.text
    assert launched.text.count("still drifting") == 1
    launched.send(signal.SIGINT)
    assert launched.wait() == 0, launched.text
    assert not re.search(r"Traceback|process has died", launched.text), launched.text


def test_two_cameras(world: World, launch: Callable[..., Launched]) -> None:
    launched = launch("cameras.launch.py", cameras="front,rear")
    clouds = [world.collect(PointCloud2, f"/{one}/points", BEST_EFFORT) for one in ("front", "rear")]
    assert world.until(lambda: all(len(one) > 5 for one in clouds)), launched.text
    assert [one.last.header.frame_id for one in clouds] == ["front_optical_frame", "rear_optical_frame"]
    launched.send(signal.SIGINT)
    assert launched.wait() == 0, launched.text
    assert "Traceback" not in launched.text


@pytest.mark.skipif(not installed(), reason="needs ros2 launch")
@pytest.mark.parametrize("file", ["camera.launch.py", "cameras.launch.py"])
def test_a_wrong_argument_is_one_sentence(world: World, file: str) -> None:
    launched = world.launch(LAUNCH / file, preset="quick")
    assert launched.wait() == 1, launched.text
    (line,) = (line for line in launched.text.splitlines() if "[ERROR]" in line)
    assert re.search(r"\]: preset: no preset 'quick' \(presets: fast, outdoors, precise\)$", line), line
