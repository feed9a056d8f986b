"""Camera geometry: pixels <-> unit rays of a distorted lens (ROS ``plumb_bob``).

Source: Brown (1971) as used by Kahlmann 2007, sec. 3.2, in the parametrisation of ROS and OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity

Array = NDArray[np.float64]

#: Largest error of the undistortion in normalised image coordinates.
UNDISTORTION_TOLERANCE = 1e-9
#: Steps from the principal point to a point in which a fold of the lens model is looked for.
_STEPS = 16


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

    NaN where the lens model has no inverse: a polynomial fitted near the centre may fold back before it
    reaches the corners. Steps that would cross the fold are halved.
    """
    if not any(d):
        return xy.copy()
    target = xy.reshape(-1, 2)
    solution = target.copy()
    error, jacobian = _error(solution, target, d)
    open_ = np.arange(len(target))
    for _ in range(60):
        left = np.abs(error).max(axis=-1) >= UNDISTORTION_TOLERANCE / 10
        open_, error, jacobian = open_[left], error[left], tuple(one[left] for one in jacobian)
        if not open_.size:
            break
        a, b, c, determinant = jacobian
        step = np.stack(
            [
                (c * error[:, 0] - b * error[:, 1]) / determinant,
                (a * error[:, 1] - b * error[:, 0]) / determinant,
            ],
            axis=-1,
        )
        share = np.ones(len(open_))
        for _ in range(12):
            trial = solution[open_] - share[:, None] * step
            crossed = ~(_error(trial, target[open_], d)[1][3] > 0)
            if not crossed.any():
                break
            share[crossed] /= 2
        solution[open_] = trial
        error, jacobian = _error(trial, target[open_], d)
    solution[open_] = np.nan
    # a solution behind a fold is none: the image must not turn back anywhere on the way from the centre
    for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
        a, _, c, determinant = _error(share * solution, target, d)[1]
        solution[~((determinant > 0) & (a + c > 0))] = np.nan
    return solution.reshape(xy.shape)


def _error(xy: Array, target: Array, d: tuple[float, ...]) -> tuple[Array, tuple[Array, ...]]:
    """Return distort(xy) - target and the Jacobian [[a, b], [b, c]] with its determinant."""
    k1, k2, p1, p2, k3 = d
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    a = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    b = slope * x * y + 2 * p1 * x + 2 * p2 * y
    c = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return distort(xy, d) - target, (a, b, c, a * c - b * b)


@lru_cache(maxsize=20)
def pixel_rays(optics: Optics, *, width: int, height: int) -> Array:
    """Return the unit rays (height, width, 3) of all pixel centres in the optical frame, read-only.

    They are kept, as fits ask for those of the same few optics again and again.
    NaN where the distortion cannot be inverted; such pixels see nothing. Raises ValueError where that
    is more than half of them.
    """
    column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = rays_through(optics, np.stack([column, row], axis=-1))
    if np.isnan(rays[..., 0]).mean() > 0.5:
        raise ValueError("optics.d: the lens model folds back within the image and cannot be inverted")
    rays.setflags(write=False)
    return rays


def rays_through(optics: Optics, pixels: Array) -> Array:
    """Return the unit rays (..., 3) through image points (..., 2) given as (column, row)."""
    distorted = np.stack(
        [(pixels[..., 0] - optics.cx) / optics.fx, (pixels[..., 1] - optics.cy) / optics.fy], axis=-1
    )
    ideal = undistort(distorted, optics.d)
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
    result: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return result


def project(optics: Optics, points: Array) -> Array:
    """Return the image points (..., 2) as (column, row) of object points (..., 3) before the camera.

    Points behind the camera (z <= 0) give NaN.
    """
    z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    distorted = distort(points[..., :2] / z, optics.d)
    return distorted * (optics.fx, optics.fy) + (optics.cx, optics.cy)
