"""Whether a further effect is confounded with the effects found before it, or a drift with chance.

The form of a large effect is never quite the true one, and its residuals look like small other effects in the
pixels where it acts. A true further effect shows in the other pixels as well, in proportion to their
information about it. A drift follows the time of the poses better than it follows permuted times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.candidate import Block, Candidate, Column, Regressor, priors_of
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.candidates import form_blocks
from rim_camera_ros.select.effect_sizes import change_by
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.exploration import Exploration, further_equations
from rim_camera_ros.select.thresholds import WITHOUT_REPLICATES

Array = NDArray[Any]

#: Random orders of the poses, and the share of them that may explain as much as the true order.
_ORDERS = 400
_SHARE = 0.01
#: Poses below which there are too few orders for a test.
_LEAST_POSES = 8
#: Greatest remainder of the poses' own shifts, in sigmas of chi-square beyond that of their stated errors;
#: more where the drift explains the following share of it.
_LEFT = 3.0
_MOST = 2 / 3
#: 1-sigma of a pose's own shift [m]: as good as free.
_FREE = 1.0


def follows_time(
    fitted: Fit,
    name: str,
    variants: Sequence[Candidate],
    folds: Mapping[tuple[int, int], int],
    problem: Problem,
    *,
    conditional_on: Sequence[Block] = (),
    seed: int = 0,
) -> bool | None:
    """Return whether the drift ``name`` of a fit explains more than in nearly all random orders of poses.

    It must also leave errors of the poses that are as small as stated, or explain most of their excess.
    ``variants`` are its candidates in the library; the test is ``conditional_on`` further regressors. True
    where there are too few poses for a test. None where the pixels of the ``problem`` show no drift and
    contain too little information to show even one of the size that was fitted.
    """
    poses = list(dict.fromkeys((station.recording, station.placed) for station in problem.dataset.stations))
    if len(poses) < _LEAST_POSES or not variants:
        return True
    shifts, shapes = _by_pose(fitted, name, variants, poses)
    with_poses = further_equations(fitted, [*conditional_on, _pose_block(poses)], folds, problem)
    count = len(with_poses.equations.regressors)
    own = range(count - len(poses), count)
    base = [i for i in range(count) if i not in own and with_poses.equations.regressors[i].owner != name]
    gram, right = Scores(with_poses.equations, base).conditional_on_base(own)
    # as if the drift had not been fitted
    right = right + gram @ shifts
    random = np.random.default_rng(seed)
    true = _explained(gram, right, shapes, np.arange(len(poses)))
    every = 0.5 * float(right @ np.linalg.pinv(gram) @ right)
    expected = 0.5 * len(poses)
    if true < WITHOUT_REPLICATES:
        expected_of_fitted = 0.5 * float(shifts @ gram @ shifts)
        return None if expected_of_fitted < 2 * WITHOUT_REPLICATES else False
    enough = every - true <= expected + _LEFT * np.sqrt(expected) or true >= _MOST * (every - expected)
    others = [_explained(gram, right, shapes, random.permutation(len(poses))) for _ in range(_ORDERS)]
    return bool(enough and np.mean(np.array(others) >= true) <= _SHARE)


def _by_pose(
    fitted: Fit, name: str, variants: Sequence[Candidate], poses: Sequence[tuple[int, int]]
) -> tuple[Array, list[tuple[Array, Array]]]:
    """Return the drift at the poses [m], (P,), and for each variant its columns (P, K) and their priors."""
    numbers = {key: i for i, key in enumerate(poses)}
    stations = np.zeros(len(poses))
    shifts = np.zeros(len(poses))
    columns = [np.zeros((len(poses), len(variant.block.regressors))) for variant in variants]
    for prediction in fitted.forward.predictions(slopes=False):
        at = numbers[prediction.station.recording, prediction.station.placed]
        stations[at] += 1
        shifts[at] += float(np.mean(change_by(prediction, name)[0]))
        for variant, values in zip(variants, columns, strict=True):
            values[at] += [float(np.mean(column)) for column, _ in variant.block.columns(prediction)]
    counts = np.maximum(stations, 1)
    priors = [priors_of(variant.block.regressors) for variant in variants]
    shapes = [(values / counts[:, None], prior) for values, prior in zip(columns, priors, strict=True)]
    return shifts / counts, shapes


def _pose_block(poses: Sequence[tuple[int, int]]) -> Block:
    """Return regressors that shift all pixels of one pose each."""

    def columns(prediction: Prediction) -> list[Column]:
        zero, one = np.zeros(prediction.distance.shape), np.ones(prediction.distance.shape)
        here = (prediction.station.recording, prediction.station.placed)
        return [(one if pose == here else zero, None) for pose in poses]

    names = (f"shift.{recording}.{pose}" for recording, pose in poses)
    return Block(tuple(Regressor(name, "shift", _FREE) for name in names), columns)


def _explained(gram: Array, right: Array, shapes: Sequence[tuple[Array, Array]], order: Array) -> float:
    """Return how much the best shape explains [nats] with its values assigned to the poses in an order."""
    best = 0.0
    for values, prior in shapes:
        dealt = values[order] * prior
        matrix = dealt.T @ gram @ dealt + np.eye(dealt.shape[1])
        side = dealt.T @ right
        best = max(best, 0.5 * float(side @ np.linalg.solve(matrix, side)))
    return best


#: An effect does not act on a pixel that it changes by less than this, in sigmas of the pixel's mean.
_QUIET = 0.3
#: Least share of the pixels that must remain for a test.
_LEAST_LEFT = 0.05
#: A further effect must gain this share of what is expected of it in the remaining pixels.
_LEAST_PART = 0.3


def shows_in_quiet_pixels(
    problem: Problem,
    step: Exploration,
    number: int,
    found: Sequence[str],
    folds: Mapping[tuple[int, int], int],
) -> bool:
    """Return whether a candidate of an exploration gains where the effects ``found`` do not act.

    True also where that cannot be tested: too few pixels remain, or they contain too little information, or
    what was found are parameters of the optics or of surfaces, which act everywhere.
    """
    names = [name for name in found if name in step.fit.camera.effects]
    if not names:
        return True
    masks = quiet_pixels(step.fit, names)
    if masks is None:
        return True
    candidate, span = step.candidates[number], step.spans[number]
    fitted = fit(
        replace(problem, masks=masks),
        step.fit.camera,
        fold_of=folds,
        further=[candidate.block],
        views=step.fit.forward.views,
        warm=step.fit,
        iterations=0,
    )
    count = len(fitted.parameters)
    own = list(range(count, count + len(span)))
    scores = Scores(fitted.equations, range(count), held=fitted.at_bounds)
    values = step.scores.values(span)
    strength = np.array([values[regressor.label] for regressor in candidate.block.regressors])
    whole = step.scores.expected_gain(span, strength)
    if whole <= 0:
        return True
    wanted = float(step.gains[number]) * scores.expected_gain(own, strength) / whole
    if wanted < 2 * WITHOUT_REPLICATES:
        return True
    return float(scores.gain(own)) > _LEAST_PART * wanted


def quiet_pixels(fitted: Fit, names: Sequence[str]) -> list[tuple[Array, Array]] | None:
    """Return the pixels of each station and channel (H, W) that effects do not change.

    None where too few remain.
    """
    masks, used, kept = [], 0, 0
    for prediction in fitted.forward.predictions():
        distance, light = prediction.used, prediction.amplitude_used
        used += int(distance.sum())
        for name in names:
            moved, changed = change_by(prediction, name)
            distance = distance & (np.abs(np.nan_to_num(moved)) < _QUIET * prediction.sigma)
            if changed is not None:
                light = light & (np.abs(np.nan_to_num(changed)) < _QUIET * prediction.amplitude_sigma)
        kept += int(distance.sum())
        masks.append((distance, light))
    return masks if kept >= _LEAST_LEFT * max(used, 1) else None


def follows_time_in_quiet_pixels(
    fitted: Fit,
    name: str,
    problem: Problem,
    folds: Mapping[tuple[int, int], int],
    *,
    found: Sequence[str],
    drifts: Sequence[Candidate],
    curves: Sequence[Candidate],
    variants: Sequence[Candidate],
    seed: int,
) -> bool:
    """Return whether a drift ``name`` follows time, as in `follows_time`, where effects found do not act.

    The forms of the effects ``found`` before it are never quite the true ones. So the test is conditional on
    ``curves`` of their covariates and on changes of their forms by their ``variants``. ``drifts`` are the
    candidates of the drift itself. The test uses all pixels where those on which the effects do not act
    contain too little information: as where only the pixels of one integration time remain.
    """
    # the residuals of an inexact form vary with its own covariates, and these may vary with time
    effects = [fitted.camera.effects[effect] for effect in found if effect in fitted.camera.effects]
    covariates = {covariate for effect in effects for covariate in effect.own_covariates()}
    own = [curve.block for curve in curves if curve.variant in covariates]
    conditional_on = [*own, *form_blocks(fitted, found, variants)]
    masks = quiet_pixels(fitted, [effect.name for effect in effects])
    quiet = [] if masks is None else [replace(problem, masks=masks)]
    for there in (*quiet, problem):
        follows = follows_time(fitted, name, drifts, folds, there, conditional_on=conditional_on, seed=seed)
        if follows is not None:
            return follows
    return False
