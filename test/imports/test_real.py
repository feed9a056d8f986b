"""Real recordings, published as their driver would, and imported again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, messages
from rim_camera_ros.bags.topics import CAMERA_INFO
from rim_camera_ros.camera_file import load_camera
from test.helpers_bags import Line
from test.helpers_cli import run
from test.imports.drivers import encoded, image, packed, write_driver_bag

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"
pytestmark = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the real recordings are not beside this checkout (../shared/recordings)"
)


def test_kinect_as_its_bridge_publishes_it(tmp_path: Path, capsys: Any) -> None:
    """Depth along z in whole millimetres, compressed; back, no distance may differ by more than rounding."""
    folder = RECORDINGS / "kinect2_checkerboard"
    camera = load_camera(folder / "camera.yaml")
    lines, before = [], []
    with Recording(folder / "recording") as recording:
        for i, frame in enumerate(recording.frames()):
            if i % 9:
                continue
            # in the corners this lens model folds back: pixels there have no direction
            z = np.nan_to_num(frame.distance * camera.sensor.lsb * camera.rays[..., 2])
            png = encoded(np.rint(z * 1e3).astype(np.uint16), ".png")
            lines += [
                packed(png, "16UC1; png compressed", "/kinect2/sd/image_depth/compressed", frame.stamp),
                image(frame.amplitude, "/kinect2/sd/image_ir", frame.stamp),
                Line(
                    "/kinect2/sd/camera_info",
                    CAMERA_INFO,
                    frame.stamp,
                    messages.camera_info_message(camera.intrinsics, frame.stamp),
                ),
            ]
            before.append(frame)
    assert len(before) == 8
    bag = write_driver_bag(tmp_path / "kinect.bag", lines, ros1=True)
    status, _, notes = run(capsys, "import", bag, "--out", tmp_path / "out", "--integration-time", "1")
    assert (status, "of the pixels have no direction by the lens model" in notes) == (0, True)
    with Recording(tmp_path / "out") as recording:
        after = list(recording.frames())
    for one, other in zip(before, after, strict=True):
        assert one.stamp == other.stamp
        assert np.array_equal(one.amplitude, other.amplitude)
        metres = one.distance * camera.sensor.lsb
        # half a millimetre along z, and half a count of the recording
        limit = (0.5e-3 + 0.5e-7) / camera.rays[..., 2] + 1e-6
        seen = np.isfinite(limit)
        assert seen.mean() > 0.9
        assert np.all(np.abs(other.distance - metres)[seen] <= limit[seen])
        assert not other.distance[~seen].any()
        assert (other.distance > 0).sum() > 1000


def test_o3d303_as_its_driver_publishes_it(tmp_path: Path, capsys: Any) -> None:
    folder = RECORDINGS / "o3d303_wall"
    camera = load_camera(folder / "camera.yaml")
    lines, before = [], []
    with Recording(folder / "recording") as recording:
        for frame in recording.frames():
            counts = np.rint(frame.distance * camera.sensor.lsb * 1e3).astype(np.uint16)
            assert camera.sensor.lsb == 0.001
            lines += [
                image(counts, "/ifm3d/camera/distance", frame.stamp),
                image(frame.amplitude, "/ifm3d/camera/raw_amplitude", frame.stamp),
                Line(
                    "/ifm3d/camera/camera_info",
                    CAMERA_INFO,
                    frame.stamp,
                    messages.camera_info_message(camera.intrinsics, frame.stamp),
                ),
                image(counts, "/ifm3d/camera/xyz_image", frame.stamp),
            ]
            before.append(frame)
    bag = write_driver_bag(tmp_path / "o3d.bag", lines, ros1=True)
    status, _, notes = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert (status, "by the profile ifm3d_o3d3xx" in notes) == (0, True)
    with Recording(tmp_path / "out") as recording:
        after = list(recording.frames())
    assert len(after) == len(before) == 3
    for one, other in zip(before, after, strict=True):
        assert np.array_equal(one.distance, other.distance)
        assert np.array_equal(one.amplitude, other.amplitude)
        assert other.intrinsics is not None
        assert other.intrinsics.d == pytest.approx(camera.optics.d)
