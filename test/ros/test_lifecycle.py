"""Managed nodes: transitions by service, what is published in which state, what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image, PointCloud2

from test.ros.harness import BEST_EFFORT, World, stamp_of


def test_a_driver_waits_for_its_manager_and_stops_and_goes_on(world: World) -> None:
    driver = world.start("driver_node", autostart=False, scene="wall", frame_rate=50.0)
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert world.state("driver") == "unconfigured"
    assert not images.matched
    assert not world.transition("driver", "activate")  # a state is missing in between
    assert not world.transition("driver", "nonsense")
    assert world.transition("driver", "configure")
    assert world.until(lambda: images.matched), world.output()
    assert world.state("driver") == "inactive"
    assert world.transition("driver", "activate")
    assert world.until(lambda: len(images) > 5), world.output()
    assert world.transition("driver", "deactivate")
    assert world.state("driver") == "inactive"
    world.until(lambda: False, 0.2)  # what was on its way
    count = len(images)
    assert not world.until(lambda: len(images) > count, 0.5)
    assert world.set("driver", scene="corner", frame_rate=25.0) == ""  # takes effect at the activation
    assert world.transition("driver", "activate")
    assert world.until(lambda: len(images) > count + 5), world.output()
    steps = {
        stamp_of(b) - stamp_of(a) for a, b in zip(images.messages[-4:-1], images.messages[-3:], strict=True)
    }
    assert all(abs(step % 40_000_000) in (0, 1, 39_999_999) for step in steps)
    assert world.transition("driver", "deactivate")
    assert world.transition("driver", "cleanup")
    assert world.until(lambda: not images.matched), world.output()
    assert world.transition("driver", "configure")
    assert world.transition("driver", "activate")
    assert world.until(lambda: images.matched)
    assert world.transition("driver", "shutdown from active")
    assert world.state("driver") == "finalized"
    assert driver.running
    assert "Traceback" not in driver.text


def test_a_refused_configuration_names_the_reason_and_can_be_mended(world: World, tmp_path: Path) -> None:
    driver = world.start("driver_node", autostart=False, source="playback", folders=str(tmp_path))
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert not world.transition("driver", "configure")
    assert world.state("driver") == "unconfigured"
    assert re.search(r"cannot configure: recording: source playback needs a recording", driver.text)
    assert world.set("driver", source="simulator") == ""
    assert world.transition("driver", "configure")
    assert world.transition("driver", "activate")
    assert world.until(lambda: len(images) > 2), world.output()


def test_a_correction_that_is_deactivated_publishes_nothing_old(world: World) -> None:
    world.start("driver_node", scene="wall", frame_rate=50.0)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    world.start("correction_node")
    assert world.until(lambda: len(points) > 5), world.output()
    assert world.transition("correction", "deactivate")
    world.until(lambda: False, 0.2)
    count, before = len(points), stamp_of(points.last)
    assert not world.until(lambda: len(points) > count, 0.5)
    assert world.set("correction", minimum_amplitude=300.0) == ""
    assert world.transition("correction", "activate")
    assert world.until(lambda: len(points) > count + 5), world.output()
    # half a second of frames went by and none of them comes late
    assert stamp_of(points.messages[count]) - before > 400_000_000
    assert world.transition("correction", "deactivate")
    assert world.transition("correction", "cleanup")
    assert world.until(lambda: not points.matched), world.output()
    assert world.state("correction") == "unconfigured"
