"""Covariates: the quantities on which a distance error may depend, by the names of the report.

Each is a scalar per frame or an image (H, W); None where the recording does not state it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rim_camera_ros.effects.signal import Context

Image = NDArray[Any]

#: Distance steps above this many metres are edges.
EDGE_STEP = 0.05

#: Name -> unit.
COVARIATES = {
    "distance": "m",
    "amplitude": "counts",
    "row": "px",
    "column": "px",
    "incidence": "rad",
    "time": "s",
    "uptime": "s",
    "temperature": "degC",
    "ambient_temperature": "degC",
    "integration_time": "device unit",
    "row_amplitude": "counts",
    "column_amplitude": "counts",
    "contrast": "-",
    "height": "m",
    "edge": "px",
    "saturation": "px",
}

#: Covariates that are one number per frame.
SCALAR = frozenset({"time", "uptime", "temperature", "ambient_temperature", "integration_time"})


#: Covariates of a pixel that do not depend on its neighbours and its place on the grid.
POINTWISE = frozenset(COVARIATES) - {
    "row", "column", "row_amplitude", "column_amplitude", "contrast", "edge", "saturation"
}  # fmt: skip

#: Angle from the optical axis [rad]: no covariate of a term; reports draw effects that depend on it alone.
AXIS = "axis_angle"


def resampled_knots(factor: float, name: str, knots: tuple[float, ...]) -> tuple[float, ...]:
    """Return knots over a covariate for ``factor`` times as many pixels along each axis."""
    if name in ("row", "column"):
        # the coarser grid has every step-th pixel, from pixel step // 2 on
        first = round(max(factor, 1 / factor)) // 2
        return tuple(knot * factor + first if factor > 1 else (knot - first) * factor for knot in knots)
    if name in ("edge", "saturation"):
        return tuple(knot * factor for knot in knots)
    return knots


def covariate(name: str, distance: Image, amplitude: Image, context: Context) -> Image | float | None:
    """Return a covariate of one frame, shape (H, W) or scalar; None where it is not known.

    ``distance`` [m] and ``amplitude`` [counts] of the same frame. ``incidence`` is in rad, as all
    covariates are in SI units or pixels and counts. Raises KeyError for an unknown name.
    """
    shape = distance.shape
    match name:
        case "distance":
            return distance
        case "amplitude":
            return amplitude
        case "row":
            return np.broadcast_to(context.row, shape)
        case "column":
            return np.broadcast_to(context.column, shape)
        case "incidence":
            return context.incidence
        case "time":
            return context.time
        case "uptime":
            return context.settings.uptime
        case "temperature":
            return context.settings.body_temperature
        case "ambient_temperature":
            return context.settings.ambient_temperature
        case "integration_time":
            return context.integration_time
        case "row_amplitude":
            return np.broadcast_to(amplitude.mean(axis=1, keepdims=True), shape)
        case "column_amplitude":
            return np.broadcast_to(amplitude.mean(axis=0, keepdims=True), shape)
        case "contrast":
            return _contrast(amplitude)
        case "height":
            height: Image = -distance * context.rays[..., 1]
            return height
        case "edge":
            return _edge_distance(distance)
        case "saturation":
            if context.saturated is None:
                return np.zeros(shape)
            saturated = context.saturated.astype(float)
            total: Image = saturated.sum(axis=1, keepdims=True) + saturated.sum(axis=0, keepdims=True)
            return total
    raise KeyError(name)


def _contrast(amplitude: Image) -> Image:
    values = np.ascontiguousarray(amplitude, dtype=np.float64)
    mean = cv2.blur(values, (5, 5), borderType=cv2.BORDER_REPLICATE)
    square = cv2.blur(values * values, (5, 5), borderType=cv2.BORDER_REPLICATE)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0.0))
    return np.divide(deviation, mean, out=np.zeros_like(mean), where=mean > 0)


def _edge_distance(distance: Image) -> Image:
    """Pixels to the nearest step above `EDGE_STEP` between 4-neighbours; the diagonal where there is none."""
    edge = np.zeros(distance.shape, np.uint8)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            step = np.abs(np.diff(distance, axis=axis)) > EDGE_STEP
            if axis == 0:
                edge[:-1][step] = 1
                edge[1:][step] = 1
            else:
                edge[:, :-1][step] = 1
                edge[:, 1:][step] = 1
    if not edge.any():
        return np.full(distance.shape, float(np.hypot(*distance.shape)))
    return cv2.distanceTransform(1 - edge, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
