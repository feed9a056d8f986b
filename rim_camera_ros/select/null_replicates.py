"""Null replicates: recordings in which no effect is missing, drawn in the space of the normal equations.

Under the fitted baseline the sums of which the equations consist are Gaussian with a known covariance, so
that a replicate of noise, pose errors and powers costs a few products instead of a simulated recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.effects.light_curves import LOBE_PREFIX, TILES
from rim_camera_ros.fit.design import COMMON_POSE, OPTICS, SENSOR
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.normal_equations import NormalEquations
from rim_camera_ros.fit.pixel_elimination import PixelElimination, PixelPriors, stacked_sides
from rim_camera_ros.fit.surface_shape import SHAPE
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


def null_scores(
    scores: Scores,
    *,
    replicates: int = 200,
    seed: int = 0,
    errors: Mapping[str, float] | None = None,
) -> Scores:
    """Return ``scores`` whose right-hand sides are those of replicates, (K, R).

    The estimated ``errors`` of poses and powers give the distribution from which the replicates' errors are
    drawn at random: errors of instruments have heavier tails than a Gaussian, and a few large ones imitate a
    drift.
    """
    rng = np.random.default_rng([seed, 41])
    equations, base = scores.equations, scores.base.tolist()
    folds, count = equations.folds, len(equations.regressors)
    outs = (None, *range(len(folds))) if len(folds) > 1 else (None,)
    observed = [equations.reduced(one) for one in outs]
    errors_of_folds = _errors(equations, base, replicates, rng, _error_shapes(equations, errors or {}))
    drawn = [_Replicates(fold, *own) for fold, own in zip(folds, errors_of_folds, strict=True)]
    sides = [
        np.zeros((count + sum(len(fold.nuisances) for fold in _kept(folds, out)), replicates)) for out in outs
    ]

    def noise() -> Iterator[tuple[slice, list[list[Array]], Array | None]]:
        for block in observed[0].pixels.blocks():
            size = (block.stop - block.start, replicates)

            def draw(shape: tuple[int, int] = size) -> Array:
                return rng.standard_normal(shape, dtype=np.float32)

            gains = np.float32(equations.pixels.gain) * draw() if equations.pixels.gain > 0 else None
            yield block, [[draw() for _ in range(replicates.unknowns)] for replicates in drawn], gains

    def of_block(item: tuple[slice, list[list[Array]], Array | None]) -> tuple[list[_OfBlock], list[Array]]:
        block, white, gains = item
        found = [replicates.of_block(block, own, gains) for replicates, own in zip(drawn, white, strict=True)]
        eliminated = []
        for reduced, out in zip(observed, outs, strict=True):
            kept = _kept(found, out)
            offset = np.sum([block_sums.offset for block_sums in kept], axis=0)
            gain = (
                np.sum([block_sums.gain for block_sums in kept], axis=0)
                if reduced.pixels.with_gains
                else None
            )
            parts = zip(reduced.pixels.rows(block), reduced.pixels.whitened(block, offset, gain), strict=True)
            eliminated.append(np.sum([rows[:, :-1].T @ summed for rows, summed in parts], axis=0))
        return found, eliminated

    for found, eliminated in in_order(of_block, noise(), threads=equations.threads):
        for fold_replicates, own in zip(drawn, found, strict=True):
            fold_replicates.add(own)
        for side, part in zip(sides, eliminated, strict=True):
            side -= part
    rights = [fold_replicates.right(rng) for fold_replicates in drawn]
    full, *trained = (
        replace(
            reduced,
            right=reduced.without_errors(side + stacked_sides(count, _kept(rights, out))),
        )
        for reduced, side, out in zip(observed, sides, outs, strict=True)
    )
    return scores.of_replicates(full, trained)


def _kept[Item](items: Sequence[Item], leave_out: int | None) -> list[Item]:
    return [item for i, item in enumerate(items) if i != leave_out]


def _error_shapes(equations: NormalEquations, errors: Mapping[str, float]) -> dict[str, Array]:
    """Return standardised errors by kind (surface and direction), scaled to unit variance at least."""
    found: dict[str, list[float]] = {}
    for fold in equations.folds:
        for name, prior, at in fold.nuisances:
            if name in errors:
                found.setdefault(kind_of_error(name), []).append((at + errors[name]) / prior)
    result = {}
    for kind, values in found.items():
        z = np.array(values)
        size = float(np.sqrt(np.mean(z**2)))
        if len(z) >= 8 and size > 0:
            result[kind] = z * max(1.0, 1.0 / size)
    return result


def error_size(equations: NormalEquations, errors: Mapping[str, float]) -> float:
    """Return the ratio of the errors of the worst kind to their stated size (RMS, 1 at least)."""
    shapes = _error_shapes(equations, errors).values()
    return max((float(np.sqrt(np.mean(z**2))) for z in shapes), default=1.0)


def kind_of_error(name: str) -> str:
    """Return surface and direction of a nuisance ``recording.pose.pose.SURFACE.DIRECTION``."""
    kind = name.split(".", 2)[2]
    return kind.rpartition(".")[0] if kind.startswith("light.") else kind


#: Owners of regressors for errors that every set-up has, whatever the camera: replicates contain them.
IMPERFECTIONS = (TILES, COMMON_POSE, SHAPE, OPTICS, LOBE_PREFIX, SENSOR)


def _errors(
    equations: NormalEquations,
    base: Sequence[int],
    replicates: int,
    rng: np.random.Generator,
    shapes: Mapping[str, Array],
) -> list[tuple[Array, Array]]:
    """Return for each fold the columns that have errors, and these (n, R): shared ones, then its own."""
    numbers = [int(i) for i in base if equations.regressors[int(i)].label.startswith(IMPERFECTIONS)]
    prior = priors_of([equations.regressors[i] for i in numbers])
    shared = prior[:, None] * rng.standard_normal((len(numbers), replicates))
    result = []
    for fold in equations.folds:
        own = np.empty((len(fold.nuisances), replicates))
        for i, (name, sigma, _) in enumerate(fold.nuisances):
            shape = shapes.get(kind_of_error(name))
            if shape is None:
                own[i] = sigma * rng.standard_normal(replicates)
            else:
                own[i] = sigma * rng.choice(shape, replicates) * rng.choice((-1.0, 1.0), replicates)
        first = len(equations.regressors)
        columns = np.array([*numbers, *range(first, first + len(own))], int)
        result.append((columns, np.concatenate([shared, own])))
    return result


@dataclass(frozen=True)
class _OfBlock:
    """Sums of a block's pixels (N, R); the terms that they add to right sides (M - 1, R) and take from the
    rest (M - 1, M - 1).
    """

    offset: Array
    gain: Array | None
    right: Array
    rest: Array


class _Replicates:
    """Replicates of a fold, streamed over the pixels; the ``errors`` (n, R) of ``columns`` are given."""

    def __init__(self, fold: Fold, columns: Array, errors: Array) -> None:
        self._fold, self._columns, self._errors = fold, columns, errors
        size = len(fold.gram) - 1
        # a pixel that no pose saw contributes nothing, whatever its prior
        priors = PixelPriors(1e6, 1e6 if fold.gain is not None else 0.0)
        self._flat = PixelElimination([fold], size - len(fold.nuisances), priors)
        self._rest = fold.gram[:size, :size].copy()
        self._right = fold.gram[:size, columns] @ errors
        self.unknowns = 1 if fold.gain is None else 2

    def of_block(self, block: slice, noise: list[Array], gains: Array | None) -> _OfBlock:
        """Return what the pixels of a block contribute with their ``noise`` and ``gains`` (N, R)."""
        fold, size = self._fold, len(self._rest)
        own = [rows[:, :size] for rows in self._flat.rows(block)]
        rest = np.sum([rows.T @ rows for rows in own], axis=0)
        right = np.sum([rows.T @ white for rows, white in zip(own, noise, strict=True)], axis=0)
        offset, gain = self._flat.sums_of(block, noise)
        offset += fold.pixel[block, self._columns] @ self._errors
        if gain is not None:
            assert fold.gain is not None
            gain += fold.gain[block, self._columns] @ self._errors
            if gains is not None:
                assert fold.gain_weight is not None
                assert fold.cross is not None
                right += fold.gain[block, :size].T @ gains
                offset += fold.cross[block, None] * gains
                gain += fold.gain_weight[block, None] * gains
        return _OfBlock(offset, gain, right, rest)

    def add(self, block_sums: _OfBlock) -> None:
        """Add a block."""
        self._right += block_sums.right
        self._rest -= block_sums.rest

    def right(self, rng: np.random.Generator) -> Array:
        """Return the right-hand sides (M - 1, R) of all blocks, with the noise that no offset absorbs."""
        # columns differ by many orders of magnitude
        diagonal = np.diag(self._rest)
        unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        values, vectors = linalg.eigh((self._rest + self._rest.T) / 2 / unit[:, None] / unit[None, :])
        spread = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(self._right + spread @ rng.standard_normal(self._right.shape))
