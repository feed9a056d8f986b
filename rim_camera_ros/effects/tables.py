"""Multilinear interpolation in tables of one to three dimensions, held constant outside."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.signal import Image

#: Number of knots of one coordinate up to which interpolation is a sum over all intervals.
_FEW = 24


def check_knots(knots: Sequence[Sequence[float]], shape: tuple[int, ...], names: Sequence[str]) -> None:
    """Raise ValueError unless there is one increasing list of knots per axis that matches the values."""
    if len(knots) != len(names):
        raise ValueError(f"knots: expected {len(names)} lists ({', '.join(names)}), found {len(knots)}")
    for name, knot in zip(names, knots, strict=True):
        if not knot or any(b <= a for a, b in pairwise(knot)):
            raise ValueError(f"knots of {name} must be an increasing list")
    expected = tuple(len(knot) for knot in knots)
    if shape != expected:
        raise ValueError(f"values have shape {shape}, expected {expected} by the knots")


def interpolate(
    knots: Sequence[Sequence[float]], values: NDArray[np.float64], coordinates: Sequence[Image | float]
) -> Image | float:
    """Return the multilinear interpolation at coordinates that broadcast together; NaN stays NaN."""
    arrays = [np.asarray(x, float) for x in coordinates]
    shape = np.broadcast_shapes(*(x.shape for x in arrays))
    table, open_ = _along_single_axes([np.asarray(knot, float) for knot in knots], values, arrays, shape)
    if not open_:
        return np.broadcast_to(table, shape) if shape else float(table)
    # the axes of the open knots stand before those of the image: one flat index for all of them
    sizes = table.shape[: len(open_)]
    start: Image = np.zeros((), np.intp)
    pixels = 1
    if table.size > np.prod(sizes):
        table = np.broadcast_to(table, sizes + shape)
        pixels = int(np.prod(shape))
        start = np.arange(pixels).reshape(shape)
    if len(open_) == 1 and sizes[0] <= _FEW:
        return _along_knots(np.asarray(knots[open_[0]], float), table, arrays[open_[0]])
    strides = [int(np.prod(sizes[i + 1 :])) * pixels for i in range(len(sizes))]
    cells = [_cell(np.asarray(knots[k], float), arrays[k]) for k in open_]
    for (lower, _), stride in zip(cells, strides, strict=True):
        start = start + lower * stride
    flat = table.ravel()
    total: Image = np.zeros(())
    for corner in product((0, 1), repeat=len(cells)):
        if any(side and n == 1 for side, n in zip(corner, sizes, strict=True)):
            continue
        step = sum(side * stride for side, stride in zip(corner, strides, strict=True))
        part: Image = np.take(flat, start + step)
        for side, (_, share) in zip(corner, cells, strict=True):
            part = part * (share if side else 1.0 - share)
        total = total + part
    return total


def _along_knots(axis: NDArray[np.float64], table: Image, x: NDArray[np.float64]) -> Image:
    """Interpolate a table (knots, ...) by one coordinate, as a sum over the intervals between knots.

    This avoids access by index, which is slow.
    """
    total: Image = table[0] + np.zeros_like(x)
    for k in range(len(axis) - 1):
        part = np.clip(x, axis[k], axis[k + 1])
        part -= axis[k]
        total = total + part * ((table[k + 1] - table[k]) / (axis[k + 1] - axis[k]))
    if len(axis) == 1:
        total = np.where(np.isnan(x), np.nan, total)
    return total


def _along_single_axes(
    knots: Sequence[NDArray[np.float64]],
    values: NDArray[np.float64],
    arrays: Sequence[NDArray[np.float64]],
    shape: tuple[int, ...],
) -> tuple[NDArray[np.float64], list[int]]:
    """Interpolate by those coordinates that vary along one axis of the image (as rows and columns do).

    Returns the table with the axes of the remaining knots before those of the image (1 where nothing varies),
    and the numbers of the remaining coordinates.
    """
    table = values.reshape(values.shape + (1,) * len(shape))
    open_: list[int] = []
    done: set[int] = set()
    for k, x in enumerate(arrays):
        axes = [i + len(shape) - x.ndim for i, n in enumerate(x.shape) if n > 1]
        if len(axes) > 1 or done & set(axes) or (x.size > 1 and x.size == np.prod(shape)) or x.size == 0:
            open_.append(k)
            continue
        done |= set(axes)
        lower, share = _cell(knots[k], x.ravel())
        number = np.arange(x.size)
        weights = np.zeros((x.size, len(knots[k])))
        weights[number, lower] = 1.0 - share
        weights[number, np.minimum(lower + 1, len(knots[k]) - 1)] += share
        # the result's last axis takes its place among the image's
        along = np.tensordot(table, weights, axes=(len(open_), 1))
        if axes:
            axis = axes[0] - len(shape) - 1
            table = np.moveaxis(np.squeeze(along, axis=axis), -1, axis + 1)
        else:
            table = along[..., 0]
    return table, open_


def _cell(axis: NDArray[np.float64], x: NDArray[np.float64]) -> tuple[NDArray[np.intp], Image]:
    """Lower knot and the share of the upper one; NaN where x is."""
    last = len(axis) - 1
    if last == 0:
        return np.zeros(x.shape, np.intp), np.where(np.isnan(x), np.nan, 0.0)
    lower = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, last - 1)
    share = np.clip((x - axis[lower]) / np.diff(axis)[lower], 0.0, 1.0)
    return lower, share
