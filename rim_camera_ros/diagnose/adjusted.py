"""Known terms whose parameters differ from the camera file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri
from scipy.stats import median_abs_deviation

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.effects.sections import Radiometry
from rim_camera_ros.fit.design import GAIN
from rim_camera_ros.fit.pixel_elimination import stacked
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.select.compare import LEAST_SIZE, Result, entry_gain
from rim_camera_ros.select.effect_sizes import contribution
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.null_replicates import IMPERFECTIONS
from rim_camera_ros.select.thresholds import ALARM_RATE

Array = NDArray[Any]

#: A term has moved where the probability of such a change by chance is less than this.
_CHANCE = 1e-4
#: A relative change of the radiometric gain that matters, and in units of its 1-sigma.
LEAST_GAIN = 0.03
_FAR = 4.0


@dataclass(frozen=True)
class Adjusted:
    """A known term before and after, by path relative to it."""

    effect: str
    before: Mapping[str, float]
    after: Mapping[str, float]


def adjusted_terms(camera: Camera, fitted: Fit) -> list[Adjusted]:
    """Return the terms of a camera file whose parameters differ in a fit, significantly and in
    millimetres.
    """
    before, after = camera_numbers(camera), camera_numbers(fitted.camera)
    names = list(fitted.parameters)
    result = []
    for name in camera.effects:
        if camera.effects[name].estimated != "joint":
            continue
        prefix = f"effects.{name}."
        index = [i for i, path in enumerate(names) if path.startswith(prefix) and path in before]
        if not index:
            continue
        change = np.array([after[names[i]] - before[names[i]] for i in index])
        square = _in_sigmas(change, fitted.covariance[np.ix_(index, index)])
        if square < chdtri(len(index), _CHANCE) or _moved(camera, fitted, name) < LEAST_SIZE:
            continue
        result.append(
            Adjusted(
                name,
                {names[i].removeprefix(prefix): before[names[i]] for i in index},
                {names[i].removeprefix(prefix): after[names[i]] for i in index},
            )
        )
    gain = fitted.parameters.get(GAIN)
    if gain is not None:
        ratio = gain / camera.radiometry.gain - 1
        # the error of the gain includes those of reflectivities and powers
        limit = max(LEAST_GAIN, _FAR * fitted.sigma[GAIN] / gain)
        if abs(ratio) > limit:
            result.append(Adjusted(Radiometry.section, {"gain": camera.radiometry.gain}, {"gain": gain}))
    return result


def _in_sigmas(change: Array, covariance: Array) -> float:
    """Return the square of a change (K,) in units of a covariance (Wald's statistic)."""
    scale = np.sqrt(np.diag(covariance))
    normal = change / scale
    correlation = covariance / scale[:, None] / scale[None, :] + 1e-9 * np.eye(len(change))
    return float(normal @ np.linalg.solve(correlation, normal))


def beyond_file(camera: Camera, fitted: Fit) -> bool:
    """Return whether known terms together differ significantly from their file, given fit and file errors.

    By Wald's test of all parameters that the file has, at the rate `ALARM_RATE`.
    """
    before, after = camera_numbers(camera), camera_numbers(fitted.camera)
    paths = list(fitted.parameters)
    own = [i for i, path in enumerate(paths) if path.startswith("effects.") and path in before]
    change = np.array([after[paths[i]] - before[paths[i]] for i in own])
    known = file_covariance(camera, fitted, own)
    square = _in_sigmas(change, fitted.covariance[np.ix_(own, own)] + known)
    return square > float(chdtri(len(own), ALARM_RATE))


def file_covariance(camera: Camera, fitted: Fit, own: Sequence[int]) -> Array:
    """Return the covariance (K, K) of the camera file's values of some parameters of a fit, by their numbers.

    It is the stated one where the file states one. Otherwise it is the covariance of plain least squares of
    a recording like this one, which ignores errors of poses and offsets of pixels: nothing better can be
    assumed of such a file, and if it counted as exact, errors of poses of another day would be called wrong
    parameters. It is in the units of the parameters: the sandwich of White (1980) with the stated errors in
    place of residuals.
    """
    equations, count = fitted.equations, len(fitted.equations.regressors)
    gram, nuisances = stacked(equations.folds, count)
    labels = [regressor.label for regressor in equations.regressors]
    others = [
        i for i, label in enumerate(labels[: len(fitted.parameters)]) if label.startswith(IMPERFECTIONS)
    ]
    sizes = [*priors_of([equations.regressors[i] for i in others]), *(size for _, size, _ in nuisances)]
    errors = gram[np.ix_([*others, *range(count, count + len(nuisances))], own)] * np.array(sizes)[:, None]
    offsets = fitted.pattern.ravel()
    offsets = offsets if equations.pixels.seen is None else offsets[equations.pixels.seen]
    of_pixels = np.sum([fold.pixel[:, own] for fold in equations.folds], axis=0)
    prior = np.diag(priors_of([equations.regressors[i] for i in own]) ** -2.0)
    normal = gram[np.ix_(own, own)] + prior
    scatter = (
        normal
        + errors.T @ errors
        + median_abs_deviation(offsets, scale="normal") ** 2 * of_pixels.T @ of_pixels
    )
    # columns differ by many orders of magnitude
    unit = np.sqrt(np.diag(normal))
    scaled = np.linalg.inv(normal / np.outer(unit, unit))
    result = np.asarray(scaled @ (scatter / np.outer(unit, unit)) @ scaled / np.outer(unit, unit))
    if camera.covariance is None:
        return result
    paths = list(fitted.parameters)
    stated = {path: i for i, path in enumerate(camera.covariance.parameters)}
    mine = [k for k, i in enumerate(own) if paths[i] in stated]
    result[mine, :] = result[:, mine] = 0.0
    places = [stated[paths[own[k]]] for k in mine]
    result[np.ix_(mine, mine)] = camera.covariance.matrix.values[np.ix_(places, places)]
    return result


def _moved(camera: Camera, fitted: Fit, name: str) -> float:
    """RMS [m] over pixels and stations of the change of one term, without each pixel's mean over stations."""
    return _varying(
        camera,
        fitted,
        lambda old, new: contribution(new, name, fitted.start) - contribution(old, name, fitted.start),
    )


def _varying(camera: Camera, fitted: Fit, change_of: Callable[[Prediction, Prediction], Array]) -> float:
    """RMS of a change over pixels and stations, without each pixel's mean over stations."""
    before = fitted.by_another(camera)
    shape = camera.shape
    total, square, count = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for old, new in zip(
        before.predictions(slopes=False), fitted.forward.predictions(slopes=False), strict=True
    ):
        change = np.broadcast_to(change_of(old, new), shape)
        used = new.used & old.used & np.isfinite(change)
        if not used.any():
            continue
        values = change[used]
        total[used] += values
        square[used] += values**2
        count[used] += 1
    known = count > 1
    if not known.any():
        return 0.0
    variance = square[known] / count[known] - (total[known] / count[known]) ** 2
    return float(np.sqrt(np.mean(np.maximum(variance, 0.0))))


def parameters_matter(camera: Camera, result: Result, adjusted: Sequence[Adjusted]) -> bool:
    """Return whether freeing the known terms that moved gains on held-out poses, conditional on the others.

    They must gain the entry threshold of an effect, and all terms together must differ significantly from
    their file.

    A wrong radiometric gain matters by itself: a power that is wrong in all poses is absorbed by the powers
    of the poses, so that no likelihood shows it.
    """
    if any(term.effect == Radiometry.section for term in adjusted):
        return True
    final = result.explorations[-1].fit
    if not adjusted or not beyond_file(camera, final):
        return False
    moved = {term.effect: camera.effects[term.effect] for term in adjusted}
    stated = replace(final.camera, effects={**final.camera.effects, **moved})
    others = tuple(
        name for name, effect in stated.effects.items() if effect.estimated == "joint" and name not in moved
    )
    frozen = replace(result.problem, effects=others, amplitude_error=final.forward.amplitude_model.tau)
    folds = folds_of(result.problem.dataset)
    step = explore(frozen, stated, [], folds, replicates=0, views=result.fit.forward.views, iterations=2)
    after, before = result.explorations[-1].scores, step.scores
    if not after.trained:
        return False
    gain = after.log_likelihood() - before.log_likelihood()
    threshold = result.explorations[0].threshold
    return gain > entry_gain(after.log_likelihoods(), before.log_likelihoods(), threshold)
