"""Fields of the cloud, rectified depth, compressed images: as subscribers of other packages read them."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from rim_camera_ros import messages
from rim_camera_ros.bags.messages import image_array, points_array
from rim_camera_ros.files import find_camera
from test.ros.harness import BEST_EFFORT, LATCHED, World, stamp_of


def test_fields_of_the_cloud_can_be_chosen_while_it_runs(world: World) -> None:
    process = world.start("camera_node", scene="room", frame_rate=5)
    topics = {"points": PointCloud2, "sigma/image": Image, "flags/image": Image}
    points, sigma, flags = (world.collect(kind, topic, BEST_EFFORT) for topic, kind in topics.items())
    assert world.until(lambda: points and sigma and flags), process.text
    assert (points.last.point_step, [one.name for one in points.last.fields]) == (
        16,
        ["x", "y", "z", "intensity"],
    )
    reason = world.set("correction", **{"points.fields": "xyz"})
    assert "'xyz' is not a choice" in reason
    assert world.set("correction", **{"points.fields": "xyzi+sigma+flags"}) == ""

    def complete() -> bool:
        return points.last.point_step == 24 and all(
            stamp_of(points.last) in one.by_stamp() for one in (sigma, flags)
        )

    assert world.until(complete), process.text
    cloud = points.last
    assert [(one.name, one.offset, one.datatype) for one in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("intensity", 12, 7),
        ("sigma", 16, 7),
        ("flags", 20, 2),
    ]
    assert (cloud.row_step, len(cloud.data)) == (24 * 176, 24 * 176 * 144)
    kind = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "sigma", "flags"],
            "formats": ["<f4"] * 5 + ["u1"],
            "offsets": [0, 4, 8, 12, 16, 20],
            "itemsize": 24,
        }
    )
    read = np.frombuffer(cloud.data, kind).reshape(144, 176)
    stamp = stamp_of(cloud)
    assert np.array_equal(read["sigma"], image_array(sigma.by_stamp()[stamp]), equal_nan=True)
    assert np.array_equal(read["flags"], image_array(flags.by_stamp()[stamp]))
    assert len(np.unique(read["flags"])) > 1
    fields = messages.cloud(cloud)
    assert np.array_equal(fields["sigma"], read["sigma"], equal_nan=True)
    assert np.array_equal(fields["flags"], read["flags"])
    assert np.array_equal(points_array(cloud)[..., 2], read["z"], equal_nan=True)


def test_depth_rectified_and_compressed(world: World) -> None:
    process = world.start("camera_node", scene="wall", frame_rate=5)
    images = {
        topic: world.collect(Image, topic, BEST_EFFORT)
        for topic in ("depth/image_raw", "depth/image_rect", "amplitude/image_raw", "flags/image")
    }
    packed = {
        topic: world.collect(CompressedImage, topic, BEST_EFFORT)
        for topic in (
            "depth/image_raw/compressedDepth",
            "depth/image_rect/compressedDepth",
            "amplitude/image_raw/compressed",
            "flags/image/compressed",
        )
    }
    everything = [*images.values(), *packed.values()]
    common: set[int] = set()

    def complete() -> bool:
        common.update(set.intersection(*(set(one.by_stamp()) for one in everything)))
        return bool(common)

    assert world.until(complete), process.text
    stamp = common.pop()
    for topic, collected in packed.items():
        message, original = collected.by_stamp()[stamp], images[topic.rpartition("/")[0]].by_stamp()[stamp]
        assert message.header == original.header
        pixels = image_array(original)
        data = bytes(message.data)
        if topic.endswith("/compressed"):
            assert message.format == f"{original.encoding}; png compressed "
            assert np.array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), pixels)
            continue
        assert message.format == "32FC1; compressedDepth png"
        _, a, b = struct.unpack("<iff", data[:12])
        steps = cv2.imdecode(np.frombuffer(data[12:], np.uint8), cv2.IMREAD_UNCHANGED).astype(float)
        held = steps > 0
        assert np.array_equal(held, np.isfinite(pixels))
        assert np.abs(a / (steps[held] - b) - pixels[held]).max() < 0.004
        assert len(data) < len(original.data) / 2
    raw, rectified = (image_array(images[f"depth/image_{one}"].by_stamp()[stamp]) for one in ("raw", "rect"))
    both = np.isfinite(raw) & np.isfinite(rectified)
    assert both.mean() > 0.8
    assert not np.array_equal(raw[both], rectified[both])
    # a wall across the view is as far in both
    assert np.median(rectified[both]) == pytest.approx(np.median(raw[both]), abs=0.01)


def test_amplitudes_as_jpeg(world: World) -> None:
    driver = world.start("driver_node", scene="room", frame_rate=5, **{"compressed.format": "jpeg"})
    images = {
        role: (
            world.collect(Image, f"{role}/image_raw", BEST_EFFORT),
            world.collect(CompressedImage, f"{role}/image_raw/compressed", BEST_EFFORT),
        )
        for role in ("amplitude", "distance")
    }

    def latest(role: str) -> tuple[Any, Any] | None:
        plain, packed = (one.by_stamp() for one in images[role])
        common = plain.keys() & packed.keys()
        return (plain[max(common)], packed[max(common)]) if common else None

    def read(role: str) -> tuple[np.ndarray, str, np.ndarray, int]:
        pair = latest(role)
        assert pair is not None
        data = np.frombuffer(bytes(pair[1].data), np.uint8)
        return image_array(pair[0]), pair[1].format, cv2.imdecode(data, cv2.IMREAD_UNCHANGED), data.size

    assert world.until(lambda: latest("amplitude") and latest("distance")), driver.text
    counts, kind, pixels, size = read("amplitude")
    assert kind == "16UC1; jpeg compressed mono8"
    assert (pixels.dtype, pixels.shape) == (np.uint8, counts.shape)
    # what image_transport's subscriber makes of it, within its rounding and JPEG's
    assert np.abs(256.0 * pixels - counts).mean() < 256
    assert size < counts.nbytes / 8
    counts, kind, pixels, _ = read("distance")
    assert kind == "16UC1; png compressed "
    assert np.array_equal(pixels, counts)
    assert world.set("driver", **{"compressed.format": "png"}) == ""
    assert "now publishing" not in driver.text
    assert world.until(lambda: latest("amplitude")[1].format == "16UC1; png compressed ")  # type: ignore[index]
    counts, _, pixels, _ = read("amplitude")
    assert np.array_equal(pixels, counts)
    assert "is not a choice" in world.set("driver", **{"compressed.format": "gif"})


def test_device_and_file_are_published_to_who_joins_late(world: World, tmp_path: Path) -> None:
    process = world.start("camera_node", scene="wall", folders=str(tmp_path))
    said = world.diagnostics()
    assert world.until(lambda: len(said.of("/camera/driver: device")) > 1), process.text
    device = world.collect(DiagnosticArray, "device_info", LATCHED)
    file = world.collect(DiagnosticArray, "correction/camera_file", LATCHED)
    frames = world.collect(DiagnosticArray, "frame_info", BEST_EFFORT)
    assert world.until(lambda: device and file and frames), process.text
    shipped = find_camera("sr3000")
    digest = hashlib.sha256(shipped.read_bytes()).hexdigest()
    info = messages.device_info(device.last)
    assert (info.device, info.source) == ("SR-3000", "simulation of sr3000 in wall")
    assert (info.modulation_frequency, info.serial_number) == (20e6, None)
    assert (info.file, info.file_sha256) == (str(shipped), digest)
    (status,) = messages.statuses(file.last).values()
    assert (status.values["file_sha256"], status.values["switched_off"]) == (digest, "")
    assert messages.frame_info(frames.last).settings.integration_time == 100.0
    assert world.set("correction", **{"effects.scattering": False}) == ""
    assert world.until(lambda: len(file) > 1), process.text
    (status,) = messages.statuses(file.last).values()
    assert status.values["switched_off"] == "scattering"
    assert "scattering" not in status.values["effects"].split(", ")
    assert len(device) == 1  # nothing of it has changed
