"""Variation from frame to frame that all pixels share: light of another camera, or a moving surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import polygamma

Array = NDArray[Any]

#: Least number of pixels that were valid in all frames.
_LEAST_PIXELS = 50


@dataclass(frozen=True)
class Movement:
    """Two models of the changes between a station's frames: a plane that tilts, and common light.

    Each model has two numbers per frame. ``by_tilt`` and ``by_light`` are the chi-squares that they explain.
    ``of_phase`` is the logarithm of the ratio of what tilts of the phase explain to what tilts of the
    amplitude explain, summed over stations: uneven light of a second camera tilts both alike, a movement
    tilts distances alone.
    ``rim`` [m] is the RMS over the frames of how far tilts move distances at the rim of the array.
    ``steps`` and ``spread`` are of the numbers of the better model: the sum of squares of their changes from
    one frame to the next, and that of their deviations from the mean. Their ratio is 2 where frames are
    independent (von Neumann 1941), and near 0 where they follow a drift. ``later`` is the sum of squares of
    the deviations of all frames but the first from their own mean. ``freedom`` is the number of frames less
    1, summed over ``number`` stations.
    """

    by_tilt: float
    by_light: float
    of_phase: float
    rim: float
    steps: float
    spread: float
    later: float
    freedom: int
    number: int = 1

    @property
    def persistence(self) -> float:
        """Correlation of frames with those before them: 0 where they are independent, 1 at most."""
        return 1.0 - self.steps / (2.0 * self.spread) if self.spread > 0 else 0.0

    @property
    def first(self) -> float:
        """The share of the spread that is due to the difference of the first frame from the others."""
        return 1.0 - self.later / self.spread if self.spread > 0 else 0.0

    @property
    def tilts(self) -> float:
        """Significance [sigmas] of tilts of distances alone, against equal tilts of amplitudes."""
        # the logarithm of the ratio of two equal sums of F - 1 squares
        sigma = np.sqrt(2.0 * self.number * polygamma(1, max(self.frames - 1.0, 1.0) / 2.0))
        return float(self.of_phase / sigma)

    @property
    def begins(self) -> float:
        """F ratio of the first frame's deviation from the others to that of independent frames (then 1)."""
        others = self.freedom - self.number
        if others <= 0 or not self.spread > 0:
            return 0.0
        return (self.spread - self.later) / self.number / max(self.later / others, 1e-12)

    @property
    def first_in_drift(self) -> float:
        """The value of `first` where the persistence is due to a drift in noise, of more than two frames.

        A steady drift of n frames has a persistence of 1 - 6 / (n (n + 1)), and 3 / (n + 1) of its spread is
        due to the first; a random walk of three frames is like a drift with half of the spread, and noise.
        """
        n = self.frames
        drift = self.persistence / (1.0 - 6.0 / (n * (n + 1.0)))
        return self._first(drift, 3.0 / (n + 1.0))

    @property
    def first_where_it_begins(self) -> float:
        """The value of `first` where the persistence is due to first frames alone, of more than two frames.

        Without noise the persistence is then 1 - n / (2 (n - 1)), and all of the spread is due to the first.
        """
        n = self.frames
        return self._first(self.persistence / (1.0 - n / (2.0 * (n - 1.0))), 1.0)

    def _first(self, share: float, own: float) -> float:
        share = min(max(share, 0.0), 1.0)
        return share * own + (1.0 - share) / (self.frames - 1.0)

    @property
    def frames(self) -> float:
        """Frames of a station, on average."""
        return self.freedom / self.number + 1.0

    @property
    def persistence_sigma(self) -> float:
        """Standard deviation of the persistence of so many independent frames, of two numbers each."""
        frames = self.frames
        single = (frames - 2.0) / (frames**2 - 1.0) if frames > 2 else 0.5
        return float(np.sqrt(single / (2.0 * self.number)))


def together(movements: Sequence[Movement]) -> Movement:
    """Return the sums of several stations, one at least; ``rim`` is the largest of them."""
    return Movement(
        by_tilt=sum(movement.by_tilt for movement in movements),
        by_light=sum(movement.by_light for movement in movements),
        of_phase=sum(movement.of_phase for movement in movements),
        rim=max(movement.rim for movement in movements),
        steps=sum(movement.steps / movement.spread for movement in movements if movement.spread > 0),
        spread=float(sum(movement.spread > 0 for movement in movements)),
        later=sum(movement.later / movement.spread for movement in movements if movement.spread > 0),
        freedom=sum(movement.freedom for movement in movements),
        number=len(movements),
    )


@dataclass(frozen=True)
class CommonVariation:
    """``ratio`` and ``light`` [counts^2] as `Station.common` and `Station.common_light`, and the movement."""

    ratio: float
    light: float
    movement: Movement


def common_variation(frames: Array, ambiguity: float) -> CommonVariation | None:
    """Examine complex images (F, H, W) [counts] of one scene, 0 where a pixel was not valid.

    ``ambiguity`` [m] is a turn of the phase. Only variation that is not in proportion to the light itself
    counts, as power and phase of the emitter vary a little. None for fewer than two frames or too few pixels.
    """
    if len(frames) < 2:
        return None
    valid = (frames != 0).all(axis=0)
    stack = frames[:, valid]
    if stack.shape[1] < _LEAST_PIXELS:
        return None
    light = stack.mean(axis=0)
    deviation = stack - light
    freedom = len(stack) - 1
    variance = (np.abs(deviation) ** 2).sum(axis=0) / freedom
    # noise grows with the amplitude where the floor prevails: those pixels contain little information
    weight = 1.0 / np.maximum(variance, np.quantile(variance, 0.2) + 1e-12)
    own = 1.0 - light * (weight * light.conj()).sum() / (weight * np.abs(light) ** 2).sum()
    total = (deviation * (weight * own.conj())).sum(axis=1)
    expected = (weight**2 * np.abs(own) ** 2 * variance).sum() * freedom / len(stack)
    if not expected > 0:
        return None
    found = float((np.abs(total) ** 2).mean())
    # the response to light that is the same in all pixels, less what it adds to the variances
    seen = (weight * np.abs(own) ** 2).sum() ** 2 - (weight**2 * np.abs(own) ** 2).sum()
    seen *= freedom / len(stack)
    movement = _movement(deviation, light, weight, valid, ambiguity)
    return CommonVariation(float(found / expected), float((found - expected) / seen), movement)


def _movement(deviation: Array, light: Array, weight: Array, valid: Array, ambiguity: float) -> Movement:
    """Compare tilts of the phase and common light as explanations of deviations (F, N) of the light."""
    root = np.sqrt(2.0 * weight)

    def as_columns(*images: Array) -> Array:
        return np.stack(
            [np.concatenate([(image * root).real, (image * root).imag]) for image in images], axis=1
        )

    rows, columns = (one / (n / 2) - 1.0 for one, n in zip(np.nonzero(valid), valid.shape, strict=True))
    known, _ = np.linalg.qr(as_columns(light, 1j * light))
    one = np.ones(len(light))
    readings = as_columns(*deviation)

    def explained(*images: Array) -> tuple[float, Array]:
        design = as_columns(*images)
        basis, triangle = np.linalg.qr(design - known @ (known.T @ design))
        parts = basis.T @ readings
        return float((parts**2).sum()), np.linalg.lstsq(triangle, parts, rcond=1e-9)[0].T

    by_light, phasors = explained(one, 1j * one)
    by_tilt, tilts = explained(1j * light * rows, 1j * light * columns)
    of_amplitude, _ = explained(light * rows, light * columns)
    series = tilts if by_tilt > by_light else phasors
    return Movement(
        by_tilt=by_tilt,
        by_light=by_light,
        of_phase=float(np.log(by_tilt / of_amplitude)) if min(by_tilt, of_amplitude) > 0 else 0.0,
        rim=float(np.sqrt(np.mean(np.abs(tilts).sum(axis=1) ** 2)) * ambiguity / (2 * np.pi)),
        steps=float((np.diff(series, axis=0) ** 2).sum()),
        spread=float(((series - series.mean(axis=0)) ** 2).sum()),
        later=float(((series[1:] - series[1:].mean(axis=0)) ** 2).sum()),
        freedom=len(deviation) - 1,
    )
