"""Statistics of first photons: a pixel records in each cycle the first detection only (pile-up).

Rates (bins, pixels) are expected detections per cycle of a pixel that is ready at its beginning.
P. B. Coates, *The correction for photon 'pile-up' in the measurement of radiative lifetimes*, J. Phys. E 1
(1968) 878-879.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Standard deviations above the expected number of detections by which cycles are kept back in a draw.
_SAFE = 4.0


def detection_probabilities(rates: Array) -> Array:
    """Return the probability (bins, pixels) that a ready pixel's first detection lies in each bin.

    P_i = (1 - exp(-r_i)) exp(-sum_{j < i} r_j), for Poisson light of rates r.
    """
    before = np.cumsum(rates, axis=0) - rates
    result: Array = -np.expm1(-rates) * np.exp(-before)
    return result


def ready_cycles(histogram: Array, *, cycles: int, missed: int) -> Array:
    """Return the cycles (pixels,) at whose beginning a pixel was ready: each detection costs ``missed``."""
    return np.asarray(cycles - missed * histogram.sum(axis=0, dtype=np.int64))


def remaining_cycles(histogram: Array, *, ready: Array) -> Array:
    """Return the cycles (bins, pixels) in which a ready pixel has detected nothing before each bin."""
    counted = np.cumsum(histogram, axis=0, dtype=np.int64)
    return np.asarray(ready - counted + histogram)


def coates(histogram: Array, *, cycles: int, missed: int = 0) -> Array:
    """Return the rates (bins, pixels) per cycle of which a histogram of first photons is made.

    Coates' estimator, r_i = -ln(1 - n_i / (N - sum_{j < i} n_j)) with N the cycles that began with a ready
    pixel: the maximum likelihood of each bin. NaN where no cycle is left.
    """
    ready = ready_cycles(histogram, cycles=cycles, missed=missed)
    left = remaining_cycles(histogram, ready=ready)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(left > 0, histogram / left, np.nan)
        result: Array = -np.log1p(-share)
    return result


def draw_histogram(rates: Array, *, cycles: int, missed: int, rng: np.random.Generator) -> Array:
    """Return a histogram (bins, pixels) of first photons, uint32, of an exposure of so many cycles.

    Detections are drawn in portions, each of as many cycles as will hardly be exceeded by those that
    its detections cost, until none is left; then the bins of the detections.
    """
    probability = detection_probabilities(rates)
    total = np.minimum(probability.sum(axis=0), 1.0)
    left = np.full(total.shape, cycles, np.int64)
    found = np.zeros(total.shape, np.int64)
    while True:
        # the number of ready cycles that, with the most detections that are likely, fit into what is left
        expected = left / (1.0 + missed * total)
        margin = missed * _SAFE * np.sqrt(expected * total * (1.0 - total))
        portion = (expected - margin).astype(np.int64)
        # where every cycle may detect, one portion in 1 + missed always fits
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
