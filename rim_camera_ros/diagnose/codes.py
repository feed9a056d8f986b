"""Counts that never occur: a read-out that leaves out codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: A code that occurred so often has neighbours that occurred, where the noise is wider than a few counts.
_OFTEN = 30
#: Noise [counts] below which neighbours need not occur.
LEAST_NOISE = 3.0
#: Measurements that the codes within half a noise of a range hold, on either side.
_BESIDE = 100
#: Share of the frequent codes without a neighbour that matters.
LEAST_SHARE = 0.02


@dataclass(frozen=True)
class MissingCodes:
    """Counts that are left out.

    ``share`` of the frequent codes that lack a neighbour, and the median ``step`` in counts between codes
    that occur, where they are frequent. Of ``ranges`` of codes that are left out (how many; 0: single ones)
    the share of the measurements that belong there, and the median width.
    """

    share: float
    step: float
    ranges: int = 0


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
    return MissingCodes(share, float(np.median(steps[steps > 1])) if (steps > 1).any() else 1.0)


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
