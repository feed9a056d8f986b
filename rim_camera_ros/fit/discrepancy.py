"""What distances of a pose err by, smoothly over its surfaces, in each pose anew: the model's discrepancy.

Light that comes by way of the room, a floor that is not flat, or a gloss act on neighbours alike and differ
from pose to pose. Where that is more than noise, pixels are no independent observations: taken for some,
thousands of them move poses and parameters by many times what is stated of them. Here it is a random effect
of each pose (Kennedy & O'Hagan 2001, sec. 4), integrated out as errors of poses are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.views import PoseColumn, View

Array = NDArray[Any]

#: How the random effects are named in what is eliminated.
FIELD = "discrepancy."
#: Half waves across what a pose shows, at most: shorter ones are for the robust loss.
MOST_HALF_WAVES = 8


def discrepancy_columns(view: View, size: float) -> list[PoseColumn]:
    """Return the waves of which the discrepancy of a pose consists, with a 1-sigma of ``size`` [m] in all.

    Cosines over the rows and columns that the surfaces of the pose cover, whose mean squares are 1.
    """
    hit = view.geometry.hit
    if not hit.any():
        return []
    rows, columns = (_waves(hit.any(axis=axis)) for axis in (1, 0))
    numbers = [(i, j) for i in range(len(rows)) for j in range(len(columns)) if (i, j) != (0, 0)]
    prior = size / np.sqrt(len(numbers))
    dark = np.zeros(hit.shape)
    return [
        PoseColumn(f"{FIELD}{i}.{j}", prior, np.outer(rows[i], columns[j]), dark, is_smooth=True)
        for i, j in numbers
    ]


def _waves(covered: Array) -> Array:
    """Return cosines (K, N) of 0, 1, ... half waves from the first to the last pixel that is covered."""
    first, last = np.flatnonzero(covered)[[0, -1]]
    along = (np.arange(covered.size) - first + 0.5) / (last - first + 1)
    waves = np.cos(np.pi * np.arange(MOST_HALF_WAVES)[:, None] * np.clip(along, 0.0, 1.0))
    waves[1:] *= np.sqrt(2.0)
    return np.asarray(waves)
