"""Defective pixels: stuck, or noisier than others.

A physical effect changes neighbouring pixels of one tile alike. A pixel that differs from its neighbours in
most of its poses, far in one, or from frame to frame, is defective.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.variance_components import WILD
from rim_camera_ros.select.deviations import LEAST, Deviations, Mask

Array = NDArray[Any]


def defective_pixels(stations: Sequence[Deviations]) -> Mask:
    """Return the pixels (H, W) that are stuck, or noisier than others."""
    return _apart_from_neighbours(stations) | _noisy(stations)


def _median_of_neighbours(image: Array, used: Mask, tile: Array) -> Array:
    """Return the median of the eight neighbours (H, W) that see the same tile; NaN where too few do."""
    rows, columns = image.shape
    around = np.full((8, rows, columns), np.nan)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    for values, (i, j) in zip(around, steps, strict=True):
        here = np.s_[max(-i, 0) : rows - max(i, 0), max(-j, 0) : columns - max(j, 0)]
        there = np.s_[max(i, 0) : rows - max(-i, 0), max(j, 0) : columns - max(-j, 0)]
        values[here] = np.where(used[there] & (tile[there] == tile[here]), image[there], np.nan)
    result = np.full(image.shape, np.nan)
    seen = used & (np.isfinite(around).sum(axis=0) >= LEAST)
    result[seen] = np.nanmedian(around[:, seen], axis=0)
    return result


def _apart_from_neighbours(stations: Sequence[Deviations]) -> Mask:
    """Return the pixels (H, W) that differ from their neighbours in most of their poses, or far in one.

    With independent noise a pixel does so in three of four poses less than once in 10^6 times. One that sees
    a wall in most poses, and is stuck, does in the others alone, by more than the `WILD` sigma at which
    residuals count no more.
    """
    used = np.sum([station.used for station in stations], axis=0)
    beyond, far = np.zeros(used.shape, int), np.zeros(used.shape, bool)
    for station in stations:
        if not station.is_judged:
            continue
        around = _median_of_neighbours(station.z, station.used, station.tile)
        apart = np.where(np.abs(around) < BEYOND, station.z - around, 0.0)
        beyond += np.abs(apart) > BEYOND
        far |= np.abs(apart) > WILD
    return np.asarray((used >= LEAST) & ((2 * beyond > used) | far))


def _noisy(stations: Sequence[Deviations]) -> Mask:
    """Return the pixels (H, W) whose frames scatter by `BEYOND` times as much as those of their neighbours.

    With normal noise and four degrees of freedom a pixel does so three times in 10^7.
    """
    freedom = np.sum([station.freedom for station in stations], axis=0)
    seen = freedom >= LEAST
    ratio = np.sum([station.scatter for station in stations], axis=0) / np.maximum(freedom, 1)
    usual = _median_of_neighbours(ratio, seen, np.zeros(seen.shape))
    with np.errstate(invalid="ignore"):
        return np.asarray(ratio > BEYOND**2 * np.maximum(usual, 1.0))
