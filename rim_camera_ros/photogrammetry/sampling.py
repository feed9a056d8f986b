"""Errors of targets by the sampling of an image, as far as their own edges do not show them.

A pixel that sees less than its square (a fill factor below 1, or a simulation of one ray per pixel) moves
the image of an edge by up to half a pixel. An edge that crosses rows becomes jagged, which shows. An edge
along a row of pixels moves as a whole, which does not show. The size of the hidden errors is estimated from
the edges that are seen jagged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Frequencies [1/px] of the sampling in u and v, one of each pair of opposite ones.
_LATTICE = np.array([(g, h) for g in range(4) for h in range(-3, 4) if g > 0 or h > 0], dtype=float)
#: Least component of a frequency across an edge [1/px]: one nearly along the edge does not move it.
_LEAST_ACROSS = 0.5
#: Mean square shift [px^2] of an edge by a pixel that sees a point: uniform over 1 px. By a pixel with a
#: sensitive square of side a [px] it is (1 - a)^2 / 12; its mean over all a from 0 to 1 is a third of 1 / 12.
POINT_VARIANCE = 1 / 12
_UNKNOWN_VARIANCE = POINT_VARIANCE / 3
#: Length [px] of jagged edge that determines the variance as well as the prior: the spread of (1 - a)^2 / 12
#: over all a is that of an estimate from 1 px of edge.
_UNKNOWN_LENGTH = 1.0
#: Variance of an edge along a row by frequencies above those of the lattice, over that by those of the
#: lattice. Their waves are so short that each target has a phase of its own.
SHORT_WAVES = POINT_VARIANCE / ((1 + 1 / 4 + 1 / 9) / (2 * np.pi**2)) - 1


@dataclass(frozen=True)
class Jaggedness:
    """How jagged the edges of a target are by the sampling.

    ``squares`` [px]: squared residuals over the squared contrast, summed over the pixels at its edges, less
    the part of noise. ``length`` [px]: that of the edges, as far as they can show jaggedness.
    """

    squares: float
    length: float


def sampling_variance(found: Iterable[Jaggedness]) -> float:
    """Return the mean square shift [px^2] of edges by single pixels, from the jaggedness of edges.

    For a point-sampled edge the squared residuals per px of its length are 1/12 of the squared contrast, and
    its squared shifts are 1/12 px^2: both are the power of the sampling's frequencies (Parseval).
    """
    seen = list(found)
    squares = _UNKNOWN_LENGTH * _UNKNOWN_VARIANCE + sum(shown.squares for shown in seen)
    length = _UNKNOWN_LENGTH + sum(shown.length for shown in seen)
    return max(float(squares / length), 0.0)


def shifts_of_edges(normals: Array, length: float) -> Array:
    """Return the shift of a corner of two edges by each frequency, (frequencies, 2), in px per px.

    They are relative to the 1-sigma [px] of the shift by single pixels. ``normals`` (2, 2): unit normals of
    the edges, which are ``length`` px long where the corner is measured. At p an edge with normal n is moved
    along it by the sum over G of sin(2 pi G.p) / (pi G.n). The mean over a length L along t has the factor
    sinc(L G.t): the frequencies that remain are those that move the whole edge alike.
    """
    moved = np.stack([_shift(normal, length) for normal in normals], axis=1)
    result: Array = moved @ np.linalg.inv(normals).T
    result /= np.sqrt(POINT_VARIANCE)
    return result


def hidden_share(normal: Array, length: float) -> float:
    """Return the share of the variance of an edge's shifts that does not show as jaggedness."""
    long_waves = 0.5 * float(np.sum(_shift(normal, length) ** 2))
    return min(long_waves * (1 + SHORT_WAVES) / POINT_VARIANCE, 1.0)


def _shift(normal: Array, length: float) -> Array:
    across = _LATTICE @ normal
    along = _LATTICE @ np.array([-normal[1], normal[0]])
    moves = np.abs(across) > _LEAST_ACROSS
    result: Array = np.where(moves, np.sinc(length * along) / (np.pi * np.where(moves, across, 1.0)), 0.0)
    return result


def shared_covariance(shifts: Array, places: Array, moves: Array) -> Array:
    """Return the covariance (2 n, 2 n) px^2 of the errors that the targets of a station share.

    ``shifts`` (n, frequencies, 2) px of `shifts_of_edges`, times the standard deviation of the sampling;
    ``places`` (n, 2) px. The phase of each frequency is unknown, but the same for all targets: errors at p
    and q have the correlation cos(2 pi G.(p - q)). Errors of the places reduce it: ``moves`` (n, 2, k) px
    are those by k independent causes of sigma 1.
    """
    count = len(places)
    result = np.zeros((count, 2, count, 2))
    for number, frequency in enumerate(2 * np.pi * _LATTICE):
        phase = places @ frequency
        blurred = np.tensordot(frequency, moves, axes=(0, 1))
        square = np.sum(blurred**2, axis=1)
        between = square[:, None] + square[None, :] - 2 * blurred @ blurred.T
        alike = 0.5 * np.cos(phase[:, None] - phase[None, :]) * np.exp(-0.5 * np.maximum(between, 0.0))
        shift = shifts[:, number]
        result += alike[:, None, :, None] * shift[:, :, None, None] * shift[None, None]
    return result.reshape(2 * count, 2 * count)
