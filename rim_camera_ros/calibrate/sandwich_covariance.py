"""Excess scatter between poses, which widens the intervals of an effect: a sandwich covariance.

Within a pose all pixels share errors of the model: texture that an error of the pose moves, a surface that is
not quite flat or not quite matt. The covariance of the adjustment does not contain these errors. The scores
of the poses (their terms of the gradient) do: their products, with poses as clusters, give the sandwich
estimator of the covariance (Liang & Zeger 1986). It is compared with its expected value under the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.effects.candidate import Block
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import ROBUST_LIMIT, after_nuisances
from rim_camera_ros.select.evidence import Scores

Array = NDArray[Any]
Key = tuple[int, int]

#: Least number of poses to estimate their scatter; weights of the expected ratio 1, and of a parameter in
#: each pose, in numbers of independent values.
LEAST_POSES = 10
_PRIOR_LOOKS = 10.0
_LOOKS_PER_POSE = 0.5
#: Least share of a parameter's variance that residuals of several poses must be able to show.
_LEAST_SHARED = 0.2


def widening(fitted: Fit, scores: Scores, blocks: Sequence[Block]) -> dict[str, float]:
    """Return the factors, at least 1, by which parameters' variances exceed those of the model, by label.

    A factor is the larger of the parameter's own and of its effect's, which is estimated from more values.
    ``blocks`` give the columns of regressors of the base; regressors without columns have no factor. Empty
    for too few poses.
    """
    labels = [scores.regressors[int(i)].label for i in scores.base]
    own = [(k, regressor) for block in blocks for k, regressor in enumerate(block.regressors)]
    place = [labels.index(regressor.label) for _, regressor in own if regressor.label in labels]
    if not place:
        return {}
    mean = _pixel_means(fitted, scores, place)
    gradients: dict[Key, Array] = {}
    grams: dict[Key, Array] = {}
    for prediction in fitted.forward.predictions():
        if not prediction.used.any():
            continue
        key = (prediction.station.recording, prediction.station.placed)
        gradient, gram = _scores_of(prediction, fitted, blocks, labels, mean)
        gradients[key] = gradients.get(key, 0.0) + gradient
        grams[key] = grams.get(key, 0.0) + gram
    if len(gradients) < LEAST_POSES:
        return {}
    covariance = scores.covariance(scores.base)[np.ix_(place, place)]
    found = np.zeros(len(place))
    expected = np.zeros(len(place))
    for key, gradient in gradients.items():
        found += (covariance @ gradient) ** 2
        gram = grams[key]
        # residuals are smaller than errors, as the pose itself draws the fit
        expected += np.diag(covariance @ (gram - gram @ covariance @ gram) @ covariance)
    # a parameter that one pose alone determines follows that pose: its residuals show no scatter of poses
    shared = expected > _LEAST_SHARED * np.diag(covariance)
    ratio = found / np.where(shared, expected, 1.0)
    owners = [scores.regressors[int(scores.base[i])].owner for i in place]
    result = {}
    for k, column in enumerate(place):
        mine = ratio[[i for i, name in enumerate(owners) if name == owners[k] and shared[i]]]
        if not mine.size:
            continue
        levels = [_level(mine, len(gradients))]
        if shared[k]:
            levels.append(_level(ratio[[k]], len(gradients)))
        result[labels[column]] = max(1.0, *levels)
    return result


def _level(ratios: Array, poses: int) -> float:
    """Return the mean of ratios, shrunk towards its expected value 1, the more the fewer there are."""
    looks = _LOOKS_PER_POSE * poses * len(ratios)
    return (looks * float(np.mean(ratios)) + _PRIOR_LOOKS) / (looks + _PRIOR_LOOKS)


def _pixel_means(fitted: Fit, scores: Scores, place: Sequence[int]) -> Array | None:
    """Return the weighted mean of each column over each pixel's values (P, K), None without a pattern."""
    folds = fitted.equations.folds
    if not fitted.equations.pixels.size or fitted.equations.pixels.seen is None:
        return None
    columns = [int(scores.base[i]) for i in place]
    total = np.sum([fold.pixel[:, columns] for fold in folds], axis=0)
    weight = np.sum([fold.weight for fold in folds], axis=0) + fitted.equations.pattern_prior**-2
    return fitted.equations.pixels.everywhere(total / weight[:, None])


def _scores_of(
    predicted: Prediction, fitted: Fit, blocks: Sequence[Block], labels: Sequence[str], mean: Array | None
) -> tuple[Array, Array]:
    """Return gradient (K,) and information (K, K) of a station, given its pose's errors and the pattern."""
    pairs = [
        pair
        for block in blocks
        for regressor, pair in zip(block.regressors, block.columns(predicted), strict=True)
        if regressor.label in labels
    ]
    used, lit = predicted.used, predicted.amplitude_used
    rest, light = after_nuisances(predicted, fitted.pattern, fitted.nuisances)
    design = [np.stack([np.asarray(d)[used] for d, _ in pairs], axis=1)]
    if mean is not None:
        design[0] = design[0] - mean[np.flatnonzero(used.ravel())]
    zero = np.zeros(used.shape)
    design.append(np.stack([(zero if a is None else np.asarray(a))[lit] for _, a in pairs], axis=1))
    key = f"{predicted.station.recording}.{predicted.station.pose}"
    priors = {name: prior for fold in fitted.equations.folds for name, prior, _ in fold.nuisances}
    placed = f"{predicted.station.recording}.{predicted.station.placed}"
    errors = [(c, priors.get(f"{placed}.{c.path}")) for c in predicted.pose_columns]
    changes = [(predicted.pose_change(c), prior) for c, prior in errors if prior is not None]
    if f"{key}.gain" in priors:
        changes.append((predicted.gain_column(), priors[f"{key}.gain"]))
    if f"{key}.light.real.{predicted.station.stamp}" in priors:
        for part, column in predicted.light_columns().items():
            changes.append((column, priors[f"{key}.light.{part}.{predicted.station.stamp}"]))
    limit_d = ROBUST_LIMIT * predicted.sigma[used]
    limit_a = ROBUST_LIMIT * predicted.amplitude_sigma[lit]
    residual = np.concatenate(
        [np.clip(rest[used], -limit_d, limit_d), np.clip(light[lit], -limit_a, limit_a)]
    )
    weight = np.concatenate([predicted.sigma[used] ** -2, predicted.amplitude_sigma[lit] ** -2])
    x = np.nan_to_num(np.concatenate(design))
    if changes:
        nuisance = np.nan_to_num(
            np.stack([np.concatenate([d[used], a[lit]]) * prior for (d, a), prior in changes], axis=1)
        )
        inner = nuisance.T @ (nuisance * weight[:, None]) + np.eye(nuisance.shape[1])
        x = x - nuisance @ linalg.solve(inner, nuisance.T @ (x * weight[:, None]), assume_a="pos")
    return x.T @ (weight * residual), x.T @ (x * weight[:, None])
