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

from rim_camera_ros.calibrate.blocks import Block, Regressor
from rim_camera_ros.calibrate.fold_sums import Fold, FoldSums, Share, share_of
from rim_camera_ros.calibrate.forward import Forward
from rim_camera_ros.calibrate.prediction import Column, Prediction
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


#: 1-sigma of the fixed pattern's prior [m]: as good as unknown.
PATTERN_PRIOR = 0.05
#: Pixels of which the sums are put together at once.
_BLOCK = 4096


@dataclass
class NormalEquations:
    """All folds; ``regressors`` in the order of the columns; ``threads`` that work on them may take.

    The folds do not change any more once one of them was reduced: what was is kept.
    """

    regressors: list[Regressor]
    folds: list[Fold] = field(default_factory=list)
    shape: tuple[int, int] = (0, 0)
    pattern_prior: float = PATTERN_PRIOR
    threads: int = 1
    _reduced: dict[int | None, Reduced] = field(default_factory=dict, repr=False, compare=False)

    def reduced(self, leave_out: int | None = None) -> Reduced:
        """Return the equations of the regressors alone, of all folds but one; nuisances are eliminated."""
        if leave_out not in self._reduced:
            kept = [fold for i, fold in enumerate(self.folds) if i != leave_out]
            self._reduced[leave_out] = reduce_folds(kept, len(self.regressors), self.pattern_prior)
        return self._reduced[leave_out]


@dataclass
class Reduced:
    """Equations of the regressors after eliminating all nuisances.

    ``gram`` (K, K) and ``right`` (K,) or (K, R); ``square`` y' V^-1 y; ``log_norm`` half the log
    determinant of V; ``rows`` observations. ``recover`` gives nuisances and pattern for
    given regressor values; ``sides`` the right-hand sides (K, R) of replicates of each fold in the place of
    its observations: sides (M - 1, R) and sums per pixel (P, R).
    """

    gram: Array
    right: Array
    square: Array
    rows: int
    log_norm: float
    recover: Callable[[Array], tuple[dict[str, float], Array]]
    sides: Callable[[Sequence[tuple[Array, Array]]], Array]


def _stacked(folds: Sequence[Fold], count: int) -> tuple[Array, Array, list[tuple[str, float, float]]]:
    """Put folds together: Gram matrix, weights, nuisances; order regressors, nuisances, observations."""
    nuisances = [one for fold in folds for one in fold.nuisances]
    size = count + len(nuisances) + 1
    gram = np.zeros((size, size))
    weight = np.zeros(len(folds[0].weight))
    start = count
    for fold in folds:
        own = np.r_[np.arange(count), start + np.arange(len(fold.nuisances)), size - 1]
        gram[np.ix_(own, own)] += fold.gram
        weight += fold.weight
        start += len(fold.nuisances)
    return gram, weight, nuisances


def pixel_blocks(folds: Sequence[Fold], count: int) -> Iterator[tuple[slice, Array]]:
    """Yield rows of pixels and their sums (N, M) in the order of `_stacked`, block by block.

    The sums of all pixels at once would be the largest array of an adjustment.
    """
    pixels = len(folds[0].weight)
    size = count + sum(len(fold.nuisances) for fold in folds) + 1
    for first in range(0, pixels, _BLOCK):
        rows = slice(first, min(first + _BLOCK, pixels))
        block = np.zeros((size, rows.stop - first), folds[0].pixel.dtype).T
        start = count
        for fold in folds:
            own = fold.pixel[rows]
            block[:, :count] += own[:, :count]
            block[:, start : start + len(fold.nuisances)] = own[:, count:-1]
            block[:, -1] += own[:, -1]
            start += len(fold.nuisances)
        yield rows, block


def _times(folds: Sequence[Fold], count: int, values: Array) -> Array:
    """Return the product of the sums per pixel of some folds, as `_stacked` orders them, with values."""
    total = np.zeros(len(folds[0].weight))
    start = count
    for fold in folds:
        own = np.concatenate([values[:count], values[start : start + len(fold.nuisances)], values[-1:]])
        total += fold.pixel @ own
        start += len(fold.nuisances)
    return total


def _stacked_replicates(
    folds: Sequence[Fold], count: int, replicates: Sequence[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Put the replicates of folds together as `_stacked` does with the observations."""
    own = [count + len(fold.nuisances) for fold in folds]
    right = np.zeros((count + sum(n - count for n in own), replicates[0][0].shape[1]))
    start = count
    for n, (part, _) in zip(own, replicates, strict=True):
        right[:count] += part[:count]
        right[start : start + n - count] = part[count:]
        start += n - count
    return right, np.asarray(sum(pixel for _, pixel in replicates))


def reduce_folds(folds: Sequence[Fold], count: int, pattern_prior: float) -> Reduced:
    """Eliminate pattern and nuisances from the sum of some folds."""
    full, weight, nuisances = _stacked(folds, count)
    scale = 1.0 / (weight + pattern_prior**-2)
    for rows, block in pixel_blocks(folds, count):
        block *= np.sqrt(scale[rows])[:, None].astype(block.dtype)
        full -= block.T @ block
    inner = slice(count, count + len(nuisances))
    keep = np.r_[np.arange(count), full.shape[0] - 1]
    errors = full[inner, inner] + np.diag([p**-2 for _, p, _ in nuisances])
    cross = full[inner][:, keep]
    log_norm = sum(fold.log_sigma for fold in folds)
    log_norm += 0.5 * float(np.sum(np.log1p(weight * pattern_prior**2)))
    pull = np.array([at / p**2 for _, p, at in nuisances])
    full[-1, -1] += sum((at / p) ** 2 for _, p, at in nuisances)
    if nuisances:
        cross[:, -1] -= pull
        factor = linalg.cho_factor(errors, check_finite=False)
        solved = linalg.cho_solve(factor, cross, check_finite=False)
        reduced = full[np.ix_(keep, keep)] - cross.T @ solved
        log_norm += float(np.sum(np.log(np.diag(factor[0]))) + sum(np.log(p) for _, p, _ in nuisances))
    else:
        solved = cross
        reduced = full[np.ix_(keep, keep)]

    # the sums per pixel are put together anew when they are asked for: kept, they would fill the memory
    def recover(values: Array) -> tuple[dict[str, float], Array]:
        found = solved[:, -1] - solved[:, :-1] @ values if nuisances else np.zeros(0)
        everything = np.concatenate([values, found, [-1.0]])
        total = -_times(folds, count, everything)
        pattern = total / (sum(fold.weight for fold in folds) + pattern_prior**-2)
        return {name: float(e) for (name, _, _), e in zip(nuisances, found, strict=True)}, pattern

    def sides(replicates: Sequence[tuple[Array, Array]]) -> Array:
        drawn, summed = _stacked_replicates(folds, count, replicates)
        for rows, block in pixel_blocks(folds, count):
            drawn -= block[:, :-1].T @ (summed[rows] * scale[rows, None].astype(summed.dtype))
        if not nuisances:
            return drawn[:count]
        errors = linalg.cho_solve(factor, drawn[count:], check_finite=False)
        return np.asarray(drawn[:count] - cross[:, :-1].T @ errors)

    return Reduced(
        gram=(reduced[:-1, :-1] + reduced[:-1, :-1].T) / 2,
        right=reduced[:-1, -1],
        square=reduced[-1, -1],
        rows=sum(fold.rows for fold in folds),
        log_norm=log_norm,
        recover=recover,
        sides=sides,
    )


def accumulate(
    forward: Forward,
    blocks: Sequence[Block],
    *,
    fold_of: Mapping[tuple[int, int], int] | None = None,
    pattern: bool = True,
    weigh: Callable[[Prediction], tuple[Array, Array]] | None = None,
    single: bool = False,
    stray_light: float = 0.0,
    pattern_prior: float = PATTERN_PRIOR,
) -> NormalEquations:
    """Stream all stations into normal equations.

    ``fold_of`` maps (recording, pose) to a fold number (default: all in fold 0); ``pattern`` estimates an
    offset per pixel; ``weigh`` returns factors on the weights of both channels (robust fitting); ``single``
    keeps the sums per pixel in float32; ``stray_light`` [counts] is the 1-sigma of light that all pixels of a
    station share (that of a second camera), a random effect of every station; ``pattern_prior`` [m] that of
    the offsets of pixels. The threads of ``forward`` share the stations: the sums are the same with any
    number of them.
    """
    regressors = [one for block in blocks for one in block.regressors]
    camera = forward.camera
    ordered = [block for block in blocks if block.in_order]

    def taken() -> Iterator[tuple[Prediction, list[Sequence[Column]]]]:
        for prediction in forward.predictions():
            remembered = [block.columns(prediction) for block in ordered]
            # what the next station remembers is another's
            prediction.context.memory = dict(prediction.context.memory)
            yield prediction, remembered

    def share(one: tuple[Prediction, list[Sequence[Column]]]) -> tuple[int, Share]:
        prediction, remembered = one[0], iter(one[1])
        columns = [
            pair
            for block in blocks
            for pair in (next(remembered) if block.in_order else block.columns(prediction))
        ]
        found = share_of(
            prediction,
            columns,
            gain_sigma=camera.radiometry.gain_sigma,
            stray_light=stray_light,
            factors=None if weigh is None else weigh(prediction),
        )
        key = (prediction.station.recording, prediction.station.pose)
        return 0 if fold_of is None else fold_of[key], found

    sums: dict[int, FoldSums] = {}
    for number, found in in_order(share, taken(), threads=forward.threads):
        if number not in sums:
            pixels = camera.sensor.width * camera.sensor.height
            sums[number] = FoldSums(len(regressors), pixels, single=single, pattern=pattern)
        sums[number].add(found)
    folds = [sums[number].fold() for number in sorted(sums)]
    return NormalEquations(regressors, folds, camera.shape, pattern_prior, forward.threads)
