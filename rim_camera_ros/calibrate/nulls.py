"""Recordings in which nothing is left out, drawn in the space of the normal equations.

Under the fitted baseline the sums that the equations consist of are Gaussian with a known covariance, so that
a replicate of noise, pose errors and powers costs a few products instead of a simulated recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.calibrate.fold_sums import Fold
from rim_camera_ros.calibrate.normal_equations import NormalEquations, Reduced, pixel_blocks
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


@dataclass(frozen=True)
class _Draw:
    """Right-hand sides (M - 1, R) and sums per pixel (P, R) of the replicates of one fold."""

    right: Array
    pixel: Array


def null_scores(
    equations: NormalEquations,
    base: Sequence[int],
    *,
    replicates: int = 200,
    seed: int = 0,
    errors: Mapping[str, float] | None = None,
) -> Scores:
    """Return scores whose right-hand sides are those of replicates, (K, R).

    ``errors`` found of poses and powers give the replicates' errors their shape: instruments err with
    heavier tails than a Gaussian, and a few large errors imitate a drift. They are dealt to the poses at
    random.
    """
    rng = np.random.default_rng([seed, 41])
    shapes = _error_shapes(equations, errors or {})
    draws = [_draw(fold, replicates, rng, shapes) for fold in equations.folds]
    scores = Scores.__new__(Scores)
    scores.regressors = equations.regressors
    scores.base = np.array(sorted(base), int)
    scores.prior = np.array([one.prior for one in equations.regressors])
    scores.temper = 1.0

    def reduced(leave_out: int | None) -> Reduced:
        kept = [one for i, one in enumerate(draws) if i != leave_out]
        observed = equations.reduced(leave_out)
        return replace(observed, right=observed.sides([(one.right, one.pixel) for one in kept]))

    folds = range(len(equations.folds)) if len(equations.folds) > 1 else ()
    scores.full, *scores.trained = in_order(reduced, (None, *folds), threads=equations.threads)
    return scores


def _error_shapes(equations: NormalEquations, errors: Mapping[str, float]) -> dict[str, Array]:
    """Return standardised errors by kind (surface and direction), of unit variance at least."""
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


def kind_of_error(name: str) -> str:
    """Return surface and direction of a nuisance ``recording.pose.pose.SURFACE.DIRECTION``."""
    kind = name.split(".", 2)[2]
    return kind.rpartition(".")[0] if kind.startswith("light.") else kind


def _draw(fold: Fold, replicates: int, rng: np.random.Generator, shapes: Mapping[str, Array]) -> _Draw:
    size = fold.gram.shape[0] - 1
    count = size - len(fold.nuisances)
    design = fold.pixel[:, :size]
    weight = fold.weight
    lit = weight > 0
    root = np.sqrt(weight).astype(np.float32)
    noise = root[:, None] * rng.standard_normal((len(weight), replicates), dtype=np.float32)
    inverse = np.where(lit, 1.0 / np.where(lit, weight, 1.0), 0.0)
    mean = design.T @ (noise * inverse[:, None].astype(np.float32))
    rest = fold.gram[:size, :size].copy()
    for rows, block in pixel_blocks([fold], count):
        scaled = block[:, :size] * np.sqrt(inverse[rows])[:, None]
        rest -= scaled.T @ scaled
    # columns differ by many orders of magnitude
    diagonal = np.diag(rest)
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = linalg.eigh((rest + rest.T) / 2 / unit[:, None] / unit[None, :])
    spread = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    right = mean.astype(float) + spread @ rng.standard_normal((size, replicates))
    if fold.nuisances:
        errors = np.empty((len(fold.nuisances), replicates))
        for i, (name, prior, _) in enumerate(fold.nuisances):
            shape = shapes.get(kind_of_error(name))
            if shape is None:
                errors[i] = prior * rng.standard_normal(replicates)
            else:
                errors[i] = prior * rng.choice(shape, replicates) * rng.choice((-1.0, 1.0), replicates)
        right += fold.gram[:size, count:size] @ errors
        noise += design[:, count:] @ errors.astype(design.dtype)
    return _Draw(right, noise)
