"""Camera geometry: pixels <-> unit rays of a distorted lens (ROS ``plumb_bob``).

Source: Brown (1971) as used by Kahlmann 2007, sec. 3.2, in the parametrisation of ROS and OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity

Array = NDArray[np.float64]

#: Largest error of the undistortion in normalised image coordinates.
UNDISTORTION_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Optics:
    """Intrinsics in pixels; integer pixel coordinates lie at pixel centres."""

    fx: float = quantity("px", "focal length along the row", above=0.0)
    fy: float = quantity("px", "focal length along the column", above=0.0)
    cx: float = quantity("px", "principal point, column")
    cy: float = quantity("px", "principal point, row")
    d: tuple[float, float, float, float, float] = quantity(
        "-", "plumb_bob k1 k2 p1 p2 k3", default=(0.0, 0.0, 0.0, 0.0, 0.0)
    )


def distort(xy: Array, d: tuple[float, ...]) -> Array:
    """Map ideal normalised coordinates (..., 2) to distorted ones by plumb_bob (k1 k2 p1 p2 k3)."""
    k1, k2, p1, p2, k3 = d
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(xy: Array, d: tuple[float, ...]) -> Array:
    """Invert `distort` by Newton's method, (..., 2) -> (..., 2), to `UNDISTORTION_TOLERANCE`.

    Raises ValueError where the lens model cannot be inverted (it folds back within the image).
    """
    if not any(d):
        return xy.copy()
    k1, k2, p1, p2, k3 = d
    solution = xy.copy()
    for _ in range(50):
        x, y = solution[..., 0], solution[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
        a = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        b = slope * x * y + 2 * p1 * x + 2 * p2 * y
        c = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        determinant = a * c - b * b
        if not np.all(determinant > 0):
            break
        error = distort(solution, d) - xy
        if np.abs(error).max() < UNDISTORTION_TOLERANCE / 10:
            return solution
        step_x = (c * error[..., 0] - b * error[..., 1]) / determinant
        step_y = (a * error[..., 1] - b * error[..., 0]) / determinant
        solution = solution - np.stack([step_x, step_y], axis=-1)
    raise ValueError("optics.d: the lens model folds back within the image and cannot be inverted")


def pixel_rays(optics: Optics, *, width: int, height: int) -> Array:
    """Return the unit rays (height, width, 3) of all pixel centres in the optical frame.

    Raises ValueError where the distortion cannot be inverted.
    """
    column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    return rays_through(optics, np.stack([column, row], axis=-1))


def rays_through(optics: Optics, pixels: Array) -> Array:
    """Return the unit rays (..., 3) through image points (..., 2) given as (column, row)."""
    distorted = np.stack(
        [(pixels[..., 0] - optics.cx) / optics.fx, (pixels[..., 1] - optics.cy) / optics.fy], axis=-1
    )
    ideal = undistort(distorted, optics.d)
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def project(optics: Optics, points: Array) -> Array:
    """Return the image points (..., 2) as (column, row) of object points (..., 3) before the camera.

    Points behind the camera (z <= 0) give NaN.
    """
    z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    distorted = distort(points[..., :2] / z, optics.d)
    return distorted * (optics.fx, optics.fy) + (optics.cx, optics.cy)
