"""A small image of a plane fits two poses nearly alike, mirrored at the line of sight."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rim_camera_ros.frame import Pose
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry.poses import estimate_poses
from rim_camera_ros.photogrammetry.targets import ImagePoint, Observations, Target, TargetField
from rim_camera_ros.rotations import quaternion, rotation_matrix

MATRIX = np.array([[365.0, 0, 260.0], [0, 361.0, 207.0], [0, 0, 1]])
SHIFT = np.array([0.11, -0.07, 1.45])


@pytest.mark.parametrize("angles", [(0.21, -0.13), (-0.3, 0.24)], ids=str)
def test_the_pose_that_fits_better_is_found(angles: tuple[float, float]) -> None:
    board = np.array([[0.03 * i, 0.03 * j, 0.0] for j in range(7) for i in range(5)]) - [0.06, 0.09, 0]
    rotation = cv2.Rodrigues(np.array([*angles, 0.4]))[0]
    image, _ = cv2.projectPoints(board, cv2.Rodrigues(rotation)[0], SHIFT, MATRIX, np.zeros(5))
    seen = image.reshape(-1, 2) + np.random.default_rng(2).normal(scale=0.02, size=(35, 2))
    sight = SHIFT / np.linalg.norm(SHIFT)
    normal = rotation[:, 2]
    wanted = 2 * (normal @ sight) * sight - normal
    turn = cv2.Rodrigues(
        np.cross(normal, wanted) / np.linalg.norm(np.cross(normal, wanted)) * _angle(normal, wanted)
    )
    wrong = turn[0] @ rotation
    assert _angle(normal, wrong[:, 2]) > 0.3
    for start in (rotation, wrong):
        observed = Observations(
            TargetField({str(k): Target((x, y, 0.0)) for k, (x, y, _) in enumerate(board)}),
            tuple(ImagePoint(str(k), 0, u, v, 0.02) for k, (u, v) in enumerate(seen)),
            {0: Pose((0.11, -0.07, 1.45), quaternion(start))},
        )
        optics = Optics(fx=365.0, fy=361.0, cx=260.0, cy=207.0)
        found = estimate_poses(observed, optics=optics).stations[0]
        assert _angle(rotation_matrix(found.pose.orientation)[:, 2], normal) < 4 * found.sigma_tilt


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.arccos(np.clip(one @ other, -1.0, 1.0)))
