"""The shipped profile of Fast DDS, and what users set in its place."""

from __future__ import annotations

import json
import re
import signal
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rim_camera_ros.files import share_folder
from rim_camera_ros.nodes.common.run import use_shipped_profile
from test.ros.harness import Process, World

PROFILE = share_folder() / "config" / "fastdds.xml"


@pytest.mark.parametrize(
    ("environment", "middleware", "said", "used"),
    [
        ({}, "rmw_fastrtps_cpp", f"middleware: Fast DDS with {PROFILE}", str(PROFILE)),
        ({"FASTDDS_BUILTIN_TRANSPORTS": ""}, "rmw_fastrtps_dynamic_cpp", f"with {PROFILE}", str(PROFILE)),
        (
            {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"},
            "rmw_fastrtps_cpp",
            "middleware: Fast DDS as FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA says",
            None,
        ),
        (
            {"FASTRTPS_DEFAULT_PROFILES_FILE": "/a.xml"},
            "rmw_fastrtps_cpp",
            "FASTRTPS_DEFAULT_PROFILES_FILE=/a.xml",
            "/a.xml",
        ),
        (
            {"FASTDDS_DEFAULT_PROFILES_FILE": "/b.xml"},
            "rmw_fastrtps_cpp",
            "FASTDDS_DEFAULT_PROFILES_FILE=/b.xml",
            None,
        ),
        ({}, "rmw_cyclonedds_cpp", "middleware: rmw_cyclonedds_cpp, with its own settings", None),
    ],
)
def test_the_profile_is_used_only_where_the_user_has_set_nothing(
    environment: dict[str, str], middleware: str, said: str, used: str | None
) -> None:
    environment = dict(environment)
    assert said in use_shipped_profile(environment, profile=PROFILE, middleware=middleware)
    assert environment.get("FASTRTPS_DEFAULT_PROFILES_FILE") == used


def test_the_profile_keeps_the_default_lease() -> None:
    assert not re.search("<lease(Duration|Announcement)>", PROFILE.read_text())


#: With LARGE_DATA, Fast DDS 2.14 does not connect some processes that start within seconds of each other
#: (once in 35 times with plain rclpy): a user starts them again, and so does the test.
STARTS = {"": 1, "LARGE_DATA": 3}


@pytest.mark.parametrize("transports", STARTS)
def test_clouds_arrive_with_the_transports_of_the_user(world: World, tmp_path: Path, transports: str) -> None:
    """A listener of its own, with the user's settings and not with the profile."""
    del world.environment["ROS_AUTOMATIC_DISCOVERY_RANGE"]  # as it is by default
    world.environment.pop("FASTDDS_BUILTIN_TRANSPORTS", None)
    if transports:
        world.environment["FASTDDS_BUILTIN_TRANSPORTS"] = transports
    said = f"FASTDDS_BUILTIN_TRANSPORTS={transports} says" if transports else "config/fastdds.xml"
    for _ in range(STARTS[transports]):
        nodes = [world.start("driver_node", scene="wall", frame_rate=10.0), world.start("correction_node")]
        summary = tmp_path / "summary.json"
        command = [sys.executable, "-m", "rim_camera_ros.nodes.common.latency_monitor", "--frames", "15"]
        monitor = Process(
            [*command, "--timeout", "25", "--json", str(summary)], world.environment, tmp_path / "monitor.txt"
        )
        status = monitor.wait(120.0)
        for one in nodes:
            assert re.search(rf"middleware: Fast DDS .*{said}", one.text), one.text
            one.send(signal.SIGINT)
        for one in nodes:
            one.wait()
        arrived = json.loads(summary.read_text())
        if arrived["points"] >= 15:
            break
    else:
        pytest.fail(f"{arrived}\n{monitor.text}\n{world.output()}")
    assert status == 0
