"""Elimination of the offset and the gain of each pixel from sums over stations.

They are the most numerous unknowns of an adjustment. The equations link those of different pixels only
through the other unknowns, so that a Schur complement eliminates them block by block of the pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.fold_sums import Fold

Array = NDArray[Any]


#: 1-sigma of the fixed pattern's prior [m]: as good as unknown, also in the mean of all pixels. With 50 mm
#: for each pixel the mean of 6,000 pixels would be known to 0.6 mm, and every smooth field nearly as well.
#: Real patterns are not known so well, and effects that are smooth over the array would gain by that.
PATTERN_PRIOR = 5.0
#: Number of pixels whose sums are put together at once.
_BLOCK = 2048
_ROUNDING = 1e-10


@dataclass(frozen=True)
class PixelPriors:
    """Priors of every pixel: 1-sigma of its ``offset`` [m] and of its relative ``gain`` (0: known).

    ``gains_at`` (P,) are the logarithms of the gains at the point of linearisation; their prior has the mean
    0. ``seen`` are the numbers of the P pixels that have sums, in an array of ``size`` pixels (None: all);
    the others keep the means of their priors.
    """

    offset: float = PATTERN_PRIOR
    gain: float = 0.0
    gains_at: Array | None = None
    seen: Array | None = None
    size: int = 0

    def everywhere(self, values: Array) -> Array:
        """Return values of the pixels that were seen (P, ...) for all pixels, 0 elsewhere."""
        if self.seen is None:
            return values
        result = np.zeros((self.size, *values.shape[1:]))
        result[self.seen] = values
        return result

    def where_seen(self, values: Array) -> Array:
        """Return values of all pixels (N, ...) for those that were seen (P, ...)."""
        return values if self.seen is None else np.asarray(values[self.seen])


class PixelElimination:
    """Elimination of the offset and the gain of each pixel from the sum of some folds.

    The two unknowns of each pixel are made independent of each other. ``rows`` returns the rows of a matrix
    R; the elimination subtracts R' R from the normal matrix.
    """

    def __init__(self, folds: Sequence[Fold], count: int, priors: PixelPriors) -> None:
        self._folds, self._count, self._priors = folds, count, priors
        self._a: Array = np.sum([fold.weight for fold in folds], axis=0) + priors.offset**-2
        # a fold without gains had no pixel of this camera
        self.with_gains = priors.gain > 0 and all(fold.gain is not None for fold in folds)
        at = priors.gains_at
        self.log_norm = 0.5 * float(np.sum(np.log(self._a * priors.offset**2)))
        self.square = 0.0
        if self.with_gains:
            weight = np.sum([_given(fold.gain_weight) for fold in folds], axis=0)
            self._b: Array = np.sum([_given(fold.cross) for fold in folds], axis=0)
            # the weight given the offset cannot be negative
            alone = np.maximum(weight - self._b**2 / self._a, _ROUNDING * weight)
            self._c = alone + priors.gain**-2
            self._pull = np.zeros(len(self._a)) if at is None else at / priors.gain**2
            self.log_norm += 0.5 * float(np.sum(np.log(self._c * priors.gain**2)))
            self.square = 0.0 if at is None else float(np.sum((at / priors.gain) ** 2))

    def blocks(self) -> Iterator[slice]:
        """Yield blocks of pixels: the sums of all pixels at once would be the largest array of all."""
        for first in range(0, len(self._a), _BLOCK):
            yield slice(first, min(first + _BLOCK, len(self._a)))

    def rows(self, block: slice) -> list[Array]:
        """Return the rows (N, M) of a block's pixels, ordered as by `stacked`: of offsets, and of gains."""
        offset = _sums(self._folds, self._count, block)
        if not self.with_gains:
            return self.whitened(block, offset, None)
        gain = _sums(self._folds, self._count, block, gain=True)
        gain[:, -1] -= self._pull[block]
        return self.whitened(block, offset, gain)

    def whitened(self, block: slice, offset: Array, gain: Array | None) -> list[Array]:
        """Return sums of a block's pixels (N, R) in units of independent noise; arguments are overwritten."""
        result = [offset]
        if self.with_gains:
            assert gain is not None
            gain -= offset * (self._b[block] / self._a[block])[:, None]
            gain /= np.sqrt(self._c[block])[:, None]
            result.append(gain)
        offset /= np.sqrt(self._a[block])[:, None]
        return result

    def sums_of(self, block: slice, noise: Sequence[Array]) -> tuple[Array, Array | None]:
        """Return sums of a block's pixels (N, R) from independent noise: the inverse of `whitened`."""
        offset = np.sqrt(self._a[block])[:, None] * noise[0]
        if not self.with_gains:
            return offset, None
        share = (self._b[block] / self._a[block])[:, None]
        return offset, share * offset + np.sqrt(self._c[block])[:, None] * noise[1]

    def solve(self, values: Array) -> tuple[Array, Array | None]:
        """Return offsets [m] and changes of gains of all pixels, given the other unknowns as in `stacked`."""
        offset = -_times(self._folds, self._count, values)
        everywhere = self._priors.everywhere
        if not self.with_gains:
            return everywhere(offset / self._a), None
        gain = -_times(self._folds, self._count, values, gain=True) - self._pull
        gain = (gain - offset * self._b / self._a) / self._c
        return everywhere((offset - self._b * gain) / self._a), everywhere(gain)


@dataclass(frozen=True)
class WithoutPixels:
    """Sums of folds after elimination of offsets and gains of pixels, without priors of other unknowns.

    ``gram`` (M, M) is over regressors, nuisances and observations, in the order of `stacked`; ``diagonal`` is
    its diagonal before the elimination; ``pixels`` gives offsets and gains given the other unknowns.
    """

    gram: Array
    diagonal: Array
    pixels: PixelElimination


def without_pixels(folds: Sequence[Fold], count: int, priors: PixelPriors) -> WithoutPixels:
    """Eliminate offsets and gains of pixels from the sum of some folds, of ``count`` regressors."""
    gram, _ = stacked(folds, count)
    diagonal = np.diag(gram).copy()
    pixels = PixelElimination(folds, count, priors)
    for block in pixels.blocks():
        for rows in pixels.rows(block):
            gram -= rows.T @ rows
    return WithoutPixels(gram, diagonal, pixels)


def _given(values: Array | None) -> Array:
    assert values is not None
    return values


def stacked(folds: Sequence[Fold], count: int) -> tuple[Array, list[tuple[str, float, float]]]:
    """Put folds together: Gram matrix, nuisances; order regressors, nuisances, observations."""
    nuisances = [nuisance for fold in folds for nuisance in fold.nuisances]
    size = count + len(nuisances) + 1
    gram = np.zeros((size, size))
    start = count
    for fold in folds:
        own = np.r_[np.arange(count), start + np.arange(len(fold.nuisances)), size - 1]
        gram[np.ix_(own, own)] += fold.gram
        start += len(fold.nuisances)
    return gram, nuisances


def _sums(folds: Sequence[Fold], count: int, block: slice, *, gain: bool = False) -> Array:
    """Return the sums of a block's pixels (N, M) in the order of `stacked`."""
    size = count + sum(len(fold.nuisances) for fold in folds) + 1
    result = np.zeros((size, block.stop - block.start)).T
    start = count
    for fold in folds:
        own = (_given(fold.gain) if gain else fold.pixel)[block]
        result[:, :count] += own[:, :count]
        result[:, start : start + len(fold.nuisances)] = own[:, count:-1]
        result[:, -1] += own[:, -1]
        start += len(fold.nuisances)
    return result


def _times(folds: Sequence[Fold], count: int, values: Array, *, gain: bool = False) -> Array:
    """Return the product of the sums per pixel of some folds, as `stacked` orders them, with values."""
    total = np.zeros(len(folds[0].weight))
    start = count
    for fold in folds:
        own = np.concatenate([values[:count], values[start : start + len(fold.nuisances)], values[-1:]])
        total += (_given(fold.gain) if gain else fold.pixel) @ own
        start += len(fold.nuisances)
    return total


def stacked_sides(count: int, sides: Sequence[Array]) -> Array:
    """Put right-hand sides (M - 1, R) of folds together as `stacked` does with the observations."""
    shared = np.sum([side[:count] for side in sides], axis=0)
    return np.concatenate([shared, *(side[count:] for side in sides)])
