"""How frames lie to each other, against 4 x 4 matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.tracking.transform_tree import TransformTree

#: Child, parent, position [m], roll pitch yaw [rad]: a robot with two arms of its tree.
FRAMES = [
    ("link", "map", (3.0, -1.0, 0.2), (0.0, 0.1, 2.0)),
    ("footprint", "link", (0.0, 0.0, -0.2), (0.0, -0.1, 0.0)),
    ("mast", "link", (0.1, 0.02, 1.1), (0.3, 0.2, -0.5)),
    ("optical", "mast", (0.05, -0.01, 0.3), (-1.6, 0.0, -1.5)),
]


def matrix(position: tuple[float, ...], angles: tuple[float, ...]) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    result[:3, 3] = position
    return result


@pytest.fixture
def tree() -> TransformTree:
    made = TransformTree()
    for child, parent, position, angles in FRAMES:
        quaternion = 3.0 * Rotation.from_euler("xyz", angles).as_quat()  # need not be of length 1
        assert made.add(parent, f"/{child}", position=position, quaternion=quaternion)
    return made


@pytest.mark.parametrize(
    ("base", "frame", "chain"),
    [
        ("link", "optical", [("mast", 1), ("optical", 1)]),
        ("footprint", "optical", [("footprint", -1), ("mast", 1), ("optical", 1)]),
        ("optical", "map", [("optical", -1), ("mast", -1), ("link", -1)]),
        ("/mast", "mast", []),
    ],
)
def test_along_the_tree(tree: TransformTree, base: str, frame: str, chain: list[tuple[str, int]]) -> None:
    steps = {child: matrix(position, angles) for child, _, position, angles in FRAMES}
    expected = np.eye(4)
    for child, power in chain:
        expected = expected @ np.linalg.matrix_power(steps[child], power)
    found = tree.lookup(base, frame)
    assert found is not None
    assert found[0].as_matrix() == pytest.approx(expected[:3, :3], abs=1e-12)
    assert found[1] == pytest.approx(expected[:3, 3], abs=1e-12)


def test_what_is_not_connected_and_circles(tree: TransformTree) -> None:
    assert tree.lookup("other", "optical") is None
    assert tree.lookup("link", "other") is None
    assert tree.add("optical", "map", position=(0, 0, 0), quaternion=(0, 0, 0, 1))  # a circle
    assert tree.lookup("other", "link") is None


@pytest.mark.parametrize(
    ("parent", "child", "position", "quaternion"),
    [
        ("map", "link", (math.nan, 0, 0), (0, 0, 0, 1)),
        ("map", "link", (0, 0, 0), (0, 0, 0, 0)),
        ("map", "link", (0, 0, 0), (0, math.inf, 0, 1)),
        ("link", "/link", (0, 0, 0), (0, 0, 0, 1)),
        ("map", "", (0, 0, 0), (0, 0, 0, 1)),
    ],
)
def test_no_transforms(
    tree: TransformTree, parent: str, child: str, position: tuple[float, ...], quaternion: tuple[float, ...]
) -> None:
    before = tree.lookup("map", "link")
    assert before is not None
    assert not tree.add(parent, child, position=position, quaternion=quaternion)
    after = tree.lookup("map", "link")
    assert after is not None
    assert np.array_equal(after[1], before[1])
