"""The launch file by ``ros2 launch``; only where ROS and this package are installed for it (apt, colcon)."""

from __future__ import annotations

import re
import shutil
import signal

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("launch_ros", reason="launch_ros comes from apt, no wheel has it")

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from sensor_msgs.msg import PointCloud2

from test.ros.harness import BEST_EFFORT, World
from test.test_launch_files import LAUNCH

if shutil.which("ros2") is None:
    pytest.skip("no ros2 on the PATH", allow_module_level=True)
try:
    get_package_prefix("rim_camera_ros")
except PackageNotFoundError:
    pytest.skip("no workspace with this package is sourced", allow_module_level=True)


@pytest.mark.parametrize("separate", ["false", "true"])
def test_the_line_of_the_readme(world: World, separate: str) -> None:
    launched = world.launch(LAUNCH / "camera.launch.py", scene="room", camera="sr3000", separate=separate)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    said = world.diagnostics()
    assert world.until(lambda: len(points) > 20), launched.text
    assert (points.last.width, points.last.height) == (176, 144)
    assert points.last.header.frame_id == "camera_optical_frame"
    names = ("driver: frames", "correction: frames", "correction: publishers")
    assert world.until(lambda: all(said.level(f"/camera/{one}") == 0 for one in names)), launched.text
    assert launched.text.count("still drifting") == 1
    launched.send(signal.SIGINT)
    assert launched.wait() == 0, launched.text
    assert not re.search(r"Traceback|process has died", launched.text), launched.text


def test_two_cameras(world: World) -> None:
    launched = world.launch(LAUNCH / "cameras.launch.py", cameras="front,rear")
    clouds = [world.collect(PointCloud2, f"/{one}/points", BEST_EFFORT) for one in ("front", "rear")]
    assert world.until(lambda: all(len(one) > 5 for one in clouds)), launched.text
    assert [one.last.header.frame_id for one in clouds] == ["front_optical_frame", "rear_optical_frame"]
    launched.send(signal.SIGINT)
    assert launched.wait() == 0, launched.text
    assert "Traceback" not in launched.text
