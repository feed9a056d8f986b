"""Mixed pixels: those whose distance lies between two surfaces (Kahlmann 2007, sec. 3.3.10)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: A step counts from this many metres ...
LEAST_STEP = 0.05
#: ... and from this many standard deviations of one distance.
LEAST_SIGMAS = 6.0
#: The pixel must keep this share of the step from both of its sides.
LEAST_SHARE = 0.15


def mixed_pixels(distance: NDArray[Any], sigma: NDArray[Any] | float = 0.0) -> NDArray[np.bool_]:
    """Return (H, W) bool: pixels between two surfaces along their row or their column.

    A pixel is mixed if the pixels two before and two behind it differ by a step that neither side's
    own slope explains, while the pixel itself lies between them, off both. So up to three mixed pixels
    in a row are found; surfaces narrower than two pixels are not told from mixed ones. ``distance`` [m]
    with NaN where invalid; ``sigma`` [m] of one distance.
    """
    result = np.zeros(distance.shape, bool)
    width = distance.shape[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        least = np.maximum(np.float32(LEAST_STEP), np.float32(LEAST_SIGMAS) * sigma)
        flat = np.ascontiguousarray(distance).ravel()
        limit = np.broadcast_to(least, distance.shape).ravel()
        step = np.empty_like(flat)
        for stride in (1, width):
            if flat.size <= 6 * stride:
                continue
            reach = 2 * stride
            np.subtract(flat[2 * reach :], flat[: -2 * reach], out=step[reach:-reach])
            np.abs(step[reach:-reach], out=step[reach:-reach])
            inner = slice(3 * stride, flat.size - 3 * stride)
            at = np.flatnonzero(step[inner] > limit[inner]) + 3 * stride
            if stride == 1:
                place = at % width
                at = at[(place >= 3) & (place < width - 3)]
            _mark(flat, limit, result.ravel(), at, stride)
    return result


def _mark(
    d: NDArray[Any], limit: NDArray[Any], marked: NDArray[np.bool_], at: NDArray[np.intp], stride: int
) -> None:
    """Mark those of the candidate pixels ``at`` that are mixed along one axis."""
    low, high = d[at - 2 * stride], d[at + 2 * stride]
    step = high - low
    share = (d[at] - low) / step
    between = (share > LEAST_SHARE) & (share < 1 - LEAST_SHARE)
    at, low, high, step = at[between], low[between], high[between], step[between]
    slope = np.abs(low - d[at - 3 * stride]) + np.abs(d[at + 3 * stride] - high)
    marked[at[np.abs(step) - 4 * slope > limit[at]]] = True
