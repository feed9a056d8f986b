"""Does a drift follow time, or does it merely fit poses that something else moves?

What the form of a large effect leaves moves whole poses too, and two or three parameters of a drift follow
any forty numbers a little. So a drift must explain more in the order of the poses than in random orders: a
permutation test (Fisher 1935), whose null contains whatever else moves poses. And with a true drift poses are
either as good as stated, or it is most of what moved them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.exploration import LEAST_THRESHOLD, further_equations
from rim_camera_ros.calibrate.prediction import Prediction
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.calibrate.sizes import change_by
from rim_camera_ros.effects.candidate import Block, Candidate, Column, Regressor

Array = NDArray[Any]

#: Random orders, and the share of them that may explain as much as the true one.
_ORDERS = 400
_SHARE = 0.01
#: Poses below which orders are too few to tell.
_LEAST_POSES = 8
#: What may be left of the poses' own shifts, in sigmas of chi-square beyond what the stated errors make; more
#: where the drift explains this share of it.
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
    beside: Sequence[Block] = (),
    seed: int = 0,
) -> bool:
    """Return whether the drift ``name`` of a fit explains more than in nearly all random orders of poses.

    And whether poses are then as good as stated, or nearly all that moved them is explained.
    ``variants`` are its candidates in the library; ``beside`` are further regressors that stand beside it.
    True where there are too few poses to tell.
    """
    poses = list(dict.fromkeys((one.recording, one.placed) for one in problem.dataset.stations))
    if len(poses) < _LEAST_POSES or not variants:
        return True
    shifts, shapes = _by_pose(fitted, name, variants, poses)
    with_poses = further_equations(fitted, [*beside, _pose_block(poses)], folds, problem)
    count = len(with_poses.equations.regressors)
    own = range(count - len(poses), count)
    base = [i for i in range(count) if i not in own and with_poses.equations.regressors[i].owner != name]
    gram, right = Scores(with_poses.equations, base).beside_base(own)
    # as if the drift had not been fitted
    right = right + gram @ shifts
    random = np.random.default_rng(seed)
    true = _explained(gram, right, shapes, np.arange(len(poses)))
    every = 0.5 * float(right @ np.linalg.pinv(gram) @ right)
    expected = 0.5 * len(poses)
    if true < LEAST_THRESHOLD:
        return False
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
    columns = [np.zeros((len(poses), len(one.block.regressors))) for one in variants]
    for prediction in fitted.forward.predictions(slopes=False):
        at = numbers[prediction.station.recording, prediction.station.placed]
        stations[at] += 1
        shifts[at] += float(np.mean(change_by(prediction, name)[0]))
        for one, values in zip(variants, columns, strict=True):
            values[at] += [float(np.mean(column)) for column, _ in one.block.columns(prediction)]
    counts = np.maximum(stations, 1)
    priors = [np.array([r.prior for r in one.block.regressors]) for one in variants]
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
    """Return how much the best shape explains [nats] with its values dealt to the poses in an order."""
    best = 0.0
    for values, prior in shapes:
        dealt = values[order] * prior
        matrix = dealt.T @ gram @ dealt + np.eye(dealt.shape[1])
        side = dealt.T @ right
        best = max(best, 0.5 * float(side @ np.linalg.solve(matrix, side)))
    return best
