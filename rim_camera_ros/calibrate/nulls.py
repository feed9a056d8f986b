"""Recordings in which nothing is left out, drawn in the space of the normal equations.

Under the fitted baseline the sums that the equations consist of are Gaussian with a known covariance, so that
a replicate of noise, pose errors and powers costs a few products instead of a simulated recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.calibrate.fold_sums import Fold
from rim_camera_ros.calibrate.normal_equations import (
    Draw,
    NormalEquations,
    PixelElimination,
    PixelPriors,
    Reduced,
)
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.threads import in_order

Array = NDArray[Any]


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
    common = _common(equations, base, replicates, rng)
    draws = [_draw(fold, replicates, rng, shapes, common) for fold in equations.folds]
    scores = Scores.__new__(Scores)
    scores.regressors = equations.regressors
    scores.base = np.array(sorted(base), int)
    scores.prior = np.array([one.prior for one in equations.regressors])
    scores.temper = 1.0
    scores.away = np.zeros(len(scores.prior))

    def reduced(leave_out: int | None) -> Reduced:
        kept = [one for i, one in enumerate(draws) if i != leave_out]
        observed = equations.reduced(leave_out)
        return replace(observed, right=observed.sides(kept))

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


#: Owners of regressors that stand for what every set-up has, whatever the camera: replicates contain them.
IMPERFECTIONS = ("reflectivity.", "common_pose.", "optics_covariance.", "radiometry.lobe.")


def _common(
    equations: NormalEquations, base: Sequence[int], replicates: int, rng: np.random.Generator
) -> tuple[Array, Array, Array | None]:
    """Return what all folds share: numbers of regressors, their values (K, R), and gains of pixels (P, R)."""
    own = [int(i) for i in base if equations.regressors[int(i)].label.startswith(IMPERFECTIONS)]
    prior = np.array([equations.regressors[i].prior for i in own])
    values = prior[:, None] * rng.standard_normal((len(own), replicates))
    gains = None
    if equations.pixels.gain > 0:
        pixels = len(equations.folds[0].weight)
        gains = rng.standard_normal((pixels, replicates), dtype=np.float32)
        gains *= np.float32(equations.pixels.gain)
    return np.array(own, int), values, gains


def _draw(
    fold: Fold,
    replicates: int,
    rng: np.random.Generator,
    shapes: Mapping[str, Array],
    common: tuple[Array, Array, Array | None],
) -> Draw:
    size = fold.gram.shape[0] - 1
    count = size - len(fold.nuisances)
    # a pixel that no pose saw says nothing, whatever its prior
    flat = PixelElimination([fold], count, PixelPriors(1e6, 1e6 if fold.gain is not None else 0.0))
    rest = fold.gram[:size, :size].copy()
    mean = np.zeros((size, replicates))
    offset, gain = flat.draw(replicates, rng)
    for rows, noise in zip(flat.rows(), flat.whitened(offset, gain), strict=True):
        own = rows[:, :size]
        rest -= own.T @ own
        mean += own.T @ noise
    # columns differ by many orders of magnitude
    diagonal = np.diag(rest)
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = linalg.eigh((rest + rest.T) / 2 / unit[:, None] / unit[None, :])
    spread = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    right = mean + spread @ rng.standard_normal((size, replicates))

    def add(columns: Array, errors: Array) -> None:
        nonlocal right, offset, gain
        right += fold.gram[:size, columns] @ errors
        offset = offset + fold.pixel[:, columns] @ errors
        if gain is not None and fold.gain is not None:
            gain = gain + fold.gain[:, columns] @ errors

    if fold.nuisances:
        drawn = np.empty((len(fold.nuisances), replicates))
        for i, (name, prior, _) in enumerate(fold.nuisances):
            shape = shapes.get(kind_of_error(name))
            if shape is None:
                drawn[i] = prior * rng.standard_normal(replicates)
            else:
                drawn[i] = prior * rng.choice(shape, replicates) * rng.choice((-1.0, 1.0), replicates)
        add(np.arange(count, size), drawn)
    numbers, shared, gains = common
    if numbers.size:
        add(numbers, shared)
    if gains is not None and gain is not None and fold.gain is not None:
        assert fold.gain_weight is not None
        assert fold.cross is not None
        right += fold.gain[:, :size].T @ gains
        offset = offset + fold.cross[:, None] * gains
        gain = gain + fold.gain_weight[:, None] * gains
    return Draw(right, offset, gain)
