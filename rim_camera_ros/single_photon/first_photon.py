"""Statistics of first photons: a pixel only records the first detection of each cycle (pile-up).

Rates (bins, pixels) are expected detections per cycle of a pixel that is ready at its beginning.
P. B. Coates, *The correction for photon 'pile-up' in the measurement of radiative lifetimes*, J. Phys. E 1
(1968) 878-879.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Margin for the number of detections in a portion of cycles, in standard deviations above its expectation.
_SAFE = 4.0


def detection_probabilities(rates: Array) -> Array:
    """Return the probability (bins, pixels) that a ready pixel's first detection lies in each bin.

    P_i = (1 - exp(-r_i)) exp(-sum_{j < i} r_j), for Poisson light of rates r.
    """
    before = np.cumsum(rates, axis=0) - rates
    result: Array = -np.expm1(-rates) * np.exp(-before)
    return result


def ready_cycles(histogram: Array, *, cycles: int, missed: int) -> Array:
    """Return the cycles (pixels,) at whose beginning a pixel was ready; each detection costs ``missed``."""
    return np.asarray(cycles - missed * histogram.sum(axis=0, dtype=np.int64))


def remaining_cycles(histogram: Array, *, ready: Array) -> Array:
    """Return the cycles (bins, pixels) in which a ready pixel has detected nothing before each bin."""
    counted = np.cumsum(histogram, axis=0, dtype=np.int64)
    return np.asarray(ready - counted + histogram)


def coates(histogram: Array, *, cycles: int, missed: int = 0) -> Array:
    """Return the rates (bins, pixels) per cycle, estimated from a histogram of first photons.

    This is Coates' estimator, r_i = -ln(1 - n_i / (N - sum_{j < i} n_j)), where N cycles began with a ready
    pixel; it has the maximum likelihood in each bin. NaN where no cycle is left.
    """
    ready = ready_cycles(histogram, cycles=cycles, missed=missed)
    left = remaining_cycles(histogram, ready=ready)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(left > 0, histogram / left, np.nan)
        result: Array = -np.log1p(-share)
    return result


def draw_histogram(rates: Array, *, cycles: int, missed: int, rng: np.random.Generator) -> Array:
    """Return a histogram (bins, pixels) of first photons, uint32, of an exposure of so many cycles.

    The numbers of detections are drawn for portions of the cycles, each so small that with the cycles missed
    after its detections it hardly exceeds the remaining ones. Then the bins of the detections are drawn.
    """
    probability = detection_probabilities(rates)
    total = np.minimum(probability.sum(axis=0), 1.0)
    left = np.full(total.shape, cycles, np.int64)
    found = np.zeros(total.shape, np.int64)
    while True:
        # the number of ready cycles that, with the largest likely number of detections, fit in the rest
        expected = left / (1.0 + missed * total)
        margin = missed * _SAFE * np.sqrt(expected * total * (1.0 - total))
        portion = (expected - margin).astype(np.int64)
        # even if every cycle has a detection, a share 1 / (1 + missed) of the cycles always fits
        portion = np.minimum(np.maximum(portion, np.maximum(left // (1 + missed), 1)), left)
        if not portion.any():
            break
        hits = rng.binomial(portion, total)
        found += hits
        # the dead time of the last detection may reach beyond the exposure
        left = np.maximum(left - portion - missed * hits, 0)
    with np.errstate(invalid="ignore"):
        share = np.where(total > 0, probability / total, 1.0 / len(rates))
    share /= share.sum(axis=0)
    return np.asarray(rng.multinomial(found, share.T).T.astype(np.uint32))
