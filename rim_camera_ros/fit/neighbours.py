"""How the noise of pixels correlates with that of pixels near and far, from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Lags [px] of neighbours, and one that no filter of a driver reaches.
NEAR, FAR = (1, 2), 6
_LEAST_PIXELS = 50


@dataclass(frozen=True)
class Neighbours:
    """Correlations of the noise of the phase with that of pixels ``near`` (at `NEAR` px) and ``far`` (`FAR`).

    Each is a mean along rows and columns, 0 where pixels are independent; ``far_later`` is that among the
    frames after the first, which may contain a remainder of the exposure before (0 where there are none).
    ``pairs`` is the number of independent pairs, ``pairs_later`` that in the frames after the first: the
    standard deviation of a correlation of independent pixels is 1 over its root.
    """

    near: tuple[float, ...]
    far: float
    far_later: float
    pairs: float
    pairs_later: float

    @property
    def sigma(self) -> float:
        """Standard deviation of the correlations of independent pixels."""
        return 1.0 / float(np.sqrt(max(self.pairs, 1.0)))

    @property
    def sigma_later(self) -> float:
        """Standard deviation of that in the frames after the first."""
        return 1.0 / float(np.sqrt(max(self.pairs_later, 1.0)))


def neighbours_of(frames: Array) -> Neighbours | None:
    """Examine complex images (F, H, W) [counts] of one scene, 0 where a pixel was not valid.

    The deviations of the phase are those in counts, at right angles to the light, which noise makes alike in
    bright and dark pixels. None for fewer than two frames or too few pixels.
    """
    valid = (frames != 0).all(axis=0)
    if len(frames) < 2 or valid.sum() < _LEAST_PIXELS:
        return None
    deviation = _of_phase(frames, valid)
    near = tuple(_correlation(deviation, valid, lag)[0] for lag in NEAR)
    far, pairs = _correlation(deviation, valid, FAR)
    later = _correlation(_of_phase(frames[1:], valid), valid, FAR)[0] if len(frames) > 2 else 0.0
    return Neighbours(near, far, later, pairs * (len(frames) - 1), pairs * (len(frames) - 2))


def _of_phase(frames: Array, valid: Array) -> Array:
    light = np.where(valid, frames.mean(axis=0), 0)
    across = np.where(valid, light.conj() / np.maximum(np.abs(light), 1e-12), 0)
    return np.asarray(((frames - light) * across).imag)


def _correlation(deviation: Array, valid: Array, lag: int) -> tuple[float, float]:
    """Return the correlation at a lag along rows and columns, and the number of pairs of pixels."""
    product, square, pairs = 0.0, 0.0, 0
    for axis in (1, 2):
        size = deviation.shape[axis]
        if size <= lag:
            continue
        a, b = (deviation.take(np.arange(*span), axis=axis) for span in ((lag, size), (0, size - lag)))
        p, q = (valid.take(np.arange(*span), axis=axis - 1) for span in ((lag, size), (0, size - lag)))
        both = p & q
        product += float((a * b)[:, both].sum())
        square += 0.5 * float((a**2)[:, both].sum() + (b**2)[:, both].sum())
        pairs += int(both.sum())
    return (product / square if square > 0 else 0.0), float(pairs)


def pooled(each: Iterable[Neighbours | None]) -> Neighbours | None:
    """Return the mean over stations, weighted by their pairs; None where no station has several frames."""
    known = [one for one in each if one is not None and one.pairs > 0]
    if not known:
        return None
    weight = np.array([one.pairs for one in known])
    near = np.average([one.near for one in known], axis=0, weights=weight)
    far, later = np.average([(one.far, one.far_later) for one in known], axis=0, weights=weight)
    later_pairs = sum(one.pairs_later for one in known)
    return Neighbours(tuple(near.tolist()), float(far), float(later), float(weight.sum()), later_pairs)
