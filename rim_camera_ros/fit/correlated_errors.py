"""Errors of distances that neighbouring pixels share, independent between poses: smooth over their surfaces.

Light that comes by way of the room, a floor that is not flat, or a gloss act on neighbours alike and differ
from pose to pose. Where these errors exceed the noise, pixels are no independent observations: treated as
independent, thousands of them move poses and parameters by many times their stated errors. Here such errors
are a random effect of each pose: a model discrepancy (Kennedy & O'Hagan 2001, sec. 4) that is integrated out
as errors of poses are. `variance_components` estimates its size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.pose_columns import PoseColumn
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.views import View

Array = NDArray[Any]

#: Begin of the names of these random effects among the nuisances.
CORRELATED = "correlated."
#: Most numbers of half waves across the surfaces of a pose, from 0 on; and the most waves of all poses
#: together: each takes memory for every pixel, and time grows with the square of their number. With half of
#: them poses of a SwissRanger over a floor still seemed to share errors, of 15 times the stated size.
_MOST_HALF_WAVES = 6
_MOST_WAVES = 1000


def half_waves_of(poses: int) -> int:
    """Return how many numbers of half waves are used across each pose in a recording of so many poses."""
    return int(np.clip(np.sqrt(_MOST_WAVES / max(poses, 1)), 1, _MOST_HALF_WAVES))


def correlated_columns(
    view: View, size: float, *, measured: tuple[Array, Array], half_waves: int
) -> list[PoseColumn]:
    """Return the waves of which correlated errors of a pose consist, with a total 1-sigma of ``size`` [m].

    They are products of cosines over the rows and columns in which the surfaces of the pose were ``measured``
    (as `Dataset.measured`), with mean squares of 1 and fewer than ``half_waves`` half waves each way.
    `shares_of` gives their sizes.
    """
    hit, window = view.geometry.hit, view.window or (slice(None), slice(None))
    seen = [
        hit.any(axis=axis) & side[part] for axis, side, part in zip((1, 0), measured, window, strict=True)
    ]
    if not all(side.any() for side in seen):
        return []
    rows, columns = (_waves(side, half_waves) for side in seen)
    numbers = [(i, j) for i in range(len(rows)) for j in range(len(columns))]
    sizes = size * shares_of(half_waves)
    dark = np.zeros(hit.shape)
    return [
        PoseColumn(f"{CORRELATED}{i}.{j}", sizes[i, j], np.outer(rows[i], columns[j]), dark, is_smooth=True)
        for i, j in numbers
    ]


def correlated_error_of(prediction: Prediction, nuisances: Mapping[str, float]) -> Array:
    """Return a station's estimated correlated errors (H, W) [m], apart from offset and tilts of its pose."""
    station, inner = prediction.station, prediction.inner
    total = np.zeros(prediction.distance.shape)
    window: Any = ... if inner.context.window is None else inner.context.window
    for column in inner.pose_columns:
        if not column.path.startswith(CORRELATED):
            continue
        if sum(int(word) for word in column.path.removeprefix(CORRELATED).split(".")) > 1:
            found = nuisances.get(f"{station.recording}.{station.placed}.{column.path}", 0.0)
            total[window] += found * column.distance
    return np.where(prediction.used, total, 0.0)


def shares_of(half_waves: int) -> Array:
    """Return the 1-sigma of each wave (K, K) over that of all: as one over the square of its wave number.

    That is the prior of a thin-plate spline (Wahba 1990, sec. 2.4), which bends as little as possible. That
    prior leaves the mean free; here its size is that of the longest wave: an error shared by all pixels of
    a pose would be a drift or a cyclic error otherwise.
    """
    squares = np.add.outer(np.arange(half_waves) ** 2.0, np.arange(half_waves) ** 2.0)
    shares = 1.0 / np.maximum(squares, 1.0)
    return np.asarray(shares / np.sqrt(np.sum(shares**2)))


def _waves(covered: Array, count: int) -> Array:
    """Return cosines (``count``, N) of 0, 1, ... half waves from the first to the last pixel covered."""
    first, last = np.flatnonzero(covered)[[0, -1]]
    along = (np.arange(covered.size) - first + 0.5) / (last - first + 1)
    waves = np.cos(np.pi * np.arange(count)[:, None] * np.clip(along, 0.0, 1.0))
    waves[1:] *= np.sqrt(2.0)
    return np.asarray(waves)
