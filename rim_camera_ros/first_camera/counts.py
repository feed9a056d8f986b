"""Steps and saturation from histograms of a recording's counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE
from rim_camera_ros.frame import RawFrame

#: The greatest value is the saturation if its frequency is at least the first number times the mean frequency
#: of the values below it, and at least the second number.
_PILE, _LEAST = 8.0, 20
#: Number of values below the greatest that are used.
_BELOW = 64


class Counts:
    """Histograms of distance counts (16 bit only) and amplitudes."""

    def __init__(self) -> None:
        self.distances = np.zeros(FULL_SCALE, np.int64)
        self.amplitudes = np.zeros(FULL_SCALE, np.int64)
        self.in_metres = False

    def add(self, frame: RawFrame) -> None:
        """Take a frame."""
        if frame.distance.dtype == np.uint16:
            self.distances += np.bincount(frame.distance.ravel(), minlength=FULL_SCALE)
        else:
            self.in_metres = True
        values = np.clip(np.rint(np.nan_to_num(frame.amplitude.astype(np.float64))), 0, FULL_SCALE - 1)
        self.amplitudes += np.bincount(values.astype(np.int64).ravel(), minlength=FULL_SCALE)

    @property
    def grid(self) -> int:
        """Greatest common divisor of the distance counts; 1 without any."""
        found = np.flatnonzero(self.distances[1:]) + 1
        return int(np.gcd.reduce(found)) if found.size else 1

    @property
    def greatest_distance(self) -> int:
        """The greatest distance count that occurs."""
        found = np.flatnonzero(self.distances)
        return int(found[-1]) if found.size else 0

    @property
    def greatest_amplitude(self) -> int:
        """The greatest amplitude that occurs."""
        found = np.flatnonzero(self.amplitudes)
        return int(found[-1]) if found.size else 0

    def saturation(self) -> int | None:
        """Return the amplitude at which values pile up, None where none does."""
        top = self.greatest_amplitude
        return top if top > 0 and _piled(self.amplitudes, top) else None


def _piled(counts: NDArray[np.int64], top: int) -> bool:
    # amplitudes of eight bits come in steps: only values that occur are neighbours
    below = counts[max(0, top - FULL_SCALE // 16) : top]
    below = below[below > 0][-_BELOW:]
    level = float(below.mean()) if below.size else 0.0
    return bool(counts[top] >= _LEAST and counts[top] > _PILE * level)
