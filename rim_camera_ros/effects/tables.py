"""Multilinear interpolation in tables of one to three dimensions, held constant outside."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.base import Image


def check_knots(knots: Sequence[Sequence[float]], shape: tuple[int, ...], names: Sequence[str]) -> None:
    """Raise ValueError unless there is one increasing list of knots per axis that matches the values."""
    if len(knots) != len(names):
        raise ValueError(f"knots: expected {len(names)} lists ({', '.join(names)}), found {len(knots)}")
    for name, one in zip(names, knots, strict=True):
        if not one or any(b <= a for a, b in pairwise(one)):
            raise ValueError(f"knots of {name} must be an increasing list")
    expected = tuple(len(one) for one in knots)
    if shape != expected:
        raise ValueError(f"values have shape {shape}, expected {expected} by the knots")


def interpolate(
    knots: Sequence[Sequence[float]], values: NDArray[np.float64], coordinates: Sequence[Image | float]
) -> Image | float:
    """Return the multilinear interpolation at coordinates that broadcast together; NaN stays NaN."""
    cells = [
        _cell(np.asarray(axis, float), np.asarray(x, float))
        for axis, x in zip(knots, coordinates, strict=True)
    ]
    total: Image | float = 0.0
    for corner in product((0, 1), repeat=len(cells)):
        weight: Image | float = 1.0
        index = []
        for side, (lower, upper, share) in zip(corner, cells, strict=True):
            weight = weight * (share if side else 1.0 - share)
            index.append(upper if side else lower)
        total = total + weight * values[tuple(index)]
    return total


def _cell(axis: NDArray[np.float64], x: NDArray[np.float64]) -> tuple[Image, Image, Image]:
    """Lower and upper knot and the share of the upper one."""
    last = len(axis) - 1
    if last == 0:
        zero = np.zeros(x.shape, np.intp)
        return zero, zero, np.where(np.isnan(x), np.nan, 0.0)
    lower = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, last - 1)
    share = np.clip((x - axis[lower]) / (axis[lower + 1] - axis[lower]), 0.0, 1.0)
    return lower, lower + 1, share
