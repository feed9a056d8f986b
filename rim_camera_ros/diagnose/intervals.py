"""95 % intervals of parameters: a parametric bootstrap, checked by a jackknife over poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.bounds import Bounds
from rim_camera_ros.fit.design import GAIN
from rim_camera_ros.fit.problem import Fit, Problem, blocks_of
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.null_replicates import null_scores

Array = NDArray[Any]

#: Ratio to the bootstrap's spread above which a jackknife counts: one of five folds is itself uncertain.
_LEAST_OF_POSES = 2.5
_LEAST_OF_TIME = 1.5
_BLOCKS = 8
#: Least number of folds of the poses for a jackknife.
_LEAST_PARTS = 4


@dataclass(frozen=True)
class Uncertainty:
    """Covariances (K, K) of the parameters of a fit, by several estimators.

    ``draws`` is that of bootstrap replicates, ``posterior`` the posterior one. ``jackknives`` over folds of
    the poses count where they exceed these by the stated factor, as they are uncertain themselves.
    """

    draws: Array
    posterior: Array
    jackknives: tuple[tuple[Array, float], ...]

    def sigma(self, form: Array) -> float:
        """Return the root mean square error of a quadratic form (K, K) of the parameters."""
        return float(self._largest(lambda covariance: np.sum(form * covariance)))

    def of_each(self) -> Array:
        """Return the 1-sigma of each parameter (K,)."""
        return self._largest(np.diag)

    def _largest(self, variance: Callable[[Array], Any]) -> Array:
        def of(covariance: Array) -> Array:
            return np.asarray(np.sqrt(np.maximum(variance(covariance), 0.0)))

        spread = np.maximum(of(self.draws), of(self.posterior))
        for covariance, least in self.jackknives:
            own = of(covariance)
            spread = np.maximum(spread, np.where(own > least * spread, own, 0.0))
        return np.asarray(spread)


def _jackknife(scores: Scores, count: int) -> Array:
    folds = len(scores.trained)
    parts = np.array([list(scores.values(leave_out=k).values())[:count] for k in range(folds)], dtype=float)
    apart = parts - parts.mean(axis=0)
    return np.asarray((folds - 1) / folds * apart.T @ apart)


def _by_time(problem: Problem, fitted: Fit) -> Scores | None:
    """Return scores of blocks of placements in order of time: they disagree where a form is inexact."""
    times: dict[tuple[int, int], float] = {}
    for station in problem.dataset.stations:
        times.setdefault((station.recording, station.placed), station.time)
    if len(times) < 2 * _BLOCKS:
        return None
    ordered = sorted(times, key=lambda key: (key[0], times[key]))
    number = {key: i * _BLOCKS // len(ordered) for i, key in enumerate(ordered)}
    blocks = {
        (station.recording, station.pose): number[station.recording, station.placed]
        for station in problem.dataset.stations
    }
    again = fit(problem, fitted.camera, fold_of=blocks, views=fitted.forward.views, warm=fitted, iterations=0)
    return Scores(again.equations, range(len(again.parameters)), held=again.at_bounds)


def uncertainty_of(step: Exploration, problem: Problem, *, seed: int = 0) -> Uncertainty:
    """Return the uncertainty of the parameters of the fit of a step.

    It comes from a parametric bootstrap (replicates of noise, errors of poses and powers in the normal
    equations, around the fit), widened where a jackknife over folds of poses, or over blocks of time, is
    wider.
    """
    fitted, scores = step.fit, step.scores
    count = len(fitted.parameters)
    nulls = null_scores(scores, replicates=200, seed=seed + 1, errors=fitted.nuisances)
    matrix = scores.full.gram[:count, :count] + np.diag(scores.prior[:count] ** -2)
    scale = scores.prior[:count]
    inner = matrix * scale[:, None] * scale[None, :]
    draws = scale[:, None] * np.linalg.solve(inner, nulls.full.right[:count] * scale[:, None])
    apart = draws - draws.mean(axis=1, keepdims=True)
    parts = ((scores, _LEAST_OF_POSES), (_by_time(problem, fitted), _LEAST_OF_TIME))
    return Uncertainty(
        apart @ apart.T / draws.shape[1],
        # the prior shrinks replicates as it shrinks the estimate: its own width belongs to the interval
        np.linalg.inv(inner) * scale[:, None] * scale[None, :],
        tuple(
            (_jackknife(folded, count), least)
            for folded, least in parts
            if folded is not None and len(folded.trained) >= _LEAST_PARTS
        ),
    )


def intervals_of(fitted: Fit, uncertainty: Uncertainty) -> dict[str, tuple[float, float, float]]:
    """Return value and 95 % interval of each parameter, cut at the parameter's bounds."""
    spread = uncertainty.of_each()
    gain = fitted.camera.radiometry.gain
    bounds = Bounds.of(fitted.camera)
    result = {}
    for i, (path, value) in enumerate(fitted.parameters.items()):
        width = 1.96 * spread[i] * (gain if path == GAIN else 1.0)
        # no parameter can be beyond its bounds
        low, high = bounds.lows.get(path, -np.inf), bounds.highs.get(path, np.inf)
        result[path] = (value, max(value - width, min(value, low)), min(value + width, max(value, high)))
    return result


def distances_known_to(
    fitted: Fit, problem: Problem, uncertainty: Uncertainty, names: Sequence[str]
) -> dict[str, float]:
    """Return the 1-sigma of the distances [m] that effects cause: RMS over the pixels of the recording.

    Apart from what is the same for a pixel in all poses, which its offset absorbs. The parameters' intervals
    may consist mostly of that, as for the mean of the offsets of all integration times.
    """
    blocks = blocks_of(problem, fitted.camera, fitted.scene)
    starts = np.cumsum([0, *(len(block.regressors) for block in blocks)])
    own = {
        int(start): block
        for start, block in zip(starts, blocks, strict=False)
        if any(regressor.owner in names for regressor in block.regressors)
    }
    if not own:
        return {}
    numbers = [start + k for start, block in own.items() for k in range(len(block.regressors))]
    owners = [regressor.owner for block in own.values() for regressor in block.regressors]
    size = fitted.camera.shape[0] * fitted.camera.shape[1]
    sums, seen = np.zeros((len(numbers), size)), np.zeros(size)
    products = np.zeros((len(numbers), len(numbers)))
    for prediction in fitted.forward.predictions():
        used = np.flatnonzero(prediction.used)
        columns = [column for block in own.values() for column, _ in block.columns(prediction)]
        x = np.array(
            [np.nan_to_num(np.broadcast_to(each, prediction.used.shape)).ravel()[used] for each in columns]
        )
        products += x @ x.T
        sums[:, used] += x
        seen[used] += 1
    products -= (sums / np.maximum(seen, 1.0)) @ sums.T
    result = {}
    for name in set(owners) & set(names):
        mine = [k for k, owner in enumerate(owners) if owner == name]
        at = [numbers[k] for k in mine]
        form = np.zeros((len(fitted.parameters),) * 2)
        form[np.ix_(at, at)] = products[np.ix_(mine, mine)] / max(seen.sum(), 1.0)
        result[name] = uncertainty.sigma(form)
    return result
