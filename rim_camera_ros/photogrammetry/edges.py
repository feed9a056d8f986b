"""How much of a square pixel lies beyond a straight, blurred edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

#: Sigma [px] that is added in quadrature to the blur, and least component of the normal that is used.
_SHARPEST = 0.02
_LEAST_SLOPE = 1e-3


@dataclass(frozen=True)
class Coverage:
    """The ``covered`` share of pixels, and its derivatives.

    ``by_depth`` [1/px], ``by_normal_u`` and ``by_normal_v``, the components of the edge's normal as if they
    were independent, and ``by_blur`` [1/px].
    """

    covered: Array
    by_depth: Array
    by_normal_u: Array
    by_normal_v: Array
    by_blur: Array


def edge_coverage(depth: Array, normal_u: Array, normal_v: Array, blur: Array) -> Array:
    """Return the covered share 0..1 of square pixels of 1 px whose centres lie ``depth`` px beyond an edge.

    ``normal_u``, ``normal_v``: the edge's unit normal; ``blur``: sigma in px of the optics' Gaussian blur, in
    addition to the pixel's square. All broadcast against each other. Exact: the step convolved with the
    Gaussian and with the square's projection, which is the convolution of two boxes as wide as the normal's
    components. A Gaussian of the square's variance instead shifts an edge along a row of pixels by up to
    0.05 px.
    """
    sigma = np.hypot(blur, _SHARPEST)
    wide, high, outer, inner = _sides(normal_u, normal_v)
    total = _ramp(depth + outer, sigma) - _ramp(depth + inner, sigma)
    total += _ramp(depth - outer, sigma) - _ramp(depth - inner, sigma)
    result: Array = total / (wide * high)
    return result


def edge_coverage_slopes(depth: Array, normal_u: Array, normal_v: Array, blur: Array) -> Coverage:
    """Return the coverage as `edge_coverage` does, with its derivatives."""
    sigma = np.hypot(blur, _SHARPEST)
    wide, high, outer, inner = _sides(normal_u, normal_v)
    area = wide * high
    ramps, rises, shares = zip(
        *(_antiderivatives(depth + side, sigma) for side in (outer, inner, -outer, -inner)), strict=True
    )
    covered = (ramps[0] - ramps[1] + ramps[2] - ramps[3]) / area
    by_wide = (rises[0] - rises[1] - rises[2] + rises[3]) / 2 / area - covered / wide
    by_high = (rises[0] + rises[1] - rises[2] - rises[3]) / 2 / area - covered / high
    # of the hypot above, and of sigma in the ramps: sigma times the share
    by_blur = (shares[0] - shares[1] + shares[2] - shares[3]) * blur / area
    return Coverage(
        covered,
        (rises[0] - rises[1] + rises[2] - rises[3]) / area,
        np.where(np.abs(normal_u) > _LEAST_SLOPE, np.sign(normal_u), 0.0) * by_wide,
        np.where(np.abs(normal_v) > _LEAST_SLOPE, np.sign(normal_v), 0.0) * by_high,
        by_blur,
    )


def _sides(normal_u: Array, normal_v: Array) -> tuple[Array, Array, Array, Array]:
    """Return the projections of a pixel's sides, and half their sum and difference."""
    wide = np.maximum(np.abs(normal_u), _LEAST_SLOPE)
    high = np.maximum(np.abs(normal_v), _LEAST_SLOPE)
    return wide, high, (wide + high) / 2, (wide - high) / 2


def _ramp(t: Array, sigma: Array) -> Array:
    """Second antiderivative of the Gaussian distribution function."""
    return _antiderivatives(t, sigma)[0]


def _antiderivatives(t: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Return the second and the first antiderivative of the Gaussian distribution function, and itself."""
    s = t / sigma
    share: Array = ndtr(s)
    density = sigma * (np.exp(-0.5 * s * s) / np.sqrt(2 * np.pi))
    rise = t * share + density
    return 0.5 * (t * rise + sigma * sigma * share), rise, share
