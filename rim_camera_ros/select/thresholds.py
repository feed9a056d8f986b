"""Entry thresholds of candidates, at a stated rate of false alarms.

Many candidates are tested, so that the greatest of their gains is large by chance. In null replicates, in
which no effect is missing, each candidate exceeds its threshold at the same rate, and any of them does in a
stated share of recordings (the min-P procedure of Westfall & Young 1993, with Sidak's correction for
independent tests).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, ndtri

Array = NDArray[Any]

#: Share of recordings with nothing missing that may raise an alarm.
ALARM_RATE = 0.02
#: Greatest share of the poses, or of the values, that may be wrong by themselves: what many show is physics.
FEW = 0.15
#: Standard errors up to which a difference may be due to chance (95 %).
STANDARD_ERRORS = 2.0
#: Share of the misfit that parameters, another set-up or added light must explain to count as its cause.
LEAST_EXPLAINED = 0.5
#: Relative 1-sigma of a stated noise variance: a noise model is fitted to frames of another day, with a form
#: of three terms. It is wrong where it deviates by more than `fit.design.BEYOND` of these, ...
NOISE_SIGMA = 0.02
#: ... with this significance, in sigmas of the estimate from repeated frames.
LEAST_SIGMA = 6.0
#: Threshold [nats] where no replicates say what chance gains: four sigma of one parameter.
WITHOUT_REPLICATES = 8.0
#: Share of replicates with the greatest gains, which determine the effective number of independent tests. All
#: replicates would give too few: correlated gains are the less correlated the rarer they are.
_RARE = 0.1
#: Spread of gains below which they do not vary [nats].
_NO_SPREAD = 1e-9


def noise_limit(count: int) -> float:
    """Return the size [sigma] that any of ``count`` values exceeds by noise in `ALARM_RATE` of recordings.

    By Bonferroni's bound, for normal noise.
    """
    return -float(ndtri(ALARM_RATE / (2 * count)))


def rate_of_each(by_chance: Array, widths: Sequence[int]) -> float:
    """Return the rate at which each of several candidates may exceed its threshold by chance.

    ``by_chance`` (C, R) are the gains [nats] of candidates in replicates, ``widths`` (C,) their numbers of
    regressors. At this rate any of them exceeds its threshold at `ALARM_RATE`.
    """
    least = float(np.quantile(_chances(by_chance, widths).min(axis=0), _RARE))
    # of n independent chances the least is below this one in 1 - (1 - it)^n of replicates
    tests = np.log1p(-_RARE) / np.log1p(-min(max(least, 1e-9), _RARE))
    return float(1 - (1 - ALARM_RATE) ** (1 / tests))


def thresholds_at(rate: float, by_chance: Array, widths: Sequence[int]) -> Array:
    """Return the gains (C,) [nats] that candidates exceed at a rate, by their gains (C, R) in replicates.

    They are no less than `least_threshold`: priors and bounds leave some gains without a spread.
    """
    width, mean, scale = _distributions(by_chance, widths)
    own = mean + scale * (chdtri(width, rate) - width) / 2
    return np.asarray(np.maximum(own, least_threshold(rate)))


def least_threshold(rate: float) -> float:
    """Return the gain [nats] that one parameter's fit to noise alone exceeds at a rate."""
    return float(chdtri(1, rate)) / 2


def _distributions(by_chance: Array, widths: Sequence[int]) -> tuple[Array, Array, Array]:
    """Return degrees of freedom, mean and scale (C,) of gains.

    Twice the gain of a fit is distributed as chi-square with one degree of freedom per regressor (Wilks
    1938). Held-out poses, priors and errors of poses shift and widen that distribution.
    """
    width = np.asarray(widths, float)
    scale = np.std(by_chance, axis=1) / np.sqrt(width / 2)
    return width, np.mean(by_chance, axis=1), np.maximum(scale, _NO_SPREAD)


def _chances(by_chance: Array, widths: Sequence[int]) -> Array:
    """Return the probabilities (C, R) of gains at least as great (p-values)."""
    width, mean, scale = (distribution[:, None] for distribution in _distributions(by_chance, widths))
    return np.asarray(chdtrc(width, np.maximum(2 * (by_chance - mean) / scale + width, 0.0)))
