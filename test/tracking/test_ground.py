"""The floor's frame against trigonometry, and against the driver's mount."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rim_camera_ros.errors import InputError
from rim_camera_ros.tracking.ground import Ground


def test_the_optical_axis_meets_the_floor_where_trigonometry_says() -> None:
    ground = Ground(height=2.2, pitch=math.radians(20))
    along = 2.2 / math.sin(math.radians(20))
    assert ground.from_optical(np.array([[0.0, 0.0, along]]))[0] == pytest.approx(
        [2.2 / math.tan(math.radians(20)), 0.0, 0.0], abs=1e-12
    )


def test_right_and_down_in_the_image() -> None:
    points = Ground(height=1.5).from_optical(np.array([[0.3, 0.0, 2.0], [0.0, 0.4, 2.0]]))
    assert points == pytest.approx(np.array([[2.0, -0.3, 1.5], [2.0, 0.0, 1.1]]), abs=1e-12)


def test_roll_lowers_what_is_to_the_right() -> None:
    points = Ground(height=1.0, roll=math.pi / 6).from_optical(np.array([[1.0, 0.0, 2.0]]))
    assert points[0] == pytest.approx([2.0, -math.cos(math.pi / 6), 0.5], abs=1e-12)


def test_the_convention_is_that_of_the_driver() -> None:
    pytest.importorskip("rclpy")
    from scipy.spatial.transform import Rotation

    from rim_camera_ros.nodes.common.transforms import optical_rotation

    theirs = Rotation.from_quat(optical_rotation(roll=0.2, pitch=-0.5, yaw=0.0))
    ours = Ground(height=1.0, roll=0.2, pitch=-0.5).rotation
    assert (theirs.inv() * ours).magnitude() < 1e-12


@given(
    height=st.floats(0.1, 10),
    roll=st.floats(-3, 3),
    pitch=st.floats(-1.4, 1.4),
    point=st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_there_and_back(height: float, roll: float, pitch: float, point: tuple[float, ...]) -> None:
    ground = Ground(height=height, roll=roll, pitch=pitch)
    there = ground.from_optical(np.array([point]))
    assert ground.to_optical(there)[0] == pytest.approx(point, abs=1e-9)
    # lengths from the projection centre stay
    assert math.dist(there[0], (0, 0, height)) == pytest.approx(math.dist(point, (0, 0, 0)), abs=1e-9)


def test_wrong_mounts() -> None:
    with pytest.raises(InputError, match=r"mount\.z: 0 m above the floor \(give more than 0\)"):
        Ground(height=0.0)
    with pytest.raises(InputError, match=r"mount\.pitch: with 1\.57 rad the camera looks along the vertical"):
        Ground(height=1.0, pitch=1.57)
