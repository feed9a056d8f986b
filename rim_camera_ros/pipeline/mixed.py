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
#: Pixels whose neighbours differ by less than this share of a step are not looked at.
_CANDIDATE = 0.3


def mixed_pixels(distance: NDArray[Any], sigma: NDArray[Any] | float = 0.0) -> NDArray[np.bool_]:
    """Return (H, W) bool: pixels between two surfaces along their row or their column.

    A pixel is mixed if the pixels two before and two behind it differ by a step that neither side's
    own slope explains, while the pixel itself lies between them, off both. ``distance`` [m] with NaN where invalid;
    ``sigma`` [m] of one distance.
    """
    result = np.zeros(distance.shape, bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        least = np.maximum(np.float32(LEAST_STEP), np.float32(LEAST_SIGMAS) * sigma)
        flat = np.ascontiguousarray(distance).ravel()
        limit = np.broadcast_to(least, distance.shape).ravel()
        height, width = distance.shape
        if width >= 5:
            near = np.abs(distance[:, 2:] - distance[:, :-2]) > _CANDIDATE * _part(least, 1)
            row, column = np.nonzero(near)
            _mark(flat, limit, result, row * width + column + 1, column + 1, width, 1)
        if height >= 5:
            near = np.abs(distance[2:] - distance[:-2]) > _CANDIDATE * _part(least, 0)
            row, column = np.nonzero(near)
            _mark(flat, limit, result, (row + 1) * width + column, row + 1, height, width)
    return result


def _part(least: Any, axis: int) -> Any:
    """The limits at the pixels that have neighbours on both sides along an axis."""
    if np.ndim(least) == 0:
        return least
    return least[:, 1:-1] if axis else least[1:-1]


def _mark(
    d: NDArray[Any],
    limit: NDArray[Any],
    result: NDArray[np.bool_],
    pixel: NDArray[np.intp],
    place: NDArray[np.intp],
    length: int,
    stride: int,
) -> None:
    """Mark candidates ``pixel`` that are mixed along one axis; ``place`` is their coordinate along it."""
    marked = result.ravel()
    for before, behind in ((1, 1), (2, 1), (1, 2)):
        fits = (place - before - 1 >= 0) & (place + behind + 1 < length)
        at = pixel[fits]
        low, high = d[at - before * stride], d[at + behind * stride]
        step = high - low
        slope = np.abs(low - d[at - (before + 1) * stride]) + np.abs(d[at + (behind + 1) * stride] - high)
        share = (d[at] - low) / step
        found = (np.abs(step) - 2 * slope > limit[at]) & (share > LEAST_SHARE) & (share < 1 - LEAST_SHARE)
        marked[at[found]] = True
