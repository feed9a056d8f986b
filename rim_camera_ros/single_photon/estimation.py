"""Histograms of first photons -> distance, signal, precision: likelihood of a pulse on a background.

A pixel's histogram n_i is binomial: of the R_i ready cycles that reach bin i without a detection, n_i detect
with probability 1 - exp(-r_i), r_i = S g_i(t) + b, with the signal S and background b per cycle and the
response g of the detector: Coates' correction of pile-up (`first_photon.coates`) within the likelihood. The
bin of the pulse is found by a matched filter; from there Fisher's scoring finds t and S, with the background
of all bins beyond the pulse. The precision is the Cramer-Rao bound: the inverse of the Fisher information
sum_i R_i / (exp(r_i) - 1) dr_i/dtheta dr_i/dtheta'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.phasor import SPEED_OF_LIGHT
from rim_camera_ros.single_photon.detector import SinglePhotonDetector
from rim_camera_ros.single_photon.first_photon import ready_cycles

Array = NDArray[Any]

#: Half the width of the bins that are looked at around the pulse, in its standard deviations.
_HALF_WINDOW = 4.0
#: Places within a bin for which the response is tabulated; between them it is continued to first order.
_PLACES = 128
#: Steps of Fisher's scoring from the matched filter's bin.
_STEPS = 3
#: Two running sums of this many standard deviations of the pulse are a triangle of its variance.
_TRIANGLE = math.sqrt(6.0)
#: Pixels that are worked on at a time: with more the arrays leave the processor's cache, with fewer the
#: calls count (64 x 48 pixels of 128 bins: 8.6 ms in blocks of 256, 6.6 of 512, 5.5 of 1024 and 1536).
_BLOCK = 1536
#: Least background [counts per exposure] of the Cramer-Rao bound.
_FAINTEST = 1e-6
#: Least rates per cycle: a bin without any light still has a likelihood.
_LEAST = 1e-12


@dataclass(frozen=True)
class PulseEstimates:
    """What the histograms of pixels tell, all (pixels,) float32.

    ``distance`` [m] in [0, L), NaN where nothing was detected; ``signal``: photons of the pulse that would
    have been detected in the exposure if none had hidden another; ``background``: those of all other
    detections likewise; ``sigma`` [m]: Cramer-Rao bound of the distance's standard deviation.
    """

    distance: Array
    signal: Array
    background: Array
    sigma: Array


class PulseEstimator:
    """Finds the pulse in the histograms of one detector. Not for use from several threads at once."""

    def __init__(self, detector: SinglePhotonDetector) -> None:
        self.detector = detector
        width = detector.bin_width
        half = math.ceil(_HALF_WINDOW * detector.time_sigma / width)
        self._half = min(half, (detector.bins - 2) // 2)
        self._offsets = np.arange(-self._half, self._half + 1)
        self._reach = max(self._half // 2, 1)
        self._table, self._slope = self._responses()
        self._triangle = min(max(round(_TRIANGLE * detector.time_sigma / width), 1), detector.bins // 4)
        self._numbers = np.arange(detector.bins, dtype=np.uint16)[:, None]
        rows = detector.bins + 2 * (self._triangle - 1)
        self._scratch = [np.empty((rows, _BLOCK), np.float32) for _ in range(4)]
        self._counts, self._left = (np.empty((detector.bins, _BLOCK), np.float32) for _ in range(2))

    def _responses(self) -> tuple[Array, Array]:
        """Return the response (places, window) and its derivative by the time in bins.

        Of pulses from `_reach` bins before the beginning of the window's middle bin to as far behind its end.
        """
        detector = self.detector
        middle = detector.bins // 2
        places = (np.arange((2 * self._reach + 1) * _PLACES) + 0.5) / _PLACES - self._reach
        bins = middle + self._offsets

        def at(place: Array) -> Array:
            return detector.response((middle + place) * detector.bin_width)[bins].T

        step = 1e-3
        slope = (at(places + step) - at(places - step)) / (2 * step)
        return np.asarray(at(places), np.float32), np.asarray(slope, np.float32)

    def estimate(self, histogram: Array, *, cycles: int) -> PulseEstimates:
        """Return the estimates of histograms (bins, pixels) of whole counts, of exposures of ``cycles``.

        Raises ValueError for another number of bins.
        """
        detector = self.detector
        if histogram.ndim != 2 or histogram.shape[0] != detector.bins:
            raise ValueError(
                f"histograms of shape {histogram.shape}, expected ({detector.bins}, pixels): another "
                "number of bins than the detector's"
            )
        parts = [
            self._block(histogram[:, begin : begin + _BLOCK], cycles)
            for begin in range(0, histogram.shape[1], _BLOCK)
        ]
        return PulseEstimates(
            *(np.concatenate([getattr(one, f.name) for one in parts]) for f in fields(PulseEstimates))
        )

    def _block(self, histogram: Array, cycles: int) -> PulseEstimates:
        """Return the estimates of a few pixels, whose arrays stay in the processor's cache."""
        detector = self.detector
        counts, left = (one[:, : histogram.shape[1]] for one in (self._counts, self._left))
        np.copyto(counts, histogram, casting="unsafe")
        ready = ready_cycles(histogram, cycles=cycles, missed=detector.missed_cycles).astype(np.float32)
        left[0] = ready
        for i in range(1, len(left)):
            np.subtract(left[i - 1], counts[i - 1], out=left[i])
        all_counts, all_left = counts.sum(axis=0), left.sum(axis=0)
        peak = self._peak(counts, left, all_counts / np.maximum(all_left, 1.0))
        columns = np.arange(counts.shape[1])[:, None]
        rows = (peak[:, None] + self._offsets) % detector.bins
        n, r = counts[rows, columns], left[rows, columns]
        np.maximum(r, 1.0, out=r)
        outside = np.maximum(all_left - r.sum(axis=1), 1.0)
        share = np.clip((all_counts - n.sum(axis=1)) / outside, 0.0, 1.0 - 1e-7)
        background = np.maximum(-np.log1p(-share), np.float32(_LEAST))
        place, signal, variance = self._score(n, r, background)
        per_bin = np.float32(detector.bin_width * SPEED_OF_LIGHT / 2.0)
        distance = np.mod(peak + place, np.float32(detector.bins)) * per_bin
        distance[~(all_counts > 0)] = np.nan
        return PulseEstimates(
            distance=distance.astype(np.float32, copy=False),
            signal=signal * np.float32(cycles),
            background=background * np.float32(detector.bins * cycles),
            sigma=np.sqrt(variance) * per_bin,
        )

    def _peak(self, counts: Array, left: Array, mean: Array) -> Array:
        """Return the bin (pixels,) of the pulse: where detections beyond the mean rate are most significant.

        Rates above the mean n_i / R_i - b, weighted as the pulse, over their standard deviation, which goes
        with 1 / sqrt(R_i): the few cycles that pile-up leaves to late bins count for no more than they tell.
        """
        bins, size = counts.shape
        margin = 2 * (self._triangle - 1)
        excess, once, score, scale = (one[:, :size] for one in self._scratch)
        np.maximum(left, np.float32(1.0), out=scale[:bins])
        np.divide(counts, scale[:bins], out=excess[:bins])
        np.subtract(excess[:bins], mean, out=excess[:bins])
        np.copyto(excess[bins:], excess[:margin])
        once = _running_sum(excess, self._triangle, out=once)
        score = _running_sum(once, self._triangle, out=score)
        # the sum that begins in a bin is about the bin `middle` behind it
        middle = self._triangle - 1
        np.sqrt(scale[:bins], out=scale[:bins])
        np.multiply(score[: bins - middle], scale[middle:bins], out=score[: bins - middle])
        np.multiply(score[bins - middle :], scale[:middle], out=score[bins - middle :])
        # argmax over columns in whole rows, which takes a fraction of its time
        best = np.equal(score, score.max(axis=0)) * self._numbers
        return np.asarray((best.max(axis=0).astype(np.intp) + middle) % bins)

    def _score(self, n: Array, r: Array, background: Array) -> tuple[Array, Array, Array]:
        """Return place [bins behind the peak's beginning], signal per cycle, variance of the place [bins^2].

        ``n``, ``r``: detections and remaining cycles (pixels, window).
        """
        rate = -np.log1p(-np.minimum(n / r, np.float32(1 - 1e-6))) - background[:, None]
        signal = np.maximum(rate.sum(axis=1), np.float32(_LEAST))
        place = np.full(signal.shape, 0.5, np.float32)
        low, high = np.float32(-self._reach), np.float32(self._reach + 1)
        b = background[:, None]
        for step in range(_STEPS + 1):
            g, slope = self._response_at(place)
            total = signal[:, None] * g
            total += b
            weight = np.expm1(total)
            # d log L / d r_i = n_i exp(r) / (exp(r) - 1) - R_i; information R_i / (exp(r) - 1)
            if step < _STEPS:
                residual = n / weight
                residual += n
                residual -= r
            np.divide(r, weight, out=weight)
            by_time = slope
            by_time *= signal[:, None]
            ts = np.einsum("ij,ij,ij->i", weight, by_time, g)
            ss = np.einsum("ij,ij,ij->i", weight, g, g)
            tt = np.einsum("ij,ij,ij->i", weight, by_time, by_time)
            determinant = np.maximum(tt * ss - ts * ts, np.float32(1e-30))
            if step == _STEPS:
                return place, signal, ss / determinant
            score_t = np.einsum("ij,ij->i", residual, by_time)
            score_s = np.einsum("ij,ij->i", residual, g)
            move = (ss * score_t - ts * score_s) / determinant
            grow = (tt * score_s - ts * score_t) / determinant
            place = np.clip(place + np.clip(move, -1.0, 1.0), low, high)
            signal = np.maximum(signal + grow, np.float32(0.1) * signal)
        raise AssertionError("the last step returns")

    def _response_at(self, place: Array) -> tuple[Array, Array]:
        """Return response and derivative (pixels, window) of pulses at places within the window."""
        inside = (place + np.float32(self._reach)) * np.float32(_PLACES)
        entry = np.clip(inside.astype(np.intp), 0, len(self._table) - 1)
        rest = (inside - entry - np.float32(0.5)) / np.float32(_PLACES)
        g, slope = self._table[entry], self._slope[entry]
        g += rest[:, None] * slope
        return g, slope


def _running_sum(values: Array, width: int, *, out: Array) -> Array:
    """Return in ``out`` the sums of ``width`` consecutive rows (rows - width + 1, columns)."""
    rows = len(values) - width + 1
    total = out[:rows]
    np.copyto(total, values[:rows])
    for k in range(1, width):
        np.add(total, values[k : k + rows], out=total)
    return total


def fisher_sigma(
    detector: SinglePhotonDetector, *, distance: float, signal: float, background: float, cycles: int
) -> float:
    """Return the Cramer-Rao bound of a distance's 1-sigma in metres, in float64 from all bins.

    ``signal`` and ``background`` [counts per exposure, without pile-up]; time, signal and background unknown.
    Expected ready and remaining cycles take the place of counted ones.
    """
    # bins without any light would have infinite information
    background = max(background, _FAINTEST)
    time = np.array([distance * 2.0 / SPEED_OF_LIGHT])
    step = 1e-4 * detector.time_sigma
    g = detector.response(time)[:, 0]
    by_time = (detector.response(time + step)[:, 0] - detector.response(time - step)[:, 0]) / (2 * step)
    rate = (signal * g + background / detector.bins) / cycles
    # of the cycles each detection costs some
    ready = cycles / (1.0 - detector.missed_cycles * math.expm1(-float(rate.sum())))
    left = ready * np.exp(-(np.cumsum(rate) - rate))
    columns = np.stack([signal * by_time, g, np.full_like(g, 1.0 / detector.bins)], axis=1) / cycles
    scale = np.array([1.0 / detector.time_sigma, max(signal, 1.0), max(background, 1.0)])
    columns *= np.array([1.0 / scale[0], scale[1], scale[2]])
    information = columns.T @ (columns * (left / np.expm1(rate))[:, None])
    variance = float(np.linalg.inv(information)[0, 0]) / scale[0] ** 2
    return math.sqrt(variance) * SPEED_OF_LIGHT / 2.0
