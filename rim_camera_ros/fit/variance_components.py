"""Sizes of random effects that the recordings tell: of offsets of pixels, weights of poses, shared errors.

An offset per pixel that may be anything takes all that a pixel tells which one pose sees: what a small board,
held here and there, shows within a pose is lost then, and only differences between poses are left, with
their errors. The size of the offsets that makes the recordings most likely (restricted maximum likelihood)
keeps both apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.fit.correlated_errors import CORRELATED, correlated_error_of
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.normal_equations import Reduced, reduce_folds, reduce_further
from rim_camera_ros.fit.pixel_elimination import PATTERN_PRIOR, without_pixels
from rim_camera_ros.fit.pose_errors import LEAST_POSES, WIDER
from rim_camera_ros.fit.problem import Fit, Problem, freed
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.solver import fit

Array = NDArray[Any]

#: Values per pixel below which the pattern's size is asked for, and the size with which that begins [m]: from
#: a large one nothing else would be seen to be wrong.
FEW_LOOKS = 5.0
FIRST_SIZE = 0.001
#: Sizes that are tried, 1-sigma of a pixel's offset [m].
SIZES = (0.0003, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.06, PATTERN_PRIOR)


def first_pattern_prior(masks: Sequence[tuple[Array, Array]]) -> float:
    """Return the 1-sigma of pixels' offsets [m] to begin with, by the pixels of each station, (H, W) each.

    `PATTERN_PRIOR`, as good as unknown, where every pixel has enough looks to tell its own.
    """
    count = np.sum([used for used, _ in masks], axis=0)
    looks = float(count[count > 0].mean()) if count.any() else FEW_LOOKS
    return FIRST_SIZE if looks < FEW_LOOKS else PATTERN_PRIOR


def offsets_evidence(fitted: Fit, size: float) -> float:
    """Return the log likelihood of a fit's data for offsets of pixels of a ``size`` [m, 1 sigma].

    Up to a constant; parameters, errors of poses and the offsets themselves are integrated out.
    """
    pixels = replace(fitted.equations.pixels, offset=size)
    return _log_evidence(
        fitted, reduce_folds(fitted.equations.folds, priors_of(fitted.equations.regressors), pixels)
    )


def correlated_evidences(fitted: Fit, sizes: Sequence[float]) -> list[float]:
    """Return the log likelihood of a fit's data for correlated errors of each of ``sizes`` [m, 1 sigma].

    As `offsets_evidence`. The fit has such errors of some size; pixels are eliminated once for all of them.
    """
    folds, priors = fitted.equations.folds, priors_of(fitted.equations.regressors)
    sums = without_pixels(folds, len(priors), fitted.equations.pixels)
    factors = [size / fitted.forward.correlated_error for size in sizes]
    scaled = ([_scaled(fold, factor) for fold in folds] for factor in factors)
    return [_log_evidence(fitted, reduce_further(own, priors, sums)) for own in scaled]


def _log_evidence(fitted: Fit, reduced: Reduced) -> float:
    count = len(fitted.parameters)
    matrix = reduced.gram[:count, :count] + np.diag(fitted.priors**-2)
    factor = linalg.cholesky(matrix, lower=True)
    solved = linalg.solve_triangular(factor, reduced.right[:count], lower=True)
    rest = float(reduced.square) - float(solved @ solved)
    return -0.5 * rest - reduced.log_norm - float(np.sum(np.log(np.diag(factor))))


def _scaled(fold: Fold, factor: float) -> Fold:
    """Return the sums of a fold with correlated errors that are larger by a factor."""
    return replace(
        fold,
        nuisances=[
            (name, factor * prior if name.split(".", 2)[-1].startswith(CORRELATED) else prior, at)
            for name, prior, at in fold.nuisances
        ],
    )


def likely_pattern_prior(fitted: Fit) -> float:
    """Return the likeliest 1-sigma of pixels' offsets [m] of `SIZES`."""
    return max(SIZES, key=lambda size: offsets_evidence(fitted, size))


def pattern_prior_note(size: float) -> str:
    """Return in words how large the offsets of pixels are taken to be."""
    return (
        f"pixels are seen by few poses each: their offsets are taken to be {size * 1e3:.1f} mm (1 sigma), "
        "which makes the recordings most likely, lest they take what poses tell of the other effects"
    )


Key = tuple[int, int]

#: Chi-square per patch of a pose beyond which, in ratio to the median of all, poses are uneven; poses that it
#: takes to say so, patches of a pose to be judged, their size [px], the most sigma that a residual counts.
UNEVEN = 4.0
LEAST_PATCHES = 4
PATCH = 4
WILD = 30.0
#: Factor on a pose's variance, at most: its errors must still be found, or its residuals are no residuals.
MOST = 100.0
#: Ratio of factors between two fits below which they have settled, and the most rounds that it may take.
_SETTLED = 1.25
_ROUNDS = 8
_NAMED = 5


def pose_chi_squares(fitted: Fit, *, patch: int = PATCH) -> dict[Key, float]:
    """Return chi-square per patch of each pose, by recording and placement.

    A patch is a cell of ``patch`` by ``patch`` pixels of one surface and one reflectivity; its chi-square is
    that of the mean of its residuals after pattern and errors of poses: 1 where they are independent.
    Residuals count no more than `WILD` sigma. Poses of few patches are not among them.
    """
    totals: dict[Key, list[Array]] = {}
    for prediction in fitted.forward.predictions():
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        used = prediction.used
        z = np.clip(rest[used] / prediction.sigma[used], -WILD, WILD)
        geometry = prediction.view.geometry
        rows, columns = np.nonzero(used)
        kinds = np.stack(
            [rows // patch, columns // patch, geometry.surface[used], geometry.reflectivity[used]]
        )
        _, number = np.unique(kinds, axis=1, return_inverse=True)
        number = np.ravel(number)
        precise = 1.0 / prediction.sigma[used]
        total = np.bincount(number, precise * z)
        key = (prediction.station.recording, prediction.station.placed)
        totals.setdefault(key, []).append(total**2 / np.bincount(number, precise**2))
    joined = {key: np.concatenate(parts) for key, parts in totals.items()}
    return {key: float(parts.mean()) for key, parts in joined.items() if len(parts) >= LEAST_PATCHES}


def likely_correlated_error(problem: Problem, fitted: Fit) -> float | None:
    """Return the likeliest 1-sigma of what distances err by smoothly in each pose [m]; None: there is none.

    It is looked for where means of neighbours err `WIDER` times as much as independent pixels would, and
    their variance is `WIDER` times that of pixels which scatter as these do: no neighbour shares mere noise,
    however much more there is of it than the file states.
    """
    patches = pose_chi_squares(fitted)
    if len(patches) < LEAST_POSES:
        return None
    level = _level(patches)
    if level < WIDER**2 or level < WIDER * _level(pose_chi_squares(fitted, patch=1)):
        return None
    free = replace(freed(problem, fitted), correlated_error=FIRST_SIZE)
    again = fit(free, fitted.camera, iterations=0, warm=fitted)
    sizes = SIZES[:-1]
    best = int(np.argmax(correlated_evidences(again, sizes)))
    return sizes[best] if best else None  # the smallest of all is none


def correlated_error_rms(fitted: Fit) -> float:
    """Return by how much poses of a fit err smoothly [m, RMS], beside what may be an error of the poses."""
    squares = [
        correlated_error_of(prediction, fitted.nuisances)[prediction.used] ** 2
        for prediction in fitted.forward.predictions(slopes=False)
    ]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def correlated_error_note(fitted: Fit) -> str:
    """Return in words by how much poses of a fit err smoothly."""
    found = correlated_error_rms(fitted)
    return (
        f"distances of every pose err smoothly over the image, by {found * 1e3:.1f} mm (RMS) beside tilts "
        "and all that is fitted, by light or shapes that the scene file does not describe: neighbours share "
        "it, and count for less than independent pixels would"
    )


def pose_variance_factors(problem: Problem, fitted: Fit) -> dict[Key, float] | None:
    """Return the factors on the variances of poses with which they agree with the fit; None: poses are even.

    Where they have correlated errors, so that they agree with the noise. Factors change the fit and it them,
    so that it takes some rounds.
    """
    found = pose_chi_squares(fitted)
    if len(found) < LEAST_POSES:
        return None
    # beside waves of each pose, what all disagree with are shorter ones, which no effect is
    absolute = problem.correlated_error > 0
    if max(found.values()) < UNEVEN * _level(found) and not (absolute and _level(found) >= WIDER**2):
        return None
    free = freed(problem, fitted)
    factors: dict[Key, float] = {}
    for _ in range(_ROUNDS):
        before = factors
        whole = {key: chi * before.get(key, 1.0) for key, chi in found.items()}
        level = 1.0 if absolute else _level(whole)
        factors = {key: float(np.clip(chi / level, 1.0, MOST)) for key, chi in whole.items()}
        ratios = [factor / before.get(key, 1.0) for key, factor in factors.items()]
        if max(max(ratios), 1.0 / min(ratios)) < _SETTLED:
            break
        again = fit(replace(free, variance_factors=factors), fitted.camera, iterations=2, warm=fitted)
        found = pose_chi_squares(again)
    return factors


def _level(found: Mapping[Key, float]) -> float:
    """Return the chi-square of the median pose, at least 1: what all disagree with is no pose's fault."""
    return max(1.0, float(np.median(list(found.values()))))


def pose_variance_note(factors: Mapping[Key, float]) -> str:
    """Return in words which poses weigh less, the worst by name."""
    worst = sorted(factors, key=lambda key: -factors[key])[:_NAMED]
    parts = [f"pose {pose} ({factors[recording, pose]:.0f} times)" for recording, pose in worst]
    if min(factors.values()) > 1.0:
        median = np.median(list(factors.values()))
        return (
            f"distances of all poses weigh less, by {median:.1f} times their variance (median), most of all "
            f"those of {', '.join(parts)}: neighbours share more than what is smooth over the image"
        )
    return (
        "poses weigh less whose distances agree less with the model than those of the median pose, by their "
        f"variance: {', '.join(parts)}; the scene file does not describe all light, or these poses are wrong"
    )
