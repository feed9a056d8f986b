"""Wraps of several modulation frequencies: the possible ones, and the most likely ones of a pixel.

A phase at the frequency f_i states the distance modulo L_i = c / (2 f_i): d = d_i + n_i L_i (Kahlmann 2007,
eq. 2.4). Phases at several frequencies state it modulo the least common multiple of the L_i. Of independent
distances with the standard deviations sigma_i,

    J(n) = min over d of sum w_i (d - d_i - n_i L_i)^2 = sum w_i e_i^2 - (sum w_i e_i)^2 / sum w_i,

with w_i = 1 / sigma_i^2 and e_i the misclosure against the frequency of the shortest range, is minus twice
the logarithm of the likelihood of the wraps n. Hypotheses of wraps are ranked in this way by F. Jaremo Lawin,
P.-E. Forssen, H. Ovren, *Efficient Multi-Frequency Phase Unwrapping using Kernel Density Estimation*, ECCV
2016, with constant weights; here the weights are those by the pixel's own noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.phasor import SPEED_OF_LIGHT

Image = NDArray[np.float32]

#: Share of an ambiguity range by which noise may carry a distance across its end: 0.6 rad of phase.
_SLACK = 0.1
#: Difference of J to the second most likely wraps below which all other wraps are included (odds of 3e4).
_CLOSE = np.float32(20.0)
#: Number of pixels that are resolved together, so that intermediate values stay in the processor's cache.
_BLOCK = 1 << 14


def common_range(frequencies: Sequence[float]) -> float:
    """Return the distance in metres from which the phases of all frequencies [Hz] repeat together."""
    return SPEED_OF_LIGHT / (2.0 * math.gcd(*(round(frequency) for frequency in frequencies)))


@dataclass(frozen=True)
class Resolved:
    """Distances (H, W) [m] of the most likely wraps, and twice the log of their odds against all others.

    With two sets of wraps this is the difference of J between the two.
    """

    distance: Image
    lead: Image

    @property
    def wrong(self) -> Image:
        """Probability that other wraps are the true ones: 1 / (1 + exp(lead / 2))."""
        result = 1 / (1 + np.exp(np.minimum(self.lead, np.float32(80.0)) / 2))
        return np.asarray(result, np.float32)


class WrapTable:
    """The possible wraps; ``ambiguities`` L_i and ``span`` (least and greatest distance) in metres.

    ``rows``: sets of wraps, one number per frequency; None: all within the span.
    """

    def __init__(
        self,
        ambiguities: Sequence[float],
        span: tuple[float, float],
        rows: Sequence[Sequence[int]] | None = None,
    ) -> None:
        self.ambiguities = tuple(ambiguities)
        self.span = span
        self.rows = possible(ambiguities, span) if rows is None else tuple(tuple(one) for one in rows)
        self._lead = int(np.argmin(ambiguities))
        self._others = [i for i in range(len(ambiguities)) if i != self._lead]
        groups: dict[object, list[tuple[int, ...]]] = {}
        for row in self.rows:
            # if all are possible the nearest are found by rounding; given sets are tried one by one
            groups.setdefault(row[self._lead] if rows is None else row, []).append(row)
        #: wraps of the shortest range, and the least and greatest of every other with them
        self._hypotheses = [
            (group[0][self._lead], [(min(one), max(one)) for one in list(zip(*group, strict=True))])
            for group in groups.values()
        ]

    def resolve(self, distances: Sequence[Image], sigmas: Sequence[Image]) -> Resolved:
        """Return the most likely distances for distances modulo L_i, all (H, W) float32 in metres.

        NaN where a frequency has no distance, and where no wraps of the table lie within the span.
        """
        shape = distances[0].shape
        d = [np.ascontiguousarray(distance, np.float32).ravel() for distance in distances]
        s = [np.ascontiguousarray(sigma, np.float32).ravel() for sigma in sigmas]
        result, lead = np.empty(d[0].size, np.float32), np.empty(d[0].size, np.float32)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for start in range(0, d[0].size, _BLOCK):
                part = slice(start, start + _BLOCK)
                result[part], lead[part] = self._block([one[part] for one in d], [one[part] for one in s])
        return Resolved(result.reshape(shape), lead.reshape(shape))

    def _block(self, d: list[Image], sigma: list[Image]) -> tuple[Image, Image]:
        weights = [1 / (one * one) for one in sigma]
        per_total = 1 / sum(weights)
        first = d[self._lead]
        periods = [np.float32(self.ambiguities[i]) for i in self._others]
        low, high = (np.float32(one) for one in self.span)
        best = np.full(first.shape, np.inf, np.float32)
        second = best.copy()
        found = np.full(first.shape, np.nan, np.float32)
        costs: list[Image] = []
        for m, limits in self._hypotheses:
            there = first + np.float32(m * self.ambiguities[self._lead])
            cost = np.zeros_like(first)
            pull = np.zeros_like(first)
            for i, period in zip(self._others, periods, strict=True):
                apart = there - d[i]
                wraps = np.rint(apart / period)
                np.clip(wraps, *limits[i], out=wraps)
                wraps *= period
                apart -= wraps
                weighted = weights[i] * apart
                pull += weighted
                weighted *= apart
                cost += weighted
            shift = pull * per_total
            pull *= shift
            cost -= pull
            there -= shift
            outside = (there < low) | (there > high)
            if outside.any():
                cost[outside] = np.inf
            # the second most likely has the least cost except for the best
            np.minimum(second, np.maximum(cost, best), out=second)
            np.copyto(found, there, where=cost < best)
            np.minimum(best, cost, out=best)
            costs.append(cost)
        lead = second - best
        # wraps after the second most likely only matter for few pixels
        close = np.flatnonzero(lead < _CLOSE)
        if close.size:
            nearest = best[close]
            total = sum(np.exp((nearest - one[close]) / 2) for one in costs)
            lead[close] = -2 * np.log(np.maximum(total - 1, np.float32(1e-9)))
        return found, lead

    def probability_of_error(self, sigmas: Sequence[float]) -> float:
        """Return an upper bound of the probability of wrong wraps, for standard deviations [m] of distances.

        It is a sum over all differences of two rows. Each term is the probability that noise favours the
        other row, Q(sqrt(J) / 2) with J of the difference, times the share of the span with distances of
        both.
        """
        from scipy.special import ndtr  # takes a good part of a node's start

        weights = 1 / np.square(np.asarray(sigmas, float))
        rows = np.array(self.rows)
        apart = np.unique((rows[:, None] - rows[None]).reshape(-1, rows.shape[1]), axis=0)
        apart = apart[apart.any(axis=1)] * np.array(self.ambiguities)
        cost = np.square(apart) @ weights - (apart @ weights) ** 2 / weights.sum()
        moved = np.abs(apart @ weights) / weights.sum()
        share = np.maximum(1 - moved / (self.span[1] - self.span[0]), 0)
        return float(min(1.0, (share * ndtr(-np.sqrt(np.maximum(cost, 0)) / 2)).sum()))

    def wraps_at(self, distance: float) -> tuple[int, ...]:
        """Return the wraps of a distance in metres."""
        return tuple(int(distance // ambiguity) for ambiguity in self.ambiguities)


def possible(ambiguities: Sequence[float], span: tuple[float, float]) -> tuple[tuple[int, ...], ...]:
    """Return all sets of wraps whose ranges have a distance within the span [m] in common.

    Each range is extended at both ends by a tenth of its length, as noise carries distances across its ends.
    """
    edges = {*span}
    for period in ambiguities:
        edges |= {k * period for k in range(math.ceil(span[0] / period), math.floor(span[1] / period) + 1)}
    rows: set[tuple[int, ...]] = set()
    for edge in edges:
        near = [
            range(math.floor(edge / period - _SLACK), math.floor(edge / period + _SLACK) + 1)
            for period in ambiguities
        ]
        rows.update(product(*near))
    return tuple(sorted(rows))
