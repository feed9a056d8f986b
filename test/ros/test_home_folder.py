"""``~`` in parameters that name files, and parameters of topics of which there is any number."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from rim_camera_ros.files import find_camera, find_scene
from test.helpers_cli import process
from test.ros.harness import BEST_EFFORT, LATCHED, World


@pytest.fixture
def home(world: World, tmp_path: Path) -> Path:
    """A home folder of the nodes, with a camera and a scene."""
    folder = tmp_path / "home"
    (folder / "files").mkdir(parents=True)
    for file in find_camera("pmd3ks").parent.glob("pmd3ks*"):
        shutil.copy(file, folder)
        shutil.copy(file, folder / "files")
    shutil.copy(find_scene("wall"), folder / "mine.yaml")
    world.environment["HOME"] = str(folder)
    return folder


def test_home_in_parameters_of_driver_and_correction(world: World, home: Path) -> None:
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    driver = world.start("driver_node", camera="~/pmd3ks.yaml", scene="~/mine.yaml", frame_rate=10.0)
    world.start("correction_node", camera="~/pmd3ks.yaml", folders="~/files")
    assert world.until(lambda: images and points), world.output()
    assert (images.last.width, images.last.height) == (64, 48)
    source = f"simulation of {home}/pmd3ks.yaml in {home}/mine.yaml"
    assert world.until(lambda: source in driver.text), world.output()
    # what was given at the start may be named again, in either way, and is the same
    assert world.set("driver", camera=f"{home}/pmd3ks.yaml") == ""
    assert world.set("driver", camera="~/pmd3ks.yaml") == ""
    assert "now publishing" not in driver.text
    assert world.set("correction", camera="~/files/pmd3ks.yaml", save_as="kept") == ""
    assert "lies outside of the folders" in world.set("correction", camera="~/other/pmd3ks.yaml")
    answer = world.call(Trigger, "correction/save_camera")
    assert (answer.success, answer.message) == (True, f"written to {home}/files/kept.yaml")


def test_home_in_parameters_of_playback_and_calibration(world: World, home: Path) -> None:
    environment = {**world.environment, "HOME": str(home)}
    arguments = [
        "simulate",
        "~/mine.yaml",
        "--camera=~/pmd3ks.yaml",
        "--frames",
        "3",
        "--out=~/bag",
        "--quiet",
    ]
    made = process(*arguments, env=environment)
    assert made.communicate(timeout=60) == ("", "")
    assert (home / "bag" / "metadata.yaml").is_file()
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    world.start("driver_node", source="playback", recording="~/bag", frame_rate=10.0)
    assert world.until(lambda: images), world.output()
    world.start("calibration_node", recordings="~/bag:~/lost", scene="~/mine.yaml", camera="~/pmd3ks.yaml")
    answer = world.call(Trigger, "calibration/start")
    assert answer.message.startswith(
        f"{home}/lost: recordings: lies outside of the folders"
    )  # the bag does not


def test_surfaces_of_a_scene_bring_no_parameters(world: World) -> None:
    world.start("driver_node", scene="room")
    poses = world.collect(PoseStamped, "ground_truth/back_wall/pose", LATCHED)
    assert world.until(lambda: poses), world.output()
    names = list(world.describe("driver"))
    assert not [one for one in names if "ground_truth" in one]
    assert "qos_overrides./camera/distance/image_raw.publisher.reliability" in names
