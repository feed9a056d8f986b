"""Normal equations of a joint fit: streamed over stations, folds of poses kept apart.

Unknowns are the regressors (parameters of effects), the errors of every pose and the emitter's power at
every pose (random effects with priors), and one offset per pixel (the fixed pattern, eliminated by a Schur
complement). What is kept does not grow with the number of frames: one Gram matrix per fold of poses and the
weighted sums per pixel that the elimination of the pattern needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.calibrate.fold_sums import Fold, FoldSums, Grouped, Share, share_of
from rim_camera_ros.calibrate.forward import Forward
from rim_camera_ros.calibrate.prediction import Prediction
from rim_camera_ros.effects.candidate import Block, Column, Regressor
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


#: 1-sigma of the fixed pattern's prior [m]: unknown, also that of all pixels together. With 50 mm of each
#: pixel by itself the mean of 6,000 pixels would be known to 0.6 mm, and every smooth field nearly as well,
#: which no camera's is: effects that are smooth over the array would gain what it costs.
PATTERN_PRIOR = 5.0
#: Pixels of which the sums are put together at once.
_BLOCK = 4096
_ROUNDING = 1e-10
#: Share of what regressors tell by themselves below which what elimination leaves of it is rounding: some
#: hundred times the relative error of a double, as errors of thousands of products add up.
_RANK = 1e-13


@dataclass
class NormalEquations:
    """All folds; ``regressors`` in the order of the columns; ``threads`` that work on them may take.

    ``away`` is how far the first regressors are from the middle of their priors (None: at it).

    The folds do not change any more once one of them was reduced: what was is kept.
    """

    regressors: list[Regressor]
    folds: list[Fold] = field(default_factory=list)
    shape: tuple[int, int] = (0, 0)
    pixels: PixelPriors = field(default_factory=lambda: PixelPriors())
    threads: int = 1
    away: Array | None = None
    _reduced: dict[int | None, Reduced] = field(default_factory=dict, repr=False, compare=False)

    @property
    def pattern_prior(self) -> float:
        """1-sigma of the offset of a pixel [m]."""
        return self.pixels.offset

    def away_from_prior(self) -> Array:
        """Return how far every regressor (K,) is from the middle of its prior."""
        result = np.zeros(len(self.regressors))
        if self.away is not None:
            result[: len(self.away)] = self.away
        return result

    def reduced(self, leave_out: int | None = None) -> Reduced:
        """Return the equations of the regressors alone, of all folds but one; nuisances are eliminated."""
        if leave_out not in self._reduced:
            kept = [fold for i, fold in enumerate(self.folds) if i != leave_out]
            self._reduced[leave_out] = reduce_folds(kept, len(self.regressors), self.pixels)
        return self._reduced[leave_out]


@dataclass(frozen=True)
class PixelPriors:
    """What is known of every pixel: 1-sigma of its ``offset`` [m] and of its relative ``gain`` (0: known).

    ``gains_at`` (P,) are the logarithms of the gains where the equations are linearised; their prior is
    about 0.
    """

    offset: float = PATTERN_PRIOR
    gain: float = 0.0
    gains_at: Array | None = None


class PixelElimination:
    """The offset and the gain of each pixel, eliminated from the sum of some folds.

    Of each pixel the two unknowns are made independent of each other: ``rows`` are those of a matrix whose
    product with its transpose is what their elimination takes from the normal matrix.
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
            # what the offset leaves of it cannot be less than nothing
            alone = np.maximum(weight - self._b**2 / self._a, _ROUNDING * weight)
            self._c = alone + priors.gain**-2
            self._pull = np.zeros(len(self._a)) if at is None else at / priors.gain**2
            self.log_norm += 0.5 * float(np.sum(np.log(self._c * priors.gain**2)))
            self.square = 0.0 if at is None else float(np.sum((at / priors.gain) ** 2))

    def rows(self) -> Iterator[Array]:
        """Yield the rows (N, M), in the order of `_stacked`, block by block."""
        gains = _blocks(self._folds, self._count, gain=True) if self.with_gains else None
        for rows, block in _blocks(self._folds, self._count):
            if gains is not None:
                _, second = next(gains)
                second[:, -1] -= self._pull[rows]
                second -= block * (self._b[rows] / self._a[rows])[:, None]
                second /= np.sqrt(self._c[rows])[:, None]
                yield second
            block /= np.sqrt(self._a[rows])[:, None]
            yield block

    def whitened(self, offset: Array, gain: Array | None) -> Iterator[Array]:
        """Yield sums per pixel (P, R) as `rows` does with those of the columns, block by block."""
        for first in range(0, len(self._a), _BLOCK):
            rows = slice(first, min(first + _BLOCK, len(self._a)))
            a = self._a[rows, None]
            if self.with_gains:
                assert gain is not None
                second = gain[rows] - offset[rows] * (self._b[rows, None] / a)
                yield second / np.sqrt(self._c[rows, None])
            yield offset[rows] / np.sqrt(a)

    def draw(self, replicates: int, rng: np.random.Generator) -> tuple[Array, Array | None]:
        """Return sums per pixel (P, R) of noise alone, whose covariance is that of the equations."""
        first = rng.standard_normal((len(self._a), replicates), dtype=np.float32)
        root = np.sqrt(self._a)[:, None].astype(np.float32)
        offset = root * first
        if not self.with_gains:
            return offset, None
        second = rng.standard_normal((len(self._a), replicates), dtype=np.float32)
        gain = (self._b[:, None] / self._a[:, None]) * offset + np.sqrt(self._c)[:, None] * second
        return offset, gain.astype(np.float32)

    def solve(self, values: Array) -> tuple[Array, Array | None]:
        """Return offsets [m] and changes of the gains (P,) for values of all else, as `_stacked` orders."""
        offset = -_times(self._folds, self._count, values)
        if not self.with_gains:
            return offset / self._a, None
        gain = -_times(self._folds, self._count, values, gain=True) - self._pull
        gain = (gain - offset * self._b / self._a) / self._c
        return (offset - self._b * gain) / self._a, gain


def _given(values: Array | None) -> Array:
    assert values is not None
    return values


@dataclass
class Reduced:
    """Equations of the regressors after eliminating all nuisances.

    ``gram`` (K, K) and ``right`` (K,) or (K, R); ``square`` y' V^-1 y; ``log_norm`` half the log
    determinant of V; ``rows`` observations. ``recover`` gives nuisances, pattern [m] and changes of the
    gains of pixels (None: known) for given regressor values; ``sides`` the right-hand sides (K, R) of
    replicates of each fold in the place of its observations: `Draw`.
    """

    gram: Array
    right: Array
    square: Array
    rows: int
    log_norm: float
    recover: Callable[[Array], tuple[dict[str, float], Array, Array | None]]
    sides: Callable[[Sequence[Draw]], Array]


@dataclass(frozen=True)
class Draw:
    """Replicates of a fold: right-hand sides (M - 1, R), sums per pixel (P, R) for offsets and gains."""

    right: Array
    pixel: Array
    gain: Array | None = None


def _stacked(folds: Sequence[Fold], count: int) -> tuple[Array, list[tuple[str, float, float]]]:
    """Put folds together: Gram matrix, nuisances; order regressors, nuisances, observations."""
    nuisances = [one for fold in folds for one in fold.nuisances]
    size = count + len(nuisances) + 1
    gram = np.zeros((size, size))
    start = count
    for fold in folds:
        own = np.r_[np.arange(count), start + np.arange(len(fold.nuisances)), size - 1]
        gram[np.ix_(own, own)] += fold.gram
        start += len(fold.nuisances)
    return gram, nuisances


def _blocks(folds: Sequence[Fold], count: int, *, gain: bool = False) -> Iterator[tuple[slice, Array]]:
    """Yield rows of pixels and their sums (N, M) in the order of `_stacked`, block by block.

    The sums of all pixels at once would be the largest array of an adjustment.
    """
    pixels = len(folds[0].weight)
    size = count + sum(len(fold.nuisances) for fold in folds) + 1
    for first in range(0, pixels, _BLOCK):
        rows = slice(first, min(first + _BLOCK, pixels))
        block = np.zeros((size, rows.stop - first)).T
        start = count
        for fold in folds:
            own = (_given(fold.gain) if gain else fold.pixel)[rows]
            block[:, :count] += own[:, :count]
            block[:, start : start + len(fold.nuisances)] = own[:, count:-1]
            block[:, -1] += own[:, -1]
            start += len(fold.nuisances)
        yield rows, block


def _times(folds: Sequence[Fold], count: int, values: Array, *, gain: bool = False) -> Array:
    """Return the product of the sums per pixel of some folds, as `_stacked` orders them, with values."""
    total = np.zeros(len(folds[0].weight))
    start = count
    for fold in folds:
        own = np.concatenate([values[:count], values[start : start + len(fold.nuisances)], values[-1:]])
        total += (_given(fold.gain) if gain else fold.pixel) @ own
        start += len(fold.nuisances)
    return total


def _stacked_replicates(folds: Sequence[Fold], count: int, draws: Sequence[Draw]) -> Draw:
    """Put the replicates of folds together as `_stacked` does with the observations."""
    own = [count + len(fold.nuisances) for fold in folds]
    right = np.zeros((count + sum(n - count for n in own), draws[0].right.shape[1]))
    start = count
    for n, one in zip(own, draws, strict=True):
        right[:count] += one.right[:count]
        right[start : start + n - count] = one.right[count:]
        start += n - count
    gains = [one.gain for one in draws if one.gain is not None]
    return Draw(right, np.sum([one.pixel for one in draws], axis=0), np.sum(gains, axis=0) if gains else None)


def reduce_folds(folds: Sequence[Fold], count: int, priors: PixelPriors) -> Reduced:
    """Eliminate offsets and gains of pixels and nuisances from the sum of some folds."""
    full, nuisances = _stacked(folds, count)
    unit = np.sqrt(np.diag(full)[:count])
    pixels = PixelElimination(folds, count, priors)
    for block in pixels.rows():
        full -= block.T @ block
    inner = slice(count, count + len(nuisances))
    keep = np.r_[np.arange(count), full.shape[0] - 1]
    errors = full[inner, inner] + np.diag([p**-2 for _, p, _ in nuisances])
    cross = full[inner][:, keep]
    log_norm = sum(fold.log_sigma for fold in folds) + pixels.log_norm
    pull = np.array([at / p**2 for _, p, at in nuisances])
    full[-1, -1] += sum((at / p) ** 2 for _, p, at in nuisances) + pixels.square
    if nuisances:
        cross[:, -1] -= pull
        factor = linalg.cho_factor(errors, check_finite=False)
        solved = linalg.cho_solve(factor, cross, check_finite=False)
        reduced = full[np.ix_(keep, keep)] - cross.T @ solved
        log_norm += float(np.sum(np.log(np.diag(factor[0]))) + sum(np.log(p) for _, p, _ in nuisances))
    else:
        solved = cross
        reduced = full[np.ix_(keep, keep)]
    gram, directions = _determined((reduced[:-1, :-1] + reduced[:-1, :-1].T) / 2, unit)

    # the sums per pixel are put together anew when they are asked for: kept, they would fill the memory
    def recover(values: Array) -> tuple[dict[str, float], Array, Array | None]:
        found = solved[:, -1] - solved[:, :-1] @ values if nuisances else np.zeros(0)
        offsets, gains = pixels.solve(np.concatenate([values, found, [-1.0]]))
        return {name: float(e) for (name, _, _), e in zip(nuisances, found, strict=True)}, offsets, gains

    def sides(replicates: Sequence[Draw]) -> Array:
        draw = _stacked_replicates(folds, count, replicates)
        drawn = draw.right
        for block, summed in zip(pixels.rows(), pixels.whitened(draw.pixel, draw.gain), strict=True):
            drawn -= block[:, :-1].T @ summed
        if not nuisances:
            return directions(drawn[:count])
        errors = linalg.cho_solve(factor, drawn[count:], check_finite=False)
        return directions(drawn[:count] - cross[:, :-1].T @ errors)

    return Reduced(
        gram=gram,
        right=directions(reduced[:-1, -1]),
        square=reduced[-1, -1],
        rows=sum(fold.rows for fold in folds),
        log_norm=log_norm,
        recover=recover,
        sides=sides,
    )


def _determined(gram: Array, unit: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Return a reduced normal matrix (K, K) without what is but rounding, and the same for right sides.

    ``unit`` (K,) are the roots of its diagonal before anything was eliminated. Elimination subtracts numbers
    that are nearly equal where nuisances can take on what a combination of regressors does; what is left of
    it below `_RANK` is not known to be more than nothing, and nothing is what the data then say of it:
    negative, it would be a normal matrix of no least-squares problem.
    """
    unit = np.where(unit > 0, unit, 1.0)
    if not len(unit):  # scipy 1.11 decomposes no empty matrix
        return gram, lambda right: right
    values, vectors = linalg.eigh(gram / np.outer(unit, unit), check_finite=False)
    if values[0] >= _RANK:
        return gram, lambda right: right
    kept = vectors[:, values >= _RANK]

    def directions(right: Array) -> Array:
        scaled = (right.T / unit).T
        return np.asarray(((kept @ (kept.T @ scaled)).T * unit).T)

    scaled = (kept * values[values >= _RANK]) @ kept.T
    return scaled * np.outer(unit, unit), directions


def accumulate(
    forward: Forward,
    blocks: Sequence[Block],
    *,
    fold_of: Mapping[tuple[int, int], int] | None = None,
    pattern: bool = True,
    weigh: Callable[[Prediction], tuple[Array, Array]] | None = None,
    stray_light: float = 0.0,
    pattern_prior: float = PATTERN_PRIOR,
) -> NormalEquations:
    """Stream all stations into normal equations.

    ``fold_of`` maps (recording, pose) to a fold number (default: all in fold 0); ``pattern`` estimates an
    offset per pixel; ``weigh`` returns factors on the weights of both channels (robust fitting);
    ``stray_light`` [counts] is the 1-sigma of light that all pixels of a
    station share (that of a second camera), a random effect of every station; ``pattern_prior`` [m] that of
    the offsets of pixels. The threads of ``forward`` share the stations: the sums are the same with any
    number of them.
    """
    regressors = [one for block in blocks for one in block.regressors]
    camera = forward.camera
    gain_prior = camera.radiometry.pattern_sigma if pattern else 0.0
    ordered = [block for block in blocks if block.in_order]

    def taken() -> Iterator[tuple[Prediction, list[Sequence[Column]]]]:
        for prediction in forward.predictions():
            remembered = [block.columns(prediction) for block in ordered]
            # what the next station remembers is another's
            prediction.context.memory = dict(prediction.context.memory)
            yield prediction, remembered

    def share(one: tuple[Prediction, list[Sequence[Column]]]) -> tuple[int, Share]:
        prediction, remembered = one[0], iter(one[1])
        columns: list[Column | None] = []
        grouped = None
        for block in blocks:
            if block.grouped is not None and grouped is None:
                grouped = Grouped(len(columns), len(block.regressors), *block.grouped(prediction))
                columns += [None] * len(block.regressors)
            else:
                columns += next(remembered) if block.in_order else block.columns(prediction)
        found = share_of(
            prediction,
            columns,
            gain_sigma=camera.radiometry.gain_sigma,
            stray_light=stray_light,
            factors=None if weigh is None else weigh(prediction),
            gains=gain_prior > 0,
            grouped=grouped,
        )
        key = (prediction.station.recording, prediction.station.pose)
        return 0 if fold_of is None else fold_of[key], found

    sums: dict[int, FoldSums] = {}
    for number, found in in_order(share, taken(), threads=forward.threads):
        if number not in sums:
            pixels = camera.sensor.width * camera.sensor.height
            sums[number] = FoldSums(len(regressors), pixels, pattern=pattern, gains=gain_prior > 0)
        sums[number].add(found)
    # each is let go of with its fold: they are the largest arrays of an adjustment
    folds = [sums.pop(number).fold() for number in sorted(sums)]
    at = forward.amplitude_model.pixels
    priors = PixelPriors(pattern_prior, gain_prior, None if at is None else at.ravel())
    return NormalEquations(regressors, folds, camera.shape, priors, forward.threads)
