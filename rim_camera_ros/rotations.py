"""Rotations: matrices, quaternions x y z w, and twists."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_matrix(orientation: tuple[float, float, float, float]) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion x y z w, which is normalised first."""
    q = np.array(orientation, dtype=float)
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Return the quaternion x y z w (w >= 0) of a rotation matrix."""
    k = np.array(
        [
            [rotation[0, 0] - rotation[1, 1] - rotation[2, 2], 0, 0, 0],
            [rotation[0, 1] + rotation[1, 0], rotation[1, 1] - rotation[0, 0] - rotation[2, 2], 0, 0],
            [
                rotation[0, 2] + rotation[2, 0],
                rotation[1, 2] + rotation[2, 1],
                rotation[2, 2] - rotation[0, 0] - rotation[1, 1],
                0,
            ],
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
                rotation[0, 0] + rotation[1, 1] + rotation[2, 2],
            ],
        ]
    )
    q = np.linalg.eigh(k, UPLO="L")[1][:, -1]
    if q[3] < 0:
        q = -q
    return (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def screw(linear: Array, angular: Array) -> tuple[Array, Array]:
    """Exponential of a twist: rotation (3, 3) and translation (3,)."""
    angle = float(np.linalg.norm(angular))
    if angle < 1e-12:
        return np.eye(3), linear
    k = np.array(
        [
            [0, -angular[2], angular[1]],
            [angular[2], 0, -angular[0]],
            [-angular[1], angular[0], 0],
        ]
    )
    s, c = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    rotation = np.eye(3) + s * k + c * (k @ k)
    left = np.eye(3) + c * k + (1 - s) / angle**2 * (k @ k)
    return rotation, left @ linear
