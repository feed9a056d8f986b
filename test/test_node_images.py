"""Images of the nodes: rectified depth against planes, compressed images against the plug-ins' formulas."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="rim_camera_ros.nodes needs it")

from std_msgs.msg import Header

from rim_camera_ros.bags.image_transport import compressed, compressed_depth
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics
from rim_camera_ros.nodes.common import messages
from rim_camera_ros.pipeline.rectification import Rectifier

#: An SR-3000's size with strong, asymmetric distortion.
LENS = Intrinsics(
    width=176, height=144, fx=199.9, fy=203.1, cx=89.99, cy=74.4, d=(-0.35, 0.12, 0.004, -0.003, 0.0)
)


def plane_depth(rays: np.ndarray, normal: tuple[float, float, float], offset: float) -> np.ndarray:
    """Return the depth along z of a plane, normal . X = offset, on rays (x/z, y/z) of shape (..., 2)."""
    return offset / (normal[0] * rays[..., 0] + normal[1] * rays[..., 1] + normal[2])


def seen_rays() -> np.ndarray:
    """Return x/z, y/z of the distorted pixels (H, W, 2), by OpenCV's inverse of the model."""
    v, u = np.mgrid[: LENS.height, : LENS.width].astype(np.float64)
    matrix = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]])
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    # with criteria a function of its own before OpenCV 5
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    rays = undistort(pixels, matrix, np.array(LENS.d), R=np.eye(3), P=np.eye(3), criteria=criteria)
    return rays.reshape(LENS.height, LENS.width, 2)


def pinhole_rays() -> np.ndarray:
    v, u = np.mgrid[: LENS.height, : LENS.width].astype(np.float64)
    return np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy], -1)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.2, 0.8), (-0.1, 0.6, 0.7)])
def test_a_plane_stays_a_plane(normal: tuple[float, float, float]) -> None:
    seen = plane_depth(seen_rays(), normal, 2.3).astype(np.float32)
    rectified = Rectifier(LENS).depth(seen)
    known = np.isfinite(rectified)
    assert known[20:-20, 20:-20].all()
    expected = plane_depth(pinhole_rays(), normal, 2.3)
    error = np.abs(rectified - expected)[known]
    # remap interpolates in 32nds of a pixel, and the curvature of the distortion is left
    assert np.quantile(error, 0.99) < 0.002
    # without rectification the same pixels are centimetres off
    assert normal == (0.0, 0.0, 1.0) or np.nanmax(np.abs(seen - expected)) > 0.05


def test_edges_invent_no_points_and_holes_stay_holes() -> None:
    image = np.full((144, 176), 3.0, np.float32)
    image[:, :80] = 1.5
    image[60:70, 100:120] = np.nan
    rectified = Rectifier(LENS).depth(image)
    known = rectified[np.isfinite(rectified)]
    off = np.minimum(np.abs(known / 1.5 - 1.0), np.abs(known / 3.0 - 1.0))
    assert off.max() < 0.021
    assert (off > 1e-6).mean() < 0.002
    assert 0.3 < (known < 2.0).mean() < 0.6
    assert np.isnan(rectified).sum() > 100
    assert np.isfinite(Rectifier(LENS).depth(np.full((144, 176), 2.0, np.float32))[72, 88])


def decoded(data: bytes) -> np.ndarray:
    """Decode a compressed depth as compressed_depth_image_transport's subscriber does."""
    _, a, b = struct.unpack("<iff", data[:12])
    pixels = cv2.imdecode(np.frombuffer(data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint16
    with np.errstate(divide="ignore"):
        return np.where(pixels > 0, np.float32(a) / (pixels.astype(np.float32) - np.float32(b)), np.nan)


@given(st.lists(st.floats(0.25, 9.875, width=32), min_size=12, max_size=12))
def test_a_compressed_depth_is_within_half_a_step(depths: list[float]) -> None:
    depth = np.array(depths, np.float32).reshape(3, 4)
    name, data = compressed_depth(depth)
    assert name == "32FC1; compressedDepth png"
    assert struct.unpack("<iff", data[:12]) == (0, 10100.0, -1009.0)  # the plug-in's defaults: 100 and 10 m
    assert (np.abs(decoded(data) - depth) <= 0.51 * depth**2 / 10100 + 1e-5).all()


def test_depths_that_cannot_be_held_are_none() -> None:
    depth = np.array([[np.nan, -1.0, 0.0, np.inf], [0.1, 0.16, 9.99, 10.0]], np.float32)
    back = decoded(compressed_depth(depth)[1])
    assert np.isnan(back).tolist() == [[True, True, True, True], [True, False, False, True]]
    assert back[1, 1] == pytest.approx(0.16, abs=1e-5)


@pytest.mark.parametrize(("kind", "encoding"), [(np.uint8, "8UC1"), (np.uint16, "16UC1")])
def test_whole_numbers_are_compressed_without_loss(kind: type, encoding: str) -> None:
    pixels = np.random.default_rng(3).integers(0, np.iinfo(kind).max, (14, 17), dtype=kind)
    name, data = compressed(pixels)
    assert name == f"{encoding}; png compressed "
    assert np.array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), pixels)


def test_what_is_no_image_is_refused() -> None:
    with pytest.raises(InputError, match="is no image"):
        compressed(np.zeros((3, 4), np.int64))


def test_a_cloud_message_holds_the_points_that_were_written_into_it() -> None:
    made = messages.CloudMessage((3, 5))
    for seed in (1, 2):
        points = np.random.default_rng(seed).normal(size=(3, 5, 4)).astype(np.float32)
        made.points[...] = points
        header = Header(frame_id=str(seed))
        message, expected = made.of(header), messages.cloud(points, header)
        assert bytes(message.data) == points.tobytes()
        assert message == expected
