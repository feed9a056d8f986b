"""95 % intervals of parameters: a parametric bootstrap, checked by a jackknife over poses."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.calibrate.nulls import null_scores
from rim_camera_ros.calibrate.search import Exploration


def intervals_of(step: Exploration, *, seed: int = 0) -> dict[str, tuple[float, float, float]]:
    """Return value and 95 % interval of each parameter.

    From a parametric bootstrap (replicates of noise, errors of poses and powers in the normal equations,
    around the fit), widened where a jackknife over folds of poses says so.
    """
    fitted, scores = step.fit, step.scores
    count = len(fitted.parameters)
    nulls = null_scores(
        fitted.equations,
        range(count),
        replicates=200,
        seed=seed + 1,
        temper=scores.temper,
        errors=fitted.nuisances,
    )
    matrix = scores.full.gram[:count, :count] + np.diag(scores.prior[:count] ** -2)
    scale = scores.prior[:count]
    inner = matrix * scale[:, None] * scale[None, :]
    draws = scale[:, None] * np.linalg.solve(inner, nulls.full.right[:count] * scale[:, None])
    # the prior shrinks replicates as it shrinks the estimate: its own width belongs to the interval
    posterior = np.sqrt(np.diag(np.linalg.inv(inner))) * scale
    spread = np.maximum(draws.std(axis=1), posterior)
    if len(scores.trained) >= 4:
        folds = len(scores.trained)
        parts = np.array(
            [list(scores.values(leave_out=k).values())[:count] for k in range(folds)], dtype=float
        )
        jackknife = np.sqrt((folds - 1) / folds * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0))
        spread = np.maximum(spread, np.where(jackknife > 2.5 * spread, jackknife, 0.0))
    gain = fitted.camera.radiometry.gain
    result = {}
    for i, (path, value) in enumerate(fitted.parameters.items()):
        width = 1.96 * spread[i] * (gain if path == "radiometry.gain" else 1.0)
        result[path] = (value, value - width, value + width)
    return result
