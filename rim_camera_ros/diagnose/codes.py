"""Counts that never occur: a read-out that leaves out codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera

#: A code that occurred so often has neighbours that occurred, where the noise is wider than a few counts.
_OFTEN = 30
#: Noise [counts] below which neighbours need not occur.
LEAST_NOISE = 3.0
#: Measurements that the codes within half a noise of a range hold, on either side.
_BESIDE = 100
#: Share of the frequent codes without a neighbour that matters.
LEAST_SHARE = 0.02
#: Step of a regular grid over the noise below which rounding adds less than 1 % to its variance.
_FINE = 0.35
#: Share of the codes of a regular grid that lie where it says, to one count.
_REGULAR = 0.98


@dataclass(frozen=True)
class MissingCodes:
    """Counts that are left out.

    ``share`` of the frequent codes that lack a neighbour, and the median ``step`` in counts between codes
    that occur, where they are frequent. Of ``ranges`` of codes that are left out (how many; 0: single ones)
    the share of the measurements that belong there, and the median width. ``grid`` [counts] is the distance
    of the codes that occur where it is the same throughout (0: it is not).
    """

    share: float
    step: float
    ranges: int = 0
    grid: float = 0.0

    def is_fine_grid(self, noise: float) -> bool:
        """Whether the codes are a regular grid that adds next to nothing to a noise [counts]."""
        return 0 < self.grid < _FINE * noise


def note_on_grid(codes: MissingCodes, camera: Camera) -> str:
    """Return in words that the distances come in coarser steps than the camera file says."""
    step = codes.grid * camera.sensor.lsb
    return (
        f"distances come in steps of {step * 1e3:.3g} mm, {codes.grid:.3g} times those of the camera file: "
        f"rounding adds {step / np.sqrt(12) * 1e3:.2g} mm to {camera.noise.floor * 1e3:.2g} mm of noise and "
        f"more, which changes nothing; with counts of such steps the camera's distance_lsb is {step:.6g}"
    )


def missing_codes(histogram: NDArray[Any] | None, *, noise: float) -> MissingCodes | None:
    """Examine how often each distance count (65536,) occurred; None where nothing is missing.

    ``noise`` [counts] is the smallest standard deviation of a distance. Beside a code that occurred 30
    times, with noise wider than three counts, none at all has a probability below 1e-9. Nor do frequent codes
    end within a fraction of the noise, on both sides of a range in which none occurs.
    """
    if histogram is None or noise < LEAST_NOISE:
        return None
    occurred = np.asarray(histogram)[1:-1]
    often = np.flatnonzero(occurred[1:-1] >= _OFTEN) + 1
    if len(often) < 20:
        return None
    ranges = _ranges(occurred, width=max(3, int(noise / 2)))
    if ranges is not None:
        return ranges
    alone = (occurred[often - 1] == 0) | (occurred[often + 1] == 0)
    share = float(alone.mean())
    if share < LEAST_SHARE:
        return None
    present = np.flatnonzero(occurred > 0)
    low, high = np.searchsorted(present, (often[0], often[-1]))
    steps = np.diff(present[low : high + 1])
    median = float(np.median(steps[steps > 1])) if (steps > 1).any() else 1.0
    return MissingCodes(share, median, grid=_grid(present[low : high + 1]))


def _grid(codes: NDArray[Any]) -> float:
    """Return the step [counts] of codes that lie on a regular grid, which need not be whole; 0 for others."""
    steps = np.diff(codes)
    usual = float(np.median(steps))
    # codes that nothing hit leave a step of two or three
    places = np.cumsum(np.where(np.abs(steps - usual) <= 1, 1.0, np.maximum(np.rint(steps / usual), 1.0)))
    step = float(np.sum(steps) / places[-1])
    beside = codes[1:] - step * places
    regular = float(np.mean(np.abs(beside - np.median(beside)) <= 1.0))
    return step if step > 1.0 and regular >= _REGULAR else 0.0


def _ranges(occurred: NDArray[Any], *, width: int) -> MissingCodes | None:
    """Return the ranges wider than ``width`` [counts] that are left out amid frequent codes.

    The codes beside a range may hold what belongs in it and do not count.
    """
    present = np.flatnonzero(occurred)
    below, above = present[:-1], present[1:]
    sums = np.concatenate([[0], np.cumsum(occurred)])
    inside = (above - below > width) & (below >= width) & (above + width < len(occurred))
    below, above = below[inside], above[inside]
    beside = np.minimum(sums[below] - sums[below - width], sums[above + 1 + width] - sums[above + 1])
    below, above, beside = (one[beside >= _BESIDE] for one in (below, above, beside))
    missed = float(np.sum(beside / width * (above - below - 1)))
    share = missed / float(sums[-1])
    if share < LEAST_SHARE:
        return None
    return MissingCodes(share, float(np.median(above - below)), len(below))
