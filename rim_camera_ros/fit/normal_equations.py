"""Normal equations of a joint fit: streamed over stations, folds of poses kept separate.

Unknowns are the regressors (parameters of effects), the errors of every pose and the emitter's power at
every pose (random effects with priors), and one offset per pixel (the fixed pattern, eliminated by a Schur
complement). Memory does not grow with the number of frames: it holds one Gram matrix per fold of poses and
the weighted sums per pixel that the elimination of the pattern needs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.effects.candidate import Block, Column, Groups, Regressor, priors_of
from rim_camera_ros.fit.data import pixels_seen
from rim_camera_ros.fit.fold_sums import Fold, FoldSums, Share, share_of
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixel_elimination import (
    PATTERN_PRIOR,
    PixelElimination,
    PixelPriors,
    WithoutPixels,
    without_pixels,
)
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


#: Share of the information of data and prior about regressors below which the rest after elimination is
#: rounding: some hundred times the relative error of a double, as errors of thousands of products add up.
_RANK = 1e-13


@dataclass
class NormalEquations:
    """The sums of all folds; ``regressors`` in the order of the columns; ``threads`` may share work on them.

    ``away`` is how far the first regressors are from the middle of their priors (None: at it).

    The folds must not change once some of them were reduced: the reduced equations are kept.
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
        """Return the equations without nuisances, which are eliminated, of all folds or all but one."""
        if leave_out not in self._reduced:
            kept = [fold for i, fold in enumerate(self.folds) if i != leave_out]
            self._reduced[leave_out] = reduce_folds(kept, priors_of(self.regressors), self.pixels)
        return self._reduced[leave_out]


@dataclass
class Reduced:
    """Equations of the regressors after eliminating all nuisances.

    ``gram`` (K, K) and ``right`` (K,) or (K, R); ``square`` y' V^-1 y; ``log_norm`` half the log
    determinant of V; ``rows`` the number of observations, ``expected`` the expected sum of their squares.
    ``recover`` returns nuisances, pattern [m] and changes of the gains of pixels (None: known) for given
    values of the regressors. ``without_errors`` eliminates the nuisances from right-hand sides (M - 1, R),
    ordered as by `pixel_elimination.stacked` and without offsets and gains of ``pixels``; it returns (K, R).
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


def reduce_folds(folds: Sequence[Fold], priors: Array, pixel_priors: PixelPriors) -> Reduced:
    """Eliminate offsets and gains of pixels and nuisances from the sum of some folds.

    ``priors`` are the 1-sigma of the regressors (K,).
    """
    return reduce_further(folds, priors, without_pixels(folds, len(priors), pixel_priors))


def reduce_further(folds: Sequence[Fold], priors: Array, sums: WithoutPixels) -> Reduced:
    """Eliminate nuisances as well from the ``sums`` of folds; the nuisances may have other priors."""
    count, pixels, full = len(priors), sums.pixels, sums.gram.copy()
    nuisances = [nuisance for fold in folds for nuisance in fold.nuisances]
    # the information of some folds about a regressor may be far less than the rounding of its prior
    unit = np.hypot(np.sqrt(sums.diagonal[:count]), 1.0 / priors)
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
    gram, directions = determined((reduced[:-1, :-1] + reduced[:-1, :-1].T) / 2, unit)

    # the sums per pixel are put together on request: kept, they would fill the memory
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


def determined(gram: Array, unit: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Return a reduced normal matrix (K, K) without directions that are rounding, and this for right sides.

    ``unit`` (K,) are the roots of its diagonal before the elimination, priors included. Where nuisances can
    imitate a combination of regressors, elimination subtracts numbers that are nearly equal. A remainder
    below `_RANK` cannot be distinguished from 0 and is set to 0: the data determine nothing in that
    direction. A negative remainder would belong to no least-squares problem.
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
    pixel_gains: float | None = None,
    seen: NDArray[np.bool_] | None = None,
) -> NormalEquations:
    """Stream all stations into normal equations.

    ``fold_of`` maps (recording, pose) to a fold number (default: all in fold 0); ``pattern`` estimates an
    offset per pixel; ``weigh`` returns factors on the weights of both channels (robust fitting);
    ``stray_light`` [counts] is the 1-sigma of light that all pixels of a station share (that of a second
    camera), a random effect of every station; ``pattern_prior`` [m] that of the offsets of pixels,
    ``pixel_gains`` (relative) that of their gains (None: as the camera file states). ``seen``
    (H W,) are the pixels of which sums are kept (None: those that these stations saw); folds that are reduced
    together need the same. The threads of ``forward`` share the stations: the sums are the same with any
    number of them.
    """
    regressors = [regressor for block in blocks for regressor in block.regressors]
    camera = forward.camera
    stated = camera.radiometry.pattern_sigma if pixel_gains is None else pixel_gains
    gain_prior = stated if pattern else 0.0
    ordered = [block for block in blocks if block.in_order]

    def taken() -> Iterator[tuple[Prediction, list[Sequence[Column]]]]:
        for prediction in forward.predictions():
            remembered = [block.columns(prediction.for_columns(block)) for block in ordered]
            # a copy: the next station changes what effects remember
            for one in (prediction, prediction.inner):
                one.context.memory = dict(one.context.memory)
            yield prediction, remembered

    def share(station: tuple[Prediction, list[Sequence[Column]]]) -> tuple[int, Share]:
        prediction, remembered = station[0], iter(station[1])
        columns: list[Column | None] = []
        groups: tuple[int, Groups] | None = None
        for block in blocks:
            if block.grouped is not None and groups is None:
                groups = len(columns), block.grouped(prediction.for_columns(block))
                columns += [None] * len(block.regressors)
            else:
                own = prediction.for_columns(block)
                columns += next(remembered) if block.in_order else block.columns(own)
        found = share_of(
            prediction,
            columns,
            gain_sigma=camera.radiometry.gain_sigma,
            stray_light=stray_light,
            factors=None if weigh is None else weigh(prediction),
            gains=gain_prior > 0,
            groups=groups,
        )
        key = (prediction.station.recording, prediction.station.pose)
        return 0 if fold_of is None else fold_of[key], found

    if seen is None:
        seen = pixels_seen(forward.dataset, forward.masks, forward.camera.shape)
    row_of = np.full(seen.size, -1)
    pixels = np.flatnonzero(seen)
    row_of[pixels] = np.arange(pixels.size)
    numbers = [(station.recording, station.pose) for station in forward.dataset.stations]
    stations = Counter(0 if fold_of is None else fold_of[key] for key in numbers)
    sums: dict[int, FoldSums] = {}
    for number, found in in_order(share, taken(), threads=forward.threads):
        if number not in sums:
            sums[number] = FoldSums(
                len(regressors),
                pixels.size,
                rows=row_of,
                pattern=pattern,
                gains=gain_prior > 0,
                stations=stations[number],
            )
        sums[number].add(found)
    # each is freed once its fold is made: they are the largest arrays of an adjustment
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
