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

    A pixel is mixed if the pixels two before and two behind it differ by a step that the slope of neither
    side explains, and its own distance lies between theirs and apart from both. This finds up to three mixed
    pixels in a row. Surfaces narrower than two pixels are not distinguishable from mixed pixels.
    ``distance`` [m] with NaN where invalid; ``sigma`` [m] of one distance.
    """
    result = np.zeros(distance.shape, bool)
    width = distance.shape[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = np.ascontiguousarray(distance).ravel()
        number = flat.dtype.type
        noise = np.broadcast_to(sigma, distance.shape).ravel()
        for stride in (1, width):
            # three pixels before and behind along this axis
            margin = 3 * stride
            if flat.size <= 2 * margin:
                continue
            size = flat.size - 2 * margin
            before, behind = flat[stride:], flat[5 * stride :]
            slope = flat[stride:] - flat[:-stride]
            np.abs(slope, out=slope)
            excess = behind[:size] - before[:size]
            np.abs(excess, out=excess)
            slopes = slope[:size] + slope[-size:]
            slopes *= number(4.0)
            excess -= slopes
            found = np.flatnonzero(excess > number(LEAST_STEP))
            at = found + margin
            at = at[np.take(excess, found) > LEAST_SIGMAS * np.take(noise, at)]
            if stride == 1:
                place = at % width
                at = at[(place >= 3) & (place < width - 3)]
            low = flat[at - 2 * stride]
            share = (flat[at] - low) / (flat[at + 2 * stride] - low)
            result.ravel()[at[(share > LEAST_SHARE) & (share < 1 - LEAST_SHARE)]] = True
    return result
