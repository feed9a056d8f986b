"""Histograms of first photons -> distance, signal, precision: likelihood of a pulse on a background.

A pixel's histogram n_i is binomial. Of the R_i ready cycles that reach bin i without a detection, n_i have a
detection there, with probability 1 - exp(-r_i), r_i = S g_i(t) + b, where S and b are signal and background
per cycle and g is the response of the detector. The likelihood thus contains Coates' correction of pile-up
(`first_photon.coates`). The bin of the pulse is found by a matched filter. From there Fisher scoring finds t
and S, with the background of all bins outside of the pulse. The precision is the Cramer-Rao bound: the
inverse of the Fisher information sum_i R_i / (exp(r_i) - 1) dr_i/dtheta dr_i/dtheta'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.phasor import SPEED_OF_LIGHT
from rim_camera_ros.single_photon.detector import SinglePhotonDetector

Array = NDArray[Any]

#: Half the width of the window of bins around the pulse, in its standard deviations.
_HALF_WINDOW = 4.0
#: Number of places in a bin for which the response is tabulated; between them it is extrapolated linearly.
_PLACES = 128
#: Steps of Fisher scoring from the centre of gravity around the matched filter's bin.
_STEPS = 2
#: Two running sums, each this many standard deviations of the pulse wide, give a triangle of its variance.
_TRIANGLE = math.sqrt(6.0)
#: Number of pixels per block: with more the arrays do not fit in the processor's cache, with fewer the calls
#: take too long (64 x 48 pixels of 128 bins: 5.3 ms in blocks of 512, 4.3 of 1024, 4.1 of 1536).
_BLOCK = 1536
#: Least background [counts per exposure] of the Cramer-Rao bound.
_FAINTEST = 1e-6
#: Rates per cycle up to which four terms of the series of exp(r) - 1 are exact to 1e-5.
_SMALL = 0.15
#: Least rates per cycle: a bin without any light still has a likelihood.
_LEAST = 1e-12


@dataclass(frozen=True)
class PulseEstimates:
    """Estimates from the histograms of pixels, all (pixels,) float32.

    ``distance`` [m] in [0, L), NaN where nothing was detected; ``signal``: photons of the pulse that would
    have been detected in the exposure without pile-up; ``background``: all other detections, likewise;
    ``sigma`` [m]: Cramer-Rao bound of the distance's standard deviation.
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
        self._scratch = [np.empty((rows, _BLOCK), np.float32) for _ in range(3)]
        self._pair = [np.empty((detector.bins, _BLOCK), np.float32) for _ in range(2)]

    def _responses(self) -> tuple[Array, Array]:
        """Return the response (window, places) and its derivative by the time in bins.

        It is for pulses from `_reach` bins before the window's middle bin to as many bins behind it.
        """
        detector = self.detector
        middle = detector.bins // 2
        places = (np.arange((2 * self._reach + 1) * _PLACES) + 0.5) / _PLACES - self._reach
        bins = middle + self._offsets

        def at(place: Array) -> Array:
            return detector.response((middle + place) * detector.bin_width)[bins].T

        step = 1e-3
        slope = (at(places + step) - at(places - step)) / (2 * step)
        tables = [np.ascontiguousarray(one.T, np.float32) for one in (at(places), slope)]
        return tables[0], tables[1]

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
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(PulseEstimates))
        )

    def _block(self, histogram: Array, cycles: int) -> PulseEstimates:
        """Return the estimates of a few pixels, whose arrays stay in the processor's cache."""
        detector = self.detector
        size = histogram.shape[1]
        counts, left = (one.ravel()[: detector.bins * size].reshape(-1, size) for one in self._pair)
        np.copyto(counts, histogram, casting="unsafe")
        all_counts = counts.sum(axis=0)
        np.subtract(np.float32(cycles), np.float32(detector.missed_cycles) * all_counts, out=left[0])
        for i in range(1, len(left)):
            np.subtract(left[i - 1], counts[i - 1], out=left[i])
        np.maximum(left, np.float32(1.0), out=left)
        all_left = left.sum(axis=0)
        peak = self._peak(counts, left, all_counts / all_left)
        at = (peak + self._offsets[:, None]) % detector.bins
        at *= size
        at += np.arange(size)
        # indices are in range: mode "wrap" is used as it does not check them first
        n, r = (np.take(count, at, mode="wrap") for count in (counts, left))
        outside = np.maximum(all_left - r.sum(axis=0), np.float32(1.0))
        share = np.clip((all_counts - n.sum(axis=0)) / outside, np.float32(0.0), np.float32(1.0 - 1e-7))
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

        The score is the excess over its standard deviation, (n_i - b R_i) / sqrt(R_i), weighted with the
        shape of the pulse. Late bins, for which pile-up leaves few cycles, have the small weight that is due
        to them.
        """
        bins, size = counts.shape
        margin = 2 * (self._triangle - 1)
        excess, once, pairs = (
            one.ravel()[: (bins + margin) * size].reshape(-1, size) for one in self._scratch
        )
        score = excess[:bins]
        np.multiply(left, mean, out=score)
        np.subtract(counts, score, out=score)
        np.sqrt(left, out=once[:bins])
        np.divide(score, once[:bins], out=score)
        np.copyto(excess[bins:], excess[:margin])
        once = _running_sum(excess, self._triangle, out=once, pairs=pairs)
        score = _running_sum(once, self._triangle, out=excess, pairs=pairs)
        # argmax by operations on whole rows, which takes a fraction of the time of argmax by columns
        best = np.equal(score, score.max(axis=0)) * self._numbers
        # a sum that begins in a bin is centred `triangle - 1` bins behind it
        return np.asarray((best.max(axis=0).astype(np.intp) + self._triangle - 1) % bins)

    def _score(self, n: Array, r: Array, background: Array) -> tuple[Array, Array, Array]:
        """Return place [bins behind the peak's beginning], signal per cycle, variance of the place [bins^2].

        ``n``, ``r``: detections and remaining cycles (window, pixels).
        """
        rate = n / r
        np.minimum(rate, np.float32(1 - 1e-6), out=rate)
        np.negative(rate, out=rate)
        np.log1p(rate, out=rate)
        np.negative(rate, out=rate)
        rate -= background
        total = rate.sum(axis=0)
        signal = np.maximum(total, np.float32(_LEAST))
        low, high = np.float32(-self._reach), np.float32(self._reach + 1)
        # from the centre of gravity
        rate *= (self._offsets[:, None] + 0.5).astype(np.float32)
        place = np.clip(rate.sum(axis=0) / signal, low, high)
        product = rate
        for step in range(_STEPS + 1):
            g, by_time = self._response_at(place)
            total = g * signal
            total += background
            by_time *= signal
            exceeding = _expm1(total)
            # d log L / d r_i = n_i exp(r) / (exp(r) - 1) - R_i; information R_i / (exp(r) - 1)
            if step < _STEPS:
                residual = np.divide(n, exceeding, out=total)
                residual += n
                residual -= r
            weight = np.divide(r, exceeding, out=exceeding)
            if step < _STEPS:
                score_t = np.multiply(residual, by_time, out=product).sum(axis=0)
                score_s = np.multiply(residual, g, out=product).sum(axis=0)
            by_signal = np.multiply(weight, g, out=product)
            ts = (by_signal * by_time).sum(axis=0)
            by_signal *= g
            ss = by_signal.sum(axis=0)
            by_time *= by_time
            by_time *= weight
            tt = by_time.sum(axis=0)
            determinant = np.maximum(tt * ss - ts * ts, np.float32(1e-30))
            if step == _STEPS:
                return place, signal, ss / determinant
            move = (ss * score_t - ts * score_s) / determinant
            grow = (tt * score_s - ts * score_t) / determinant
            place = np.clip(place + np.clip(move, np.float32(-1.0), np.float32(1.0)), low, high)
            signal = np.maximum(signal + grow, np.float32(0.1) * signal)
        raise AssertionError("the last step returns")

    def _response_at(self, place: Array) -> tuple[Array, Array]:
        """Return response and derivative (window, pixels) of pulses at places within the window."""
        inside = (place + np.float32(self._reach)) * np.float32(_PLACES)
        entry = np.clip(inside.astype(np.intp), 0, self._table.shape[1] - 1)
        rest = (inside - entry.astype(np.float32) - np.float32(0.5)) / np.float32(_PLACES)
        # entries are in range: mode "clip" is used as it does not check them first
        g, slope = (np.take(one, entry, axis=1, mode="clip") for one in (self._table, self._slope))
        g += rest * slope
        return g, slope


def _expm1(values: Array) -> Array:
    """Return exp(values) - 1 of positive float32: by its series where all are small, which is faster."""
    if values.size and values.max() > _SMALL:
        return np.expm1(values)
    result = values * np.float32(1 / 24)
    for coefficient in (1 / 6, 1 / 2, 1.0):
        result += np.float32(coefficient)
        result *= values
    return np.asarray(result)


def _running_sum(values: Array, width: int, *, out: Array, pairs: Array) -> Array:
    """Return in ``out`` the sums of ``width`` consecutive rows (rows - width + 1, columns).

    It uses sums of two rows, which halves the number of additions. ``pairs`` is overwritten; the arrays must
    not overlap.
    """
    rows = len(values) - width + 1
    total, pairs = out[:rows], pairs[: len(values) - 1]
    if width < 2:
        np.copyto(total, values)
        return total
    np.add(values[:-1], values[1:], out=pairs)
    np.copyto(total, pairs[:rows]) if width < 4 else np.add(pairs[:rows], pairs[2 : 2 + rows], out=total)
    for k in range(4, width - 1, 2):
        np.add(total, pairs[k : k + rows], out=total)
    if width % 2:
        np.add(total, values[width - 1 :], out=total)
    return total


def fisher_sigma(
    detector: SinglePhotonDetector, *, distance: float, signal: float, background: float, cycles: int
) -> float:
    """Return the Cramer-Rao bound of a distance's 1-sigma in metres, in float64 from all bins.

    ``signal`` and ``background`` [counts per exposure, without pile-up]. Time, signal and background are the
    unknowns. Expected numbers of ready and remaining cycles are used in place of counted ones.
    """
    # bins without any light would have infinite information
    background = max(background, _FAINTEST)
    time = np.array([distance * 2.0 / SPEED_OF_LIGHT])
    step = 1e-4 * detector.time_sigma
    g = detector.response(time)[:, 0]
    by_time = (detector.response(time + step)[:, 0] - detector.response(time - step)[:, 0]) / (2 * step)
    rate = (signal * g + background / detector.bins) / cycles
    # each detection costs some of the cycles
    ready = cycles / (1.0 - detector.missed_cycles * math.expm1(-float(rate.sum())))
    left = ready * np.exp(-(np.cumsum(rate) - rate))
    columns = np.stack([signal * by_time, g, np.full_like(g, 1.0 / detector.bins)], axis=1) / cycles
    scale = np.array([1.0 / detector.time_sigma, max(signal, 1.0), max(background, 1.0)])
    columns *= np.array([1.0 / scale[0], scale[1], scale[2]])
    information = columns.T @ (columns * (left / np.expm1(rate))[:, None])
    variance = float(np.linalg.inv(information)[0, 0]) / scale[0] ** 2
    return math.sqrt(variance) * SPEED_OF_LIGHT / 2.0
