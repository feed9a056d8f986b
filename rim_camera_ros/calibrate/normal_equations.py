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
from rim_camera_ros.calibrate.forward import Forward
from rim_camera_ros.calibrate.prediction import Prediction

Array = NDArray[Any]


#: 1-sigma of the fixed pattern's prior [m]: as good as unknown.
PATTERN_PRIOR = 0.05
#: Pixels of which the sums are put together at once.
_BLOCK = 4096


@dataclass
class Fold:
    """Sums over the stations of one fold of poses.

    ``nuisances``: name, 1-sigma of the prior, and where the equations are linearised (their prior's mean is
    0).
    ``gram`` (M, M) over regressors, this fold's nuisances and the observations (last); ``pixel`` (P, M) and
    ``weight`` (P,) the sums per pixel of the distance channel; ``rows`` the number of observations,
    ``log_sigma`` the sum of their log standard deviations.
    """

    nuisances: list[tuple[str, float, float]]
    gram: Array
    pixel: Array
    weight: Array
    rows: int = 0
    log_sigma: float = 0.0


@dataclass
class NormalEquations:
    """All folds; ``regressors`` in the order of the columns."""

    regressors: list[Regressor]
    folds: list[Fold] = field(default_factory=list)
    shape: tuple[int, int] = (0, 0)
    pattern_prior: float = PATTERN_PRIOR

    def reduced(self, leave_out: int | None = None) -> Reduced:
        """Return the equations of the regressors alone, of all folds but one; nuisances are eliminated."""
        kept = [fold for i, fold in enumerate(self.folds) if i != leave_out]
        return reduce_folds(kept, len(self.regressors), self.pattern_prior)


@dataclass
class Reduced:
    """Equations of the regressors after eliminating all nuisances.

    ``gram`` (K, K) and ``right`` (K,) or (K, R); ``square`` y' V^-1 y; ``log_norm`` half the log
    determinant of V; ``rows`` observations. ``recover`` gives nuisances and pattern for
    given regressor values.
    """

    gram: Array
    right: Array
    square: Array
    rows: int
    log_norm: float
    recover: Callable[[Array], tuple[dict[str, float], Array]]


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
        block = np.zeros((rows.stop - first, size), folds[0].pixel.dtype)
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


def reduce_folds(
    folds: Sequence[Fold],
    count: int,
    pattern_prior: float,
    *,
    replicates: Sequence[tuple[Array, Array]] | None = None,
) -> Reduced:
    """Eliminate pattern and nuisances from the sum of some folds.

    ``replicates`` of each fold, right-hand sides (M - 1, R) and sums per pixel (P, R), take the place of the
    observations.
    """
    full, weight, nuisances = _stacked(folds, count)
    scale = 1.0 / (weight + pattern_prior**-2)
    if replicates is not None:
        drawn, summed = _stacked_replicates(folds, count, replicates)
    for rows, block in pixel_blocks(folds, count):
        if replicates is not None:
            drawn -= block[:, :-1].T @ (summed[rows] * scale[rows, None].astype(summed.dtype))
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
    right = reduced[:-1, -1]
    if replicates is not None:
        right = drawn[:count]
        if nuisances:
            right = right - cross[:, :-1].T @ linalg.cho_solve(factor, drawn[count:], check_finite=False)

    # the sums per pixel are put together anew when they are asked for: kept, they would fill the memory
    def recover(values: Array) -> tuple[dict[str, float], Array]:
        found = solved[:, -1] - solved[:, :-1] @ values if nuisances else np.zeros(0)
        everything = np.concatenate([values, found, [-1.0]])
        total = -_times(folds, count, everything)
        pattern = total / (sum(fold.weight for fold in folds) + pattern_prior**-2)
        return {name: float(e) for (name, _, _), e in zip(nuisances, found, strict=True)}, pattern

    return Reduced(
        gram=(reduced[:-1, :-1] + reduced[:-1, :-1].T) / 2,
        right=right,
        square=reduced[-1, -1],
        rows=sum(fold.rows for fold in folds),
        log_norm=log_norm,
        recover=recover,
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
    the offsets of pixels.
    """
    regressors = [one for block in blocks for one in block.regressors]
    count = len(regressors)
    camera = forward.camera
    gain_sigma = camera.radiometry.gain_sigma
    sums: dict[int, _FoldSums] = {}
    for prediction in forward.predictions():
        station = prediction.station
        key = (station.recording, station.pose)
        number = 0 if fold_of is None else fold_of[key]
        if number not in sums:
            sums[number] = _FoldSums(count, camera.sensor.width * camera.sensor.height, single=single)
        factors = None if weigh is None else weigh(prediction)
        sums[number].add(prediction, blocks, (gain_sigma, stray_light), pattern, factors)
    folds = [sums[number].fold(pattern) for number in sorted(sums)]
    return NormalEquations(regressors, folds, camera.shape, pattern_prior)


def _rows(images: Sequence[Array], pixels: Array) -> Array:
    """Return the chosen pixels of images (H, W) as rows (len(images), N), 0 where not finite."""
    rows = np.empty((len(images), pixels.size))
    for row, image in zip(rows, images, strict=True):
        np.take(image, pixels, out=row, mode="clip")
    if not np.isfinite(rows.sum()):
        np.nan_to_num(rows, copy=False, posinf=0.0, neginf=0.0)
    return rows


class _FoldSums:
    def __init__(self, count: int, pixels: int, *, single: bool) -> None:
        self._count = count
        self._type = np.float32 if single else np.float64
        self._nuisances: dict[str, tuple[float, float]] = {}
        self._gram = np.zeros((count, count))
        self._right = np.zeros(count)
        self._square = 0.0
        self._rows = 0
        self._log_sigma = 0.0
        self._pixel: Array = np.zeros((count, pixels), self._type)
        self._pixel_y: Array = np.zeros(pixels, self._type)
        self._weight: Array = np.zeros(pixels)
        # of each nuisance: products with the regressors, with y, and its sums per pixel
        self._cross: dict[str, Array] = {}
        self._cross_y: dict[str, float] = {}
        self._inner: dict[tuple[str, str], float] = {}
        self._nuisance_pixel: dict[str, Array] = {}

    def add(
        self,
        prediction: Prediction,
        blocks: Sequence[Block],
        random: tuple[float, float],
        pattern: bool,
        factors: tuple[Array, Array] | None,
    ) -> None:
        pixels, lit = (np.flatnonzero(one) for one in (prediction.used, prediction.amplitude_used))
        columns = [pair for block in blocks for pair in block.columns(prediction)]
        nuisances = _nuisances(prediction, *random)
        weight = 1.0 / np.take(prediction.sigma, pixels) ** 2
        weight_a = 1.0 / np.take(prediction.amplitude_sigma, lit) ** 2
        if factors is not None:
            weight = weight * np.take(factors[0], pixels)
            weight_a = weight_a * np.take(factors[1], lit)
        of_distance = [distance for distance, _ in columns]
        of_distance += [distance for *_, distance, _ in nuisances]
        design = _rows([*of_distance, prediction.residual], pixels)
        # a product with its own transpose takes half the time
        root = np.sqrt(weight)
        design *= root
        gram = design @ design.T
        if lit.size:
            of_light = [(i, amplitude) for i, (_, amplitude) in enumerate(columns) if amplitude is not None]
            of_light += [(len(columns) + i, one[-1]) for i, one in enumerate(nuisances)]
            of_light.append((len(design) - 1, prediction.amplitude_residual))
            index = np.array([i for i, _ in of_light])
            light = _rows([amplitude for _, amplitude in of_light], lit)
            light *= np.sqrt(weight_a)
            gram[np.ix_(index, index)] += light @ light.T
        self._rows += len(weight) + len(weight_a)
        self._log_sigma -= 0.5 * float(np.log(weight).sum() + np.log(weight_a).sum())
        self._sum(gram, nuisances)
        if pattern:
            weighted = np.multiply(design, root, out=design)
            for sums, row in zip(self._pixel, weighted[: self._count], strict=True):
                sums[pixels] += row.astype(self._type, copy=False)
            self._pixel_y[pixels] += weighted[-1].astype(self._type, copy=False)
            self._weight[pixels] += weight
            for i, (name, *_) in enumerate(nuisances):
                sums = self._nuisance_pixel.setdefault(name, np.zeros(self._weight.size, self._type))
                sums[pixels] += weighted[self._count + i].astype(self._type, copy=False)

    def _sum(self, gram: Array, nuisances: Sequence[_Nuisance]) -> None:
        count = self._count
        self._gram += gram[:count, :count]
        self._right += gram[:count, -1]
        self._square += gram[-1, -1]
        for i, (name, prior, at, _, _) in enumerate(nuisances):
            self._nuisances.setdefault(name, (prior, at))
            self._cross[name] = self._cross.get(name, 0.0) + gram[:count, count + i]
            self._cross_y[name] = self._cross_y.get(name, 0.0) + float(gram[-1, count + i])
            for j, (other, *_) in enumerate(nuisances):
                both = (name, other)
                self._inner[both] = self._inner.get(both, 0.0) + float(gram[count + i, count + j])

    def fold(self, pattern: bool) -> Fold:
        count, names = self._count, list(self._nuisances)
        size = count + len(names) + 1
        gram = np.zeros((size, size))
        gram[:count, :count] = self._gram
        gram[:count, -1] = gram[-1, :count] = self._right
        gram[-1, -1] = self._square
        place = {name: count + i for i, name in enumerate(names)}
        for name in names:
            k = place[name]
            gram[:count, k] = gram[k, :count] = self._cross[name]
            gram[k, -1] = gram[-1, k] = self._cross_y[name]
        for (one, other), value in self._inner.items():
            gram[place[one], place[other]] = value
        pixels = len(self._weight)
        pixel = np.zeros((pixels if pattern else 1, size), self._type)
        if pattern:
            pixel[:, :count] = self._pixel.T
            pixel[:, -1] = self._pixel_y
            for name, sums in self._nuisance_pixel.items():
                pixel[:, place[name]] = sums
        weight = self._weight if pattern else np.zeros(1)
        nuisances = [(name, *self._nuisances[name]) for name in names]
        return Fold(nuisances, gram, pixel, weight, self._rows, self._log_sigma)


#: Name, 1-sigma of the prior, value at the linearisation, derivatives of both channels.
_Nuisance = tuple[str, float, float, Array, Array]


def _nuisances(prediction: Prediction, gain_sigma: float, stray_light: float) -> list[_Nuisance]:
    """Return name, prior, value and both columns of a station's random effects: errors of poses, emitted
    power.
    """
    station = prediction.station
    key = f"{station.recording}.{station.pose}"
    result = []
    for column in prediction.pose_columns:
        if column.path.startswith("scene."):
            continue
        distance, amplitude = prediction.pose_change(column)
        name = f"{station.recording}.{station.placed}.{column.path}"
        result.append((name, column.prior, 0.0, distance, amplitude))
    if gain_sigma > 0:
        distance, amplitude = prediction.gain_column()
        at = float(np.log(prediction.gain))
        result.append((f"{key}.gain", gain_sigma, at, distance, amplitude))
    if stray_light > 0:
        for part, (distance, amplitude) in zip(
            ("real", "imaginary"), prediction.light_columns(), strict=True
        ):
            result.append((f"{key}.light.{part}.{station.stamp}", stray_light, 0.0, distance, amplitude))
    return result
