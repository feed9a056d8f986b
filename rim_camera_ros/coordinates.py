"""Coordinates from one distance, with their precision: Kahlmann 2007, eqs. 2.14-2.19.

These functions follow the thesis: the origin lies on the sensor and the distance counts from the pixel
(eq. 2.17). Clouds of this package have their origin in the projection centre (see `cloud`). The two differ
by up to the camera constant, a difference that the fixed pattern absorbs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def object_coordinates(*, x_s: float, y_s: float, camera_constant: float, distance: float) -> Array:
    """Return X, Y, Z in metres of the object point of one pixel (eq. 2.17).

    ``x_s``, ``y_s`` (sensor coordinates), ``camera_constant`` and ``distance`` in metres.
    """
    pixel = np.array([x_s, y_s, 0.0])
    direction = np.array([-x_s, -y_s, camera_constant])
    result: Array = pixel + distance * direction / np.linalg.norm(direction)
    return result


def coordinate_derivatives(*, x_s: float, y_s: float, camera_constant: float, distance: float) -> Array:
    """Return F = dX / dL (3, 4) of eq. 2.19 for L = (x_s, y_s, distance, camera constant).

    The thesis differentiates numerically; this is the closed form.
    """
    k = np.array([-x_s, -y_s, camera_constant])
    norm = float(np.linalg.norm(k))
    unit = k / norm
    # d(k / |k|) / dk = (1 - unit unit^T) / |k|
    by_k = distance * (np.eye(3) - np.outer(unit, unit)) / norm
    result = np.empty((3, 4))
    result[:, 0] = np.array([1.0, 0.0, 0.0]) - by_k[:, 0]
    result[:, 1] = np.array([0.0, 1.0, 0.0]) - by_k[:, 1]
    result[:, 2] = unit
    result[:, 3] = by_k[:, 2]
    return result


def coordinate_precision(
    *,
    x_s: float,
    y_s: float,
    camera_constant: float,
    distance: float,
    sigma_x_s: float,
    sigma_y_s: float,
    sigma_distance: float,
    sigma_camera_constant: float,
) -> Array:
    """Return the 1-sigma of X, Y, Z in metres by error propagation (eq. 2.18, no correlations).

    All arguments in metres. Reproduces table 2.4, in which c = 8 and 12 mm and s_f = 0.05 mm (the
    printed headings "0.008 mm", "0.012 mm" are misprints).
    """
    f = coordinate_derivatives(x_s=x_s, y_s=y_s, camera_constant=camera_constant, distance=distance)
    variances = np.square([sigma_x_s, sigma_y_s, sigma_distance, sigma_camera_constant])
    result: Array = np.sqrt(np.diag(f @ np.diag(variances) @ f.T))
    return result
