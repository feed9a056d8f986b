"""Projection into the image with its derivatives, and the images of circles.

The model is that of `rim_camera_ros.optics` (Brown 1971 as plumb_bob), whose projection is used. The
derivatives are computed here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.optics import Optics, project

Array = NDArray[np.float64]

#: The optics' parameters in the order of the derivatives, with their paths in a camera file.
OPTICS_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
OPTICS_PATHS = tuple(f"optics.{name}" for name in ("fx", "fy", "cx", "cy", "d.0", "d.1", "d.2", "d.3", "d.4"))
#: Points on the edge of a circle to which its image's ellipse is fitted.
_EDGE_POINTS = 32


def optics_vector(optics: Optics) -> Array:
    """Return the nine parameters of `OPTICS_PARAMETERS`."""
    return np.array([optics.fx, optics.fy, optics.cx, optics.cy, *optics.d])


def optics_of(vector: Array) -> Optics:
    """Return the optics with the nine parameters of `OPTICS_PARAMETERS`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(one) for one in vector)
    return Optics(fx=fx, fy=fy, cx=cx, cy=cy, d=(k1, k2, p1, p2, k3))


def projection_derivatives(optics: Optics, points: Array) -> tuple[Array, Array]:
    """Return the derivatives of the image points of object points (n, 3) [m] in the optical frame.

    The first, (n, 2, 9), are by the optics' parameters in the order of `OPTICS_PARAMETERS`, the second,
    (n, 2, 3) [px/m], by the points.
    """
    k1, k2, p1, p2, k3 = optics.d
    z = points[:, 2]
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    zero, one = np.zeros_like(x), np.ones_like(x)
    by_coefficient_x = [x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3]
    by_coefficient_y = [y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3]
    by_optics = np.stack(
        [
            np.stack([distorted_x, zero, one, zero, *(optics.fx * c for c in by_coefficient_x)], axis=-1),
            np.stack([zero, distorted_y, zero, one, *(optics.fy * c for c in by_coefficient_y)], axis=-1),
        ],
        axis=1,
    )
    # the distortion's Jacobian is symmetric: [[a, b], [b, c]]
    a = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    b = slope * x * y + 2 * p1 * x + 2 * p2 * y
    c = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    by_point = np.stack(
        [
            np.stack([a, b, -(a * x + b * y)], axis=-1) * (optics.fx / z)[:, None],
            np.stack([b, c, -(b * x + c * y)], axis=-1) * (optics.fy / z)[:, None],
        ],
        axis=1,
    )
    return by_optics, by_point


def ellipse_centre_offset(optics: Optics, centres: Array, normals: Array, radii: Array) -> Array:
    """Return (n, 2) px: the centre of the image of a circle less the image of the circle's centre.

    ``centres`` (n, 3) m and ``normals`` (n, 3) in the optical frame, ``radii`` (n,) m. Kahlmann 2007,
    sec. 3.2.2, leaves this shift uncorrected. The result is exact without distortion; with distortion the
    centre is that of the ellipse that fits the circle's edge best. NaN for a circle that reaches behind the
    camera.
    """
    angles = 2 * np.pi * np.arange(_EDGE_POINTS) / _EDGE_POINTS
    helper = np.where(np.abs(normals[:, :1]) < 0.6 * np.linalg.norm(normals, axis=1)[:, None], 1.0, 0.0)
    helper = np.concatenate([helper, 1 - helper, np.zeros_like(helper)], axis=1)
    first = np.cross(normals, helper)
    second = np.cross(normals, first)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    edge = (
        centres[:, None]
        + radii[:, None, None] * np.cos(angles)[None, :, None] * first[:, None]
        + radii[:, None, None] * np.sin(angles)[None, :, None] * second[:, None]
    )
    image = project(optics, edge)
    middle = image.mean(axis=1)
    size = np.maximum(np.sqrt(((image - middle[:, None]) ** 2).mean(axis=(1, 2))), 1e-12)
    x, y = np.moveaxis((image - middle[:, None]) / size[:, None, None], -1, 0)
    # A x^2 + B x y + C y^2 + D x + E y = 1 by least squares; its centre is where the gradient vanishes
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    whole = np.isfinite(design).all(axis=(1, 2)) & (radii > 0)
    normal = np.einsum("nij,nik->njk", design[whole], design[whole])
    right = design[whole].sum(axis=1)
    a, b, c, d, e = np.linalg.solve(normal, right[..., None])[..., 0].T
    determinant = 4 * a * c - b * b
    centre = np.stack([(b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant], axis=-1)
    result = np.full((len(centres), 2), np.nan)
    result[whole] = middle[whole] + size[whole, None] * centre - project(optics, centres[whole])
    result[np.asarray(radii) == 0] = 0.0
    return result
