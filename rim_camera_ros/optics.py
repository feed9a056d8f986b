"""Camera geometry: pixels <-> unit rays of a distorted lens (ROS ``plumb_bob``).

Source: Brown (1971) as used by Kahlmann 2007, sec. 3.2, in the parametrisation of ROS and OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity

Array = NDArray[np.float64]

#: Largest error of the undistortion in normalised image coordinates.
UNDISTORTION_TOLERANCE = 1e-9
#: Steps from the principal point to a point at which a fold of the lens model is looked for.
_STEPS = 16
#: Number of squared radii at which it is checked whether there is any fold.
_SAMPLES = 400
#: Iterations of Newton's method, which converges in five away from folds, and halvings of one of its steps.
_ITERATIONS, _HALVINGS = 60, 12


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
    for _ in range(_HALVINGS):  # the centre lies before every fold
        beyond = ~(_jacobian(solution, d)[3] > 0)
        if not beyond.any():
            break
        solution[beyond] /= 2
    left = np.arange(len(target))
    for _ in range(_ITERATIONS):
        here, wanted = solution[left], target[left]
        error = distort(here, d) - wanted
        open_ = np.abs(error).max(axis=-1) >= UNDISTORTION_TOLERANCE / 10
        if not open_.any():
            left = left[:0]
            break
        left, here, error = left[open_], here[open_], error[open_]
        a, b, c, determinant = _jacobian(here, d)
        step = np.stack([c * error[:, 0] - b * error[:, 1], a * error[:, 1] - b * error[:, 0]], axis=-1)
        step /= determinant[:, None]
        crossing = np.arange(len(left))
        for _ in range(_HALVINGS):
            crossing = crossing[~(_jacobian(here[crossing] - step[crossing], d)[3] > 0)]
            if not crossing.size:
                break
            step[crossing] /= 2
        solution[left] = here - step
        # if even the shortest step crosses the fold there is no solution
        solution[left[crossing]] = np.nan
        left = np.delete(left, crossing)
    solution[left] = np.nan
    if not _has_no_fold(d, radius=float(np.sqrt(np.nanmax((solution**2).sum(axis=-1), initial=0.0)))):
        # a solution behind a fold is invalid: the image must not fold back on the way from the centre
        for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
            a, _, c, determinant = _jacobian(share * solution, d)
            solution[~((determinant > 0) & (a + c > 0))] = np.nan
    return solution.reshape(xy.shape)


def _jacobian(xy: Array, d: tuple[float, ...]) -> tuple[Array, Array, Array, Array]:
    """Return the Jacobian [[a, b], [b, c]] of `distort` with its determinant."""
    k1, k2, p1, p2, k3 = d
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    a = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    b = slope * x * y + 2 * p1 * x + 2 * p2 * y
    c = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return a, b, c, a * c - b * b


def _has_no_fold(d: tuple[float, ...], *, radius: float) -> bool:
    """Whether the Jacobian of `distort` is positive definite within a radius, by a sufficient condition.

    Its radial part has the eigenvalues f = 1 + k1 r^2 + k2 r^4 + k3 r^6 and (r f)'; those of the tangential
    part are at most 6 (|p1| + |p2|) r.
    """
    k1, k2, p1, p2, k3 = d
    squares = np.linspace(0.0, radius**2, _SAMPLES)
    least = np.inf
    for f1, f2, f3 in ((k1, k2, k3), (3 * k1, 5 * k2, 7 * k3)):
        eigenvalue = 1 + squares * (f1 + squares * (f2 + squares * f3))
        # between samples the value is lower by at most half a step times the steepest slope
        slope = abs(f1) + squares[-1] * (2 * abs(f2) + 3 * squares[-1] * abs(f3))
        least = min(least, eigenvalue.min() - slope * squares[1] / 2)
    return bool(least > 6 * (abs(p1) + abs(p2)) * radius)


@lru_cache(maxsize=20)
def pixel_rays(optics: Optics, *, width: int, height: int) -> Array:
    """Return the unit rays (height, width, 3) of all pixel centres in the optical frame, read-only.

    They are cached, as fits request those of the same few optics again and again.
    NaN where the distortion cannot be inverted; such pixels see nothing. Raises ValueError if these are more
    than half of the pixels.
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


@lru_cache(maxsize=20)
def rays_beyond(
    optics: Optics, *, width: int, height: int, step: float, widest: float
) -> tuple[Array, Array]:
    """Return unit rays (N, 3) outside of all pixels, and their solid angles (N,) [sr], read-only.

    They are ``step`` [rad] apart, up to ``widest`` [rad] from the optical axis (azimuthal equidistant).
    """
    places = np.arange(-np.ceil(widest / step), np.ceil(widest / step) + 1) * step
    across, down = (axis.ravel() for axis in np.meshgrid(places, places))
    angle = np.hypot(across, down)
    sine = np.sinc(angle / np.pi)
    rays = np.stack([across * sine, down * sine, np.cos(angle)], axis=-1)
    solid = step**2 * sine
    array = pixel_rays(optics, width=width, height=height)
    # outside the array a lens model may fold back: it is not used where no pixel looks
    farthest = np.arccos(np.clip(np.nanmin(array[..., 2]), -1.0, 1.0))
    pixels = project(optics, rays[angle <= farthest])
    low, high = -0.5, np.array([width, height]) - 0.5
    seen = angle <= farthest
    seen[seen] = np.all((pixels >= low) & (pixels <= high), axis=-1)
    kept = ~seen & (angle <= widest)
    rays, solid = rays[kept], solid[kept]
    rays.flags.writeable = solid.flags.writeable = False
    return rays, solid


def ray_derivatives(optics: Optics, rays: Array, paths: Sequence[str]) -> list[Array]:
    """Return the derivatives (..., 3) of unit rays (..., 3) of fixed pixels by numbers of the optics.

    ``paths`` name them: ``fx``, ``fy``, ``cx``, ``cy`` (per px), ``d.0`` to ``d.4``. The equation of a ray,
    distort(x, y; d) = ((column - cx) / fx, (row - cy) / fy), is differentiated implicitly.
    """
    xy = rays[..., :2] / rays[..., 2:]
    x, y = xy[..., 0], xy[..., 1]
    distorted = distort(xy, optics.d)
    r2, zero = x * x + y * y, np.zeros_like(x)
    right_side = {
        "fx": (-distorted[..., 0] / optics.fx, zero),
        "fy": (zero, -distorted[..., 1] / optics.fy),
        "cx": (np.full_like(x, -1 / optics.fx), zero),
        "cy": (zero, np.full_like(x, -1 / optics.fy)),
        "d.0": (-x * r2, -y * r2),
        "d.1": (-x * r2**2, -y * r2**2),
        "d.2": (-2 * x * y, -(r2 + 2 * y * y)),
        "d.3": (-(r2 + 2 * x * x), -2 * x * y),
        "d.4": (-x * r2**3, -y * r2**3),
    }
    a, b, c, determinant = _jacobian(xy, optics.d)
    result = []
    for path in paths:
        along_x, along_y = right_side[path]
        change = np.stack([c * along_x - b * along_y, a * along_y - b * along_x, zero], axis=-1)
        change *= (rays[..., 2] / determinant)[..., None]
        result.append(change - rays * (rays * change).sum(axis=-1, keepdims=True))
    return result


def project(optics: Optics, points: Array) -> Array:
    """Return the image points (..., 2) as (column, row) of object points (..., 3) before the camera.

    Points behind the camera (z <= 0) give NaN.
    """
    z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    distorted = distort(points[..., :2] / z, optics.d)
    return distorted * (optics.fx, optics.fy) + (optics.cx, optics.cy)
