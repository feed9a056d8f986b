"""Counts that never occur: a read-out with missing codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.select.thresholds import NOISE_SIGMA

#: Occurrences of a code above which its neighbours must have occurred, if the noise exceeds a few counts.
_OFTEN = 30
#: Noise [counts] below which neighbours need not occur.
LEAST_NOISE = 3.0
#: Least number of measurements in the codes within half a noise of a range, on either side.
_BESIDE = 100
#: Share of the frequent codes without a neighbour that matters.
LEAST_SHARE = 0.02
#: Least share of the codes that lie on a regular grid, to one count.
_REGULAR = 0.98


@dataclass(frozen=True)
class MissingCodes:
    """Counts that are missing.

    For single codes ``share`` is that of the frequent codes which lack a neighbour, and ``step`` [counts] the
    median spacing of codes that occur, where they are frequent. For ``ranges`` of missing codes (their
    number; 0: single codes) ``share`` is that of the measurements that belong there, and ``step`` the median
    width. ``grid`` [counts] is the spacing of the codes where it is regular (0: it is not).
    """

    share: float
    step: float
    ranges: int = 0
    grid: float = 0.0

    def is_fine_grid(self, noise: float) -> bool:
        """Whether the codes are a regular grid whose rounding is within the uncertainty of a noise model.

        ``noise`` [counts] is that of the most precise readings of the recording.
        """
        return 0 < self.grid**2 / 12 < BEYOND * NOISE_SIGMA * noise**2


def note_on_grid(codes: MissingCodes, camera: Camera, *, noise: float) -> str:
    """Return in words that distances have coarser steps than the camera file states.

    ``noise`` [counts] is that of the most precise readings of the recording.
    """
    step, precise = codes.grid * camera.sensor.lsb, noise * camera.sensor.lsb
    return (
        f"distances come in steps of {step * 1e3:.3g} mm, {codes.grid:.3g} times those of the camera file: "
        f"rounding adds {step / np.sqrt(12) * 1e3:.2g} mm to {precise * 1e3:.2g} mm of noise and "
        f"more, which changes nothing; with counts of such steps the camera's distance_lsb is {step:.6g}"
    )


def missing_codes(histogram: NDArray[Any] | None, *, noise: float) -> MissingCodes | None:
    """Examine how often each distance count (65536,) occurred; None where nothing is missing.

    ``noise`` [counts] is the smallest standard deviation of a distance. Where a code occurred 30 times and
    the noise exceeds three counts, the probability that its neighbour never occurs is below 1e-9. Equally
    improbable are frequent codes that end within a fraction of the noise, on both sides of an empty range.
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
    """Return the step [counts, not always whole] of codes on a regular grid; 0 where there is no grid."""
    steps = np.diff(codes)
    usual = float(np.median(steps))
    # codes that happened not to occur leave steps of two or three
    places = np.cumsum(np.where(np.abs(steps - usual) <= 1, 1.0, np.maximum(np.rint(steps / usual), 1.0)))
    step = float(np.sum(steps) / places[-1])
    deviation = codes[1:] - step * places
    regular = float(np.mean(np.abs(deviation - np.median(deviation)) <= 1.0))
    return step if step > 1.0 and regular >= _REGULAR else 0.0


def _ranges(occurred: NDArray[Any], *, width: int) -> MissingCodes | None:
    """Return the empty ranges wider than ``width`` [counts] among frequent codes.

    The codes next to a range may hold measurements that belong in it and do not count.
    """
    present = np.flatnonzero(occurred)
    below, above = present[:-1], present[1:]
    sums = np.concatenate([[0], np.cumsum(occurred)])
    inside = (above - below > width) & (below >= width) & (above + width < len(occurred))
    below, above = below[inside], above[inside]
    beside = np.minimum(sums[below] - sums[below - width], sums[above + 1 + width] - sums[above + 1])
    below, above, beside = (values[beside >= _BESIDE] for values in (below, above, beside))
    missed = float(np.sum(beside / width * (above - below - 1)))
    share = missed / float(sums[-1])
    if share < LEAST_SHARE:
        return None
    return MissingCodes(share, float(np.median(above - below)), len(below))
