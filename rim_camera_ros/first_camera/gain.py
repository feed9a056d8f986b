"""The gain from a surface of known reflectivity.

amplitude = gain * integration_time * reflectivity * cos(incidence) / distance^2
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError

#: Reflectivity that is assumed where none is stated, and its relative 1-sigma.
ASSUMED, ASSUMED_SIGMA = 0.5, 0.5
#: Side of the region in the middle of the image where none is stated, as a share of it.
_MIDDLE = 0.2
_LEAST_PIXELS = 20


@dataclass(frozen=True)
class Gain:
    """The gain with its relative 1-sigma, and the surface behind it: distance [m], angle [rad], pixels."""

    value: float
    relative_sigma: float
    distance: float
    angle: float
    pixels: int


def gain_of(
    distance: NDArray[Any],
    amplitude: NDArray[Any],
    rays: NDArray[np.float64],
    *,
    integration_time: float,
    reflectivity: float,
    reflectivity_sigma: float,
    region: tuple[int, int, int, int] | None,
) -> Gain:
    """Return the gain by a plane surface in a region (u0, v0, u1, v1; inclusive) of mean images.

    ``distance`` in metres, ``amplitude`` in counts (both (H, W), 0 where there is none), ``rays`` (H, W, 3)
    unit vectors, ``reflectivity_sigma`` relative. Raises `InputError` for a region without measurements.
    """
    height, width = distance.shape
    if region is None:
        du, dv = max(2, round(width * _MIDDLE / 2)), max(2, round(height * _MIDDLE / 2))
        region = (width // 2 - du, height // 2 - dv, width // 2 + du, height // 2 + dv)
        middle = distance[region[1] : region[3] + 1, region[0] : region[2] + 1]
        if (middle > 0).sum() < _LEAST_PIXELS:  # surfaces are elsewhere in the image
            region = (0, 0, width - 1, height - 1)
    u0, v0, u1, v1 = region
    if not (0 <= u0 <= u1 < width and 0 <= v0 <= v1 < height):
        raise InputError(
            f"{u0} {v0} {u1} {v1} does not lie within {width} x {height} pixels",
            place="--region",
            remedy="u0 v0 u1 v1, columns and rows from 0, inclusive",
        )
    window = (slice(v0, v1 + 1), slice(u0, u1 + 1))
    d, a, ray = distance[window], amplitude[window], rays[window]
    good = (d > 0) & (a > 0) & np.isfinite(ray).all(axis=-1)
    if good.sum() < _LEAST_PIXELS:
        raise InputError(
            f"{int(good.sum())} pixels with a measurement in {u0} {v0} {u1} {v1}",
            place="--region",
            remedy="give a region on the surface of known reflectivity",
        )
    points = ray[good] * d[good][:, None]
    centre = np.median(points, axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    cosine = np.abs(ray[good] @ normal)
    values = a[good] * d[good] ** 2 / (integration_time * reflectivity * np.maximum(cosine, 0.05))
    value = float(np.median(values))
    scatter = float(np.median(np.abs(values / value - 1))) * 1.4826
    return Gain(
        value=value,
        relative_sigma=float(np.hypot(reflectivity_sigma, scatter)),
        distance=float(np.median(d[good])),
        angle=float(np.arccos(np.clip(np.median(cosine), 0.0, 1.0))),
        pixels=int(good.sum()),
    )
