"""Variances of single distances from frames of one scene, by amplitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rim_camera_ros.frame import RawFrame

Array = NDArray[np.float64]

#: Number of classes of amplitude, and the least number of values for one to be used.
CLASSES = 24
LEAST_VALUES = 200
#: Frames of a group; a longer one is cut, so that a slow drift does not count as noise.
_LONGEST = 100
#: Most pixels of a group whose variances are kept.
_KEPT = 40_000
#: Share of the variances, the smallest, that is used: edges and flipped bits are in the rest.
_TRIMMED = 0.9
#: Ratio of the variance over two frames to that over one, or to that between neighbours, above which there is
#: motion.
_MOVING = 1.5
#: Neighbours whose amplitudes differ by more than this share do not show the same surface.
_ALIKE = 0.2


@dataclass(frozen=True)
class NoiseClass:
    """Pixels of like amplitude [counts]: variance of one distance [m^2] with its standard error."""

    amplitude: float
    variance: float
    error: float
    values: int


@dataclass(frozen=True)
class NoiseData:
    """Results of repeated frames: the classes, the numbers of groups and frames, whether there is motion.

    ``moving``: no group was at rest; the variances are the remaining ones between neighbouring pixels.
    """

    classes: tuple[NoiseClass, ...]
    frames: int
    moving: bool


class RepeatedFrames:
    """Collects variances by groups, which are consecutive frames of one pose and setting.

    ``lsb``: metres per count (1 for distances in metres); ``period``: metres after which distances wrap, None
    if they do not; ``saturation`` in counts. Memory does not grow with the number of frames in a group.
    """

    def __init__(self, *, lsb: float, period: float | None, saturation: float) -> None:
        self._lsb, self._period, self._saturation = lsb, period, saturation
        self._resting: list[tuple[Array, Array, float]] = []
        self._neighbours: list[tuple[Array, Array]] = []
        self._frames = self._resting_frames = 0
        self._group: _Group | None = None
        self._last: RawFrame | None = None

    def add(self, frame: RawFrame) -> None:
        """Take a frame."""
        self._frames += 1
        if self._last is not None and self._last.shape == frame.shape:
            self._between(self._last, frame)
        same = self._last is not None and _alike(self._last, frame)
        if self._group is None or not same or self._group.frames >= _LONGEST:
            self._close()
            self._group = _Group(frame.shape, self._period)
        self._group.add(*self._values(frame))
        self._last = frame

    def result(self) -> NoiseData:
        """Return the results, without classes that have too few values."""
        self._close()
        if self._resting:
            rows = self._resting
            amplitude = np.concatenate([row[0] for row in rows])
            variance = np.concatenate([row[1] for row in rows])
            freedom = np.concatenate([np.full(row[0].size, row[2]) for row in rows])
            return NoiseData(
                _classes(amplitude, variance, freedom, self._rounding), self._resting_frames, False
            )
        if not self._neighbours:
            return NoiseData((), 0, False)
        amplitude, variance = (
            np.concatenate([neighbour[i] for neighbour in self._neighbours]) for i in range(2)
        )
        found = _classes(amplitude, variance, np.ones(amplitude.size), self._rounding)
        return NoiseData(found, self._frames, True)

    @property
    def _rounding(self) -> float:
        return self._lsb**2 / 12 if self._lsb != 1.0 else 0.0

    def _values(self, frame: RawFrame) -> tuple[Array, Array, NDArray[np.bool_]]:
        counts = frame.distance.dtype == np.uint16
        distance = np.nan_to_num(frame.distance.astype(np.float64)) * (self._lsb if counts else 1.0)
        amplitude = np.nan_to_num(frame.amplitude.astype(np.float64))
        return distance, amplitude, (distance > 0) & (amplitude > 0) & (amplitude < self._saturation)

    def _between(self, before: RawFrame, frame: RawFrame) -> None:
        """Keep second differences along rows of the difference of two frames, in which planes cancel."""
        d0, a0, valid0 = self._values(before)
        d1, a1, valid1 = self._values(frame)
        step = _wrapped(d1 - d0, self._period)
        amplitude = (a0 + a1) / 2
        valid = valid0 & valid1 & (np.abs(a1 - a0) < _ALIKE * amplitude)
        middle, sides = slice(1, -1), (slice(None, -2), slice(2, None))
        good = valid[:, middle] & valid[:, sides[0]] & valid[:, sides[1]]
        for one in sides:
            good &= np.abs(amplitude[:, one] - amplitude[:, middle]) < _ALIKE * amplitude[:, middle]
        bend = step[:, sides[0]] - 2 * step[:, middle] + step[:, sides[1]]
        # six times the variance of a difference, twice that of one distance
        chosen = _thinned(good, _KEPT // 8)
        self._neighbours.append((amplitude[:, middle][chosen], bend[chosen] ** 2 / 12))
        if len(self._neighbours) > 400:
            del self._neighbours[::2]

    def _close(self) -> None:
        group, self._group = self._group, None
        if group is None or group.frames < 2:
            return
        found = group.variances()
        if found is not None:
            self._resting.append(found)
            self._resting_frames += group.frames


class _Group:
    """Sums per pixel over consecutive frames."""

    def __init__(self, shape: tuple[int, int], period: float | None) -> None:
        self.frames = 0
        self._period = period
        self._count = np.zeros(shape, np.int32)
        self._amplitude, self._once, self._twice, self._across = (np.zeros(shape) for _ in range(4))
        self._before: list[Array] = []

    def add(self, distance: Array, amplitude: Array, valid: NDArray[np.bool_]) -> None:
        self.frames += 1
        self._count += valid
        self._amplitude += np.where(valid, amplitude, 0.0)
        if self._before:
            step = _wrapped(distance - self._before[-1], self._period)
            self._once += step**2
            self._across[:, 1:] += np.diff(step, axis=1) ** 2 / 2
        if len(self._before) == 2:
            self._twice += _wrapped(distance - self._before[0], self._period) ** 2
        self._before = [*self._before[-1:], distance]

    def variances(self) -> tuple[Array, Array, float] | None:
        """Return amplitudes, variances and their degrees of freedom; None for a group that is not at rest."""
        n = self.frames
        good = self._count == n
        if good.sum() < LEAST_VALUES:
            return None
        variance = self._once / (2 * (n - 1))
        level = float(np.median(variance[good]))
        pairs = good[:, 1:] & good[:, :-1]
        across = float(np.median((self._across[:, 1:] / (2 * (n - 1)))[pairs])) if pairs.any() else level
        # shared by neighbours, or growing with time: motion or drift, not noise of single pixels
        if level > 0 and across * _MOVING < level:
            return None
        if n > 2 and float(np.median((self._twice / (2 * (n - 2)))[good])) > _MOVING * level > 0:
            return None
        chosen = _thinned(good, _KEPT)
        # degrees of freedom of the mean square of successive differences (von Neumann 1941)
        freedom = 2 * (n - 1) ** 2 / (3 * n - 4)
        return (self._amplitude / n)[chosen], variance[chosen], freedom


def _alike(before: RawFrame, frame: RawFrame) -> bool:
    return (
        before.shape == frame.shape
        and dict(before.pose_stamps) == dict(frame.pose_stamps)
        and before.settings.integration_time == frame.settings.integration_time
    )


def _wrapped(step: Array, period: float | None) -> Array:
    return step if period is None else (step + period / 2) % period - period / 2


def _thinned(good: NDArray[np.bool_], most: int) -> tuple[NDArray[Any], ...]:
    """Return the places of true values, at most ``most`` of them, evenly spaced."""
    places = np.flatnonzero(good)
    if places.size > most:
        places = places[np.linspace(0, places.size - 1, most).astype(np.int64)]
    return np.unravel_index(places, good.shape)


def _classes(amplitude: Array, variance: Array, freedom: Array, rounding: float) -> tuple[NoiseClass, ...]:
    """Return mean variances by classes of amplitude, without the greatest tenth and corrected for it."""
    if amplitude.size < LEAST_VALUES:
        return ()
    number = min(CLASSES, amplitude.size // LEAST_VALUES)
    edges = np.quantile(np.log(amplitude), np.linspace(0, 1, number + 1))
    member = np.clip(np.searchsorted(edges, np.log(amplitude), side="right") - 1, 0, number - 1)
    found = []
    for k in range(number):
        mine = member == k
        if mine.sum() < LEAST_VALUES // 2:
            continue
        level, error = _trimmed_mean(variance[mine], float(np.mean(freedom[mine])))
        level -= rounding
        if level > 0:
            centre = float(np.exp(np.mean(np.log(amplitude[mine]))))
            found.append(NoiseClass(centre, level, error, int(mine.sum())))
    return tuple(found)


def _trimmed_mean(variance: Array, freedom: float) -> tuple[float, float]:
    """Return the mean of chi-square distributed variances from their lower part, and its standard error."""
    limit = float(np.quantile(variance, _TRIMMED))
    kept = variance[variance <= limit]
    share = kept.size / variance.size
    # for a chi-square variable x with f degrees of freedom E[x; x < c] = f P(x' < c), with x' of f + 2
    cut = float(chi2.ppf(min(share, 1 - 1e-9), freedom))
    below = float(chi2.cdf(cut, freedom + 2)) / share
    level = float(kept.mean()) / below
    return level, level * float(np.sqrt(2 / (freedom * variance.size))) * 1.2
