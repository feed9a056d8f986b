"""How much of a square pixel lies beyond a straight, blurred edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

#: Edges sharper than this (Gaussian, px) and directions nearer to the pixel's sides are not told apart.
_SHARPEST = 0.02
_LEAST_SLOPE = 1e-3


def edge_coverage(depth: Array, normal_u: Array, normal_v: Array, blur: Array) -> Array:
    """Return the covered share 0..1 of square pixels of 1 px whose centres lie ``depth`` px beyond an edge.

    ``normal_u``, ``normal_v``: the edge's unit normal; ``blur``: sigma in px of the optics' Gaussian blur, in
    addition to the pixel's square. All broadcast against each other. Exact: the step convolved with the
    Gaussian and with the square's projection, which is the convolution of two boxes as wide as the normal's
    components. A Gaussian of the square's variance instead shifts an edge along a row of pixels by up to
    0.05 px.
    """
    sigma = np.hypot(blur, _SHARPEST)
    wide = np.maximum(np.abs(normal_u), _LEAST_SLOPE)
    high = np.maximum(np.abs(normal_v), _LEAST_SLOPE)
    outer, inner = (wide + high) / 2, (wide - high) / 2
    total = _ramp(depth + outer, sigma) - _ramp(depth + inner, sigma)
    total += _ramp(depth - outer, sigma) - _ramp(depth - inner, sigma)
    result: Array = total / (wide * high)
    return result


def _ramp(t: Array, sigma: Array) -> Array:
    """Second antiderivative of the Gaussian distribution function."""
    s = t / sigma
    density = np.exp(-0.5 * s * s) / np.sqrt(2 * np.pi)
    result: Array = 0.5 * ((t * t + sigma * sigma) * ndtr(s) + t * sigma * density)
    return result
