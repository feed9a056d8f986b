"""A camera of two frequencies on a robot: driver and correction as processes of their own."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image

from rim_camera_ros import messages
from rim_camera_ros.bags.messages import image_array
from rim_camera_ros.files import find_scene
from test.ros.harness import LOSSLESS_CORRECTION, LOSSLESS_DRIVER, RELIABLE, World, stamp_of

IMAGES = ("distance_0", "amplitude_0", "distance_1", "amplitude_1")


def test_the_distance_is_resolved_from_the_images_of_both(world: World) -> None:
    # four images at once are more than the 512 kB of shared memory of LARGE_DATA: best effort would lose them
    driver = world.start(
        "driver_node", scene=str(find_scene("room")), camera="azure_kinect", frame_rate=2, **LOSSLESS_DRIVER
    )
    correction = world.start("correction_node", camera="azure_kinect", **LOSSLESS_CORRECTION)
    raw = {one: world.collect(Image, f"{one}/image_raw", RELIABLE) for one in IMAGES}
    info = world.collect(DiagnosticArray, "frame_info", RELIABLE)
    distance, flags = (world.collect(Image, one, RELIABLE) for one in ("distance/image", "flags/image"))

    def together() -> set[int]:
        return set.intersection(*(set(one.by_stamp()) for one in (*raw.values(), distance, flags)))

    assert world.until(lambda: together() and info), driver.text + correction.text
    stamp = max(together())
    resolved = image_array(distance.by_stamp()[stamp])
    assert resolved.shape == (288, 320)
    # the room is deeper than the 1.5 and 1.9 m at which the frequencies fold
    assert np.nanmedian(resolved) > 1.0
    assert np.nanmax(resolved) > 2.5
    bits = image_array(flags.by_stamp()[stamp])
    assert np.array_equal(np.isnan(resolved), (bits & (1 | 2 | 16 | 32)) != 0)
    # 100 MHz: counts are 1.499 m / 65536
    metres = image_array(raw["distance_0"].by_stamp()[stamp]) * (299_792_458 / 200e6 / 65536)
    apart = np.abs(resolved - metres) / (299_792_458 / 200e6)
    assert np.nanmedian(np.abs(apart - np.rint(apart))) < 0.01
    assert messages.frame_info(info.last).settings.extra["modulation_frequencies"] == "100000000 80000000"
    assert stamp_of(raw["amplitude_1"].by_stamp()[stamp]) == stamp


def test_a_file_of_other_images_is_refused_while_frames_flow(world: World) -> None:
    correction = world.start("correction_node", camera="azure_kinect")
    assert world.until(lambda: world.state("correction") == "active"), correction.text
    assert "deactivate the node first" in world.set("correction", camera="sr3000")
    assert world.transition("correction", "deactivate")
    assert world.set("correction", camera="sr3000") == ""
