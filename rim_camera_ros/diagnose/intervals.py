"""95 % intervals of parameters: a parametric bootstrap, checked by a jackknife over poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.bounds import Bounds
from rim_camera_ros.fit.design import GAIN
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.null_replicates import null_scores

Array = NDArray[Any]

#: A jackknife of five folds is itself uncertain: it counts from this many times the bootstrap's spread.
_LEAST_OF_POSES = 2.5
_LEAST_OF_TIME = 1.5
_BLOCKS = 8


def _jackknife(scores: Scores, count: int) -> Array:
    folds = len(scores.trained)
    parts = np.array([list(scores.values(leave_out=k).values())[:count] for k in range(folds)], dtype=float)
    return np.asarray(np.sqrt((folds - 1) / folds * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0)))


def _by_time(problem: Problem, fitted: Fit) -> Scores | None:
    """Return scores of blocks of placements in order of time: they part where a form is not quite true."""
    times: dict[tuple[int, int], float] = {}
    for one in problem.dataset.stations:
        times.setdefault((one.recording, one.placed), one.time)
    if len(times) < 2 * _BLOCKS:
        return None
    ordered = sorted(times, key=lambda key: (key[0], times[key]))
    number = {key: i * _BLOCKS // len(ordered) for i, key in enumerate(ordered)}
    blocks = {
        (one.recording, one.pose): number[one.recording, one.placed] for one in problem.dataset.stations
    }
    again = fit(problem, fitted.camera, fold_of=blocks, views=fitted.forward.views, warm=fitted, iterations=0)
    return Scores(again.equations, range(len(again.parameters)))


def intervals_of(
    step: Exploration, problem: Problem, *, seed: int = 0
) -> dict[str, tuple[float, float, float]]:
    """Return value and 95 % interval of each parameter.

    From a parametric bootstrap (replicates of noise, errors of poses and powers in the normal equations,
    around the fit), widened where a jackknife over folds of poses, dealt or in blocks of time, says so, and
    cut at the parameter's bounds.
    """
    fitted, scores = step.fit, step.scores
    count = len(fitted.parameters)
    nulls = null_scores(scores, replicates=200, seed=seed + 1, errors=fitted.nuisances)
    matrix = scores.full.gram[:count, :count] + np.diag(scores.prior[:count] ** -2)
    scale = scores.prior[:count]
    inner = matrix * scale[:, None] * scale[None, :]
    draws = scale[:, None] * np.linalg.solve(inner, nulls.full.right[:count] * scale[:, None])
    # the prior shrinks replicates as it shrinks the estimate: its own width belongs to the interval
    posterior = np.sqrt(np.diag(np.linalg.inv(inner))) * scale
    spread = np.maximum(draws.std(axis=1), posterior)
    for one, least in ((scores, _LEAST_OF_POSES), (_by_time(problem, fitted), _LEAST_OF_TIME)):
        if one is not None and len(one.trained) >= 4:
            jackknife = _jackknife(one, count)
            spread = np.maximum(spread, np.where(jackknife > least * spread, jackknife, 0.0))
    gain = fitted.camera.radiometry.gain
    bounds = Bounds.of(fitted.camera)
    result = {}
    for i, (path, value) in enumerate(fitted.parameters.items()):
        width = 1.96 * spread[i] * (gain if path == GAIN else 1.0)
        # beyond its bounds no parameter can be
        low, high = bounds.lows.get(path, -np.inf), bounds.highs.get(path, np.inf)
        result[path] = (value, max(value - width, min(value, low)), min(value + width, max(value, high)))
    return result
