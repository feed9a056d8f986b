"""Driver and correction as processes, from the simulated scene to the cloud."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, Temperature

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.scene import load_scene
from test.ros.harness import BEST_EFFORT, LATCHED, PATIENCE, RELIABLE, Chain, World, stamp_of

RAW = {
    "distance/image_raw": Image,
    "amplitude/image_raw": Image,
    "camera_info": CameraInfo,
    "distance/camera_info": CameraInfo,
    "frame_info": DiagnosticArray,
    "temperature": Temperature,
    "ambient_temperature": Temperature,
}
CORRECTED = {
    "points": PointCloud2,
    "sigma/image": Image,
    "flags/image": Image,
    "distance/image": Image,
    "depth/image_raw": Image,
    "depth/camera_info": CameraInfo,
}


@pytest.mark.parametrize("checked", ["1", ""], ids=["fields checked", "as users start it"])
@pytest.mark.parametrize("together", [False, True], ids=["two processes", "one process"])
def test_clouds_are_those_of_the_correction_bit_for_bit(
    world: World, *, together: bool, checked: str
) -> None:
    world.environment["ROS_PYTHON_CHECK_FIELDS"] = checked
    chain = Chain(
        world,
        driver={"scene": "room", "camera": "sr3000", "frame_rate": 25.0, "frames": 20, "seed": 3},
        correction={"camera": "sr3000"},
        together=together,
    )
    chain.finish()
    frames, clouds = chain.raw_frames(), chain.clouds()
    assert len(frames) == 20
    assert [one.settings.integration_time for one in frames] == [100.0] * 20
    assert all(one.settings.ambient_temperature is not None for one in frames)
    correction = Correction(load_camera(find_camera("sr3000")))
    for frame in frames:
        corrected = correction.correct(frame)
        expected = correction.cloud(corrected)
        assert clouds[frame.stamp].tobytes() == expected.tobytes()
        assert bytes(chain.flags.by_stamp()[frame.stamp].data) == corrected.flags.tobytes()
        assert bytes(chain.sigma.by_stamp()[frame.stamp].data) == corrected.sigma.tobytes()
    assert np.isfinite(expected[..., 2]).mean() > 0.5


def test_raw_topics_types_stamps_and_content(world: World) -> None:
    collected = {topic: world.collect(kind, topic, BEST_EFFORT) for topic, kind in RAW.items()}
    truth = world.collect(PoseStamped, "ground_truth/back_wall/pose", LATCHED)
    world.start("driver_node", frame_rate=25.0, scene="room")

    def complete() -> bool:
        common = set.intersection(*(set(one.by_stamp()) for one in collected.values()))
        return bool(truth) and len(common) >= 3 and all(len(one) >= 5 for one in collected.values())

    assert world.until(complete), world.output()
    camera = load_camera(find_camera("sr3000"))
    for topic in ("distance/image_raw", "amplitude/image_raw"):
        image = collected[topic].last
        assert (image.width, image.height, image.encoding) == (176, 144, "16UC1")
        assert (image.step, len(image.data), image.is_bigendian) == (352, 352 * 144, 0)
        assert image.header.frame_id == "camera_optical_frame"
    info = collected["camera_info"].last
    assert (info.width, info.height, info.distortion_model) == (176, 144, "plumb_bob")
    assert tuple(info.d) == camera.optics.d
    assert (info.k[0], info.k[2], info.k[4], info.k[5]) == (
        camera.optics.fx,
        camera.optics.cx,
        camera.optics.fy,
        camera.optics.cy,
    )
    pairs = {one.key: one.value for one in collected["frame_info"].last.status[0].values}
    # the camera was switched on 5 s before, and runs on through the stations of the schedule
    assert 5.0 < float(pairs["uptime"]) < 5.0 + PATIENCE
    assert pairs["integration_time"] in ("60", "100")
    assert collected["ambient_temperature"].last.temperature == 26.0
    wall = next(one for one in load_scene(find_scene("room")).surfaces if one.name == "back_wall")
    position = truth.last.pose.position
    assert (position.x, position.y, position.z) == wall.pose.pose.position  # type: ignore[union-attr]
    intervals = np.diff(sorted(collected["distance/image_raw"].by_stamp())) / 1e9
    assert np.allclose(intervals, np.maximum(np.rint(intervals / 0.04), 1) * 0.04, atol=1e-6)  # no drift


def test_frame_info_as_a_subscriber_in_cpp_reads_it(world: World) -> None:
    # the bytes on the wire, read by other code than that which writes them
    raw: list[bytes] = []
    world.node.create_subscription(DiagnosticArray, "/camera/frame_info", raw.append, BEST_EFFORT, raw=True)
    driver = world.start("driver_node", frame_rate=25.0, scene="wall")
    assert driver.running
    assert world.environment["ROS_PYTHON_CHECK_FIELDS"] == "1"
    assert world.until(lambda: len(raw) >= 3), world.output()
    read = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(raw[0], "diagnostic_msgs/msg/DiagnosticArray")
    (status,) = read.status  # type: ignore[attr-defined]
    assert (status.level, status.name) == (0, "frame_info")  # OK; 0xff was read where an int was given
    assert {"integration_time", "modulation_frequency", "uptime"} <= {one.key for one in status.values}


def test_another_namespace_and_frame(world: World) -> None:
    world.namespace = "/front"
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    world.start("driver_node", "-r", "__ns:=/front", frame_id="front_optical")
    world.start("correction_node", "-r", "__ns:=/front")
    assert world.until(lambda: images and points), world.output()
    assert images.last.header.frame_id == points.last.header.frame_id == "front_optical"
    assert world.get("driver", "frame_id") == ["front_optical"]


def test_only_what_somebody_subscribes_to_is_published(world: World) -> None:
    for node in ("driver_node", "correction_node"):
        world.start(node)
    flags = world.collect(Image, "flags/image", BEST_EFFORT)
    assert world.until(lambda: len(flags) > 2), world.output()
    depth = world.collect(Image, "depth/image_raw", BEST_EFFORT)
    assert world.until(lambda: len(depth) > 2), world.output()
    # a topic that is subscribed to later has nothing from before
    assert stamp_of(depth.messages[0]) > stamp_of(flags.messages[0])
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    assert world.until(lambda: len(points) > 2), world.output()
    cloud = points.last
    assert (cloud.height, cloud.width, cloud.point_step, cloud.is_dense) == (144, 176, 16, False)
    assert [(one.name, one.offset, one.datatype) for one in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("intensity", 12, 7),
    ]
    xyz = np.frombuffer(cloud.data, np.float32).reshape(144, 176, 4)
    invalid = np.isnan(xyz[..., 2])
    assert np.array_equal(np.isnan(xyz[..., 0]), invalid)
    assert 0 < invalid.mean() < 0.5


def test_corrected_images_and_depth(world: World) -> None:
    for node in ("driver_node", "correction_node"):
        world.start(node)
    collected = {topic: world.collect(kind, topic, BEST_EFFORT) for topic, kind in CORRECTED.items()}
    common: set[int] = set()

    def three_complete() -> bool:
        common.clear()
        common.update(set.intersection(*(set(one.by_stamp()) for one in collected.values())))
        return len(common) >= 3

    assert world.until(three_complete), world.output()
    stamp = max(common)
    encodings = {
        topic: one.last.encoding
        for topic, one in collected.items()
        if topic in CORRECTED and hasattr(one.last, "encoding")
    }
    assert encodings == {
        "sigma/image": "32FC1",
        "flags/image": "8UC1",
        "distance/image": "32FC1",
        "depth/image_raw": "32FC1",
    }

    def pixels(topic: str) -> Any:
        message = collected[topic].by_stamp()[stamp]
        kind = np.uint8 if message.encoding == "8UC1" else np.float32
        return np.frombuffer(message.data, kind).reshape(144, 176)

    cloud = np.frombuffer(collected["points"].by_stamp()[stamp].data, np.float32).reshape(144, 176, 4)
    distance, depth = pixels("distance/image"), pixels("depth/image_raw")
    assert np.array_equal(np.isnan(distance), (pixels("flags/image") & (1 | 2 | 16)) != 0)
    assert np.array_equal(np.isnan(distance), np.isnan(pixels("sigma/image")))
    assert np.array_equal(depth, cloud[..., 2], equal_nan=True)
    lit = np.isfinite(distance)
    assert np.allclose(np.linalg.norm(cloud[..., :3], axis=-1)[lit], distance[lit], rtol=1e-6)


@pytest.mark.parametrize("offered", ["sensor_data", "reliable"])
def test_reliable_subscriber(world: World, offered: str) -> None:
    images = world.collect(Image, "distance/image_raw", RELIABLE)
    driver = world.start("driver_node", **{"qos.images": offered})
    if offered == "reliable":
        assert world.until(lambda: len(images) > 2), world.output()
        assert "receives nothing" not in driver.text
    else:
        assert world.until(lambda: "receives nothing" in driver.text), world.output()
        assert "/camera/distance/image_raw requests another RELIABILITY" in driver.text
        assert "qos.images:=reliable" in driver.text
        assert not images


def test_latched_truth_reaches_a_late_listener(world: World) -> None:
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    world.start("driver_node", scene="wall", frame_rate=50.0)
    assert world.until(lambda: len(images) > 10), world.output()
    truth = world.collect(PoseStamped, "ground_truth/wall/pose", LATCHED)
    assert world.until(lambda: len(truth)), world.output()
    assert stamp_of(truth.messages[0]) <= stamp_of(images.last)
    assert truth.last.pose.position.z == 2.463
