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

from rim_camera_ros.effects.candidate import Block, Column, Regressor, priors_of
from rim_camera_ros.fit.data import pixels_seen
from rim_camera_ros.fit.fold_sums import Fold, FoldSums, Grouped, Share, share_of
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


#: 1-sigma of the fixed pattern's prior [m]: unknown, also that of all pixels together. With 50 mm of each
#: pixel by itself the mean of 6,000 pixels would be known to 0.6 mm, and every smooth field nearly as well,
#: which no camera's is: effects that are smooth over the array would gain what it costs.
PATTERN_PRIOR = 5.0
#: Pixels of which the sums are put together at once.
_BLOCK = 2048
_ROUNDING = 1e-10
#: Share of what data and prior tell of regressors by themselves below which what elimination leaves of it is
#: rounding: some hundred times the relative error of a double, as errors of thousands of products add up.
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
            self._reduced[leave_out] = reduce_folds(kept, priors_of(self.regressors), self.pixels)
        return self._reduced[leave_out]


@dataclass(frozen=True)
class PixelPriors:
    """What is known of every pixel: 1-sigma of its ``offset`` [m] and of its relative ``gain`` (0: known).

    ``gains_at`` (P,) are the logarithms of the gains where the equations are linearised; their prior is
    about 0. ``seen`` are the numbers of the P pixels of which there are sums, in an array of ``size``
    pixels (None: all); the others keep the middle of their priors.
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

    def blocks(self) -> Iterator[slice]:
        """Yield the pixels, some at once: the sums of all of them would be the largest array of all."""
        for first in range(0, len(self._a), _BLOCK):
            yield slice(first, min(first + _BLOCK, len(self._a)))

    def rows(self, block: slice) -> list[Array]:
        """Return the rows (N, M) of a block's pixels, ordered as by `_stacked`: of offsets, and of gains."""
        offset = _sums(self._folds, self._count, block)
        if not self.with_gains:
            return self.whitened(block, offset, None)
        gain = _sums(self._folds, self._count, block, gain=True)
        gain[:, -1] -= self._pull[block]
        return self.whitened(block, offset, gain)

    def whitened(self, block: slice, offset: Array, gain: Array | None) -> list[Array]:
        """Return sums of a block's pixels (N, R), which are written over, in units of independent noise."""
        result = [offset]
        if self.with_gains:
            assert gain is not None
            gain -= offset * (self._b[block] / self._a[block])[:, None]
            gain /= np.sqrt(self._c[block])[:, None]
            result.append(gain)
        offset /= np.sqrt(self._a[block])[:, None]
        return result

    def sums_of(self, block: slice, noise: Sequence[Array]) -> tuple[Array, Array | None]:
        """Return sums of a block's pixels (N, R) from independent noise, as `whitened` takes them."""
        offset = np.sqrt(self._a[block])[:, None] * noise[0]
        if not self.with_gains:
            return offset, None
        share = (self._b[block] / self._a[block])[:, None]
        return offset, share * offset + np.sqrt(self._c[block])[:, None] * noise[1]

    def solve(self, values: Array) -> tuple[Array, Array | None]:
        """Return offsets [m] and changes of the gains of all pixels for values of all else, as `_stacked`."""
        offset = -_times(self._folds, self._count, values)
        everywhere = self._priors.everywhere
        if not self.with_gains:
            return everywhere(offset / self._a), None
        gain = -_times(self._folds, self._count, values, gain=True) - self._pull
        gain = (gain - offset * self._b / self._a) / self._c
        return everywhere((offset - self._b * gain) / self._a), everywhere(gain)


def _given(values: Array | None) -> Array:
    assert values is not None
    return values


@dataclass
class Reduced:
    """Equations of the regressors after eliminating all nuisances.

    ``gram`` (K, K) and ``right`` (K,) or (K, R); ``square`` y' V^-1 y; ``log_norm`` half the log
    determinant of V; ``rows`` observations, whose squares are expected to sum up to ``expected``. ``recover``
    gives nuisances, pattern [m] and changes of the gains of pixels (None: known) for given regressor values;
    ``without_errors`` eliminates the nuisances from right-hand sides (M - 1, R) from which offsets and gains
    of ``pixels`` are eliminated, as `_stacked` orders them: (K, R).
    """

    gram: Array
    right: Array
    square: Array
    rows: int
    expected: float
    log_norm: float
    recover: Callable[[Array], tuple[dict[str, float], Array, Array | None]]
    pixels: PixelElimination
    without_errors: Callable[[Array], Array]


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


def _sums(folds: Sequence[Fold], count: int, block: slice, *, gain: bool = False) -> Array:
    """Return the sums of a block's pixels (N, M) in the order of `_stacked`."""
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
    """Return the product of the sums per pixel of some folds, as `_stacked` orders them, with values."""
    total = np.zeros(len(folds[0].weight))
    start = count
    for fold in folds:
        own = np.concatenate([values[:count], values[start : start + len(fold.nuisances)], values[-1:]])
        total += (_given(fold.gain) if gain else fold.pixel) @ own
        start += len(fold.nuisances)
    return total


def stacked_sides(count: int, sides: Sequence[Array]) -> Array:
    """Put right-hand sides (M - 1, R) of folds together as `_stacked` does with the observations."""
    shared = np.sum([one[:count] for one in sides], axis=0)
    return np.concatenate([shared, *(one[count:] for one in sides)])


def reduce_folds(folds: Sequence[Fold], priors: Array, pixel_priors: PixelPriors) -> Reduced:
    """Eliminate offsets and gains of pixels and nuisances from the sum of some folds.

    ``priors`` are the 1-sigma of the regressors (K,).
    """
    count = len(priors)
    full, nuisances = _stacked(folds, count)
    # what some folds know of a regressor may be far less than rounding is beside its prior
    unit = np.hypot(np.sqrt(np.diag(full)[:count]), 1.0 / priors)
    pixels = PixelElimination(folds, count, pixel_priors)
    for block in pixels.blocks():
        for rows in pixels.rows(block):
            full -= rows.T @ rows
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

    def without_errors(sides: Array) -> Array:
        if not nuisances:
            return directions(sides)
        errors = linalg.cho_solve(factor, sides[count:], check_finite=False)
        return directions(sides[:count] - cross[:, :-1].T @ errors)

    return Reduced(
        gram=gram,
        right=directions(reduced[:-1, -1]),
        square=reduced[-1, -1],
        rows=sum(fold.rows for fold in folds),
        expected=sum(fold.rows if fold.expected is None else fold.expected for fold in folds),
        log_norm=log_norm,
        recover=recover,
        pixels=pixels,
        without_errors=without_errors,
    )


def _determined(gram: Array, unit: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Return a reduced normal matrix (K, K) without what is but rounding, and the same for right sides.

    ``unit`` (K,) are the roots of its diagonal before anything was eliminated, the priors' included.
    Elimination subtracts numbers that are nearly equal where nuisances can take on what a combination of
    regressors does; what is left of it below `_RANK` is not known to be more than nothing, and nothing is
    what the data then say of it: negative, it would be a normal matrix of no least-squares problem.
    """
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

    seen = pixels_seen(forward.dataset, forward.masks, forward.camera.shape)
    row_of = np.full(seen.size, -1)
    pixels = np.flatnonzero(seen)
    row_of[pixels] = np.arange(pixels.size)
    sums: dict[int, FoldSums] = {}
    for number, found in in_order(share, taken(), threads=forward.threads):
        if number not in sums:
            sums[number] = FoldSums(
                len(regressors), pixels.size, rows=row_of, pattern=pattern, gains=gain_prior > 0
            )
        sums[number].add(found)
    # each is let go of with its fold: they are the largest arrays of an adjustment
    folds = [sums.pop(number).fold() for number in sorted(sums)]
    at = forward.amplitude_model.pixels
    priors = PixelPriors(
        pattern_prior,
        gain_prior,
        None if at is None else at.ravel()[pixels],
        seen=pixels if pattern else None,
        size=seen.size,
    )
    return NormalEquations(regressors, folds, camera.shape, priors, forward.threads)
