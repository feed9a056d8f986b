"""Variance components from the recordings: offsets of pixels, weights of poses, errors that neighbours share.

A free offset per pixel absorbs all information of a pixel that only one pose sees. With a small board, held
here and there, the information within poses would be lost, and only differences between poses would remain,
with the poses' errors. The size of the offsets that makes the recordings most likely (restricted maximum
likelihood) separates the two.
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

#: Values per pixel below which the pattern's size is estimated, and the size with which the estimate begins
#: [m]: a large one would hide every other error.
FEW_LOOKS = 5.0
FIRST_SIZE = 0.001
#: Sizes that are tried, 1-sigma of a pixel's offset [m].
SIZES = (0.0003, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.06, PATTERN_PRIOR)


def first_pattern_prior(masks: Sequence[tuple[Array, Array]]) -> float:
    """Return the 1-sigma of pixels' offsets [m] to begin with, by the pixels of each station, (H, W) each.

    It is `PATTERN_PRIOR`, as good as free, where pixels have enough values to determine their offsets.
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

    As `offsets_evidence`. The fit must have such errors, of any size; pixels are eliminated once for all
    sizes.
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
        "which makes the recordings most likely; free offsets would absorb the information on other effects"
    )


Key = tuple[int, int]

#: Ratio of a pose's chi-square per patch to the median of all poses beyond which poses are uneven; least
#: number of patches in a pose, their size [px], and the sigmas at which residuals are clipped.
UNEVEN = 4.0
LEAST_PATCHES = 4
PATCH = 4
WILD = 30.0
#: Greatest factor on a pose's variance: its errors must still be estimated from its residuals.
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
    """Return the likeliest 1-sigma [m] of smooth errors of the distances of each pose; None: there are none.

    It is estimated where means of neighbours have errors `WIDER` times as large as those of independent
    pixels, and a variance `WIDER` times as large as the scatter of single pixels gives: noise is not shared
    by neighbours, however much it exceeds that of the file.
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
    return sizes[best] if best else None  # the smallest size counts as none


def correlated_error_rms(fitted: Fit) -> float:
    """Return the RMS [m] of the smooth errors of a fit's poses, apart from possible errors of the poses."""
    squares = [
        correlated_error_of(prediction, fitted.nuisances)[prediction.used] ** 2
        for prediction in fitted.forward.predictions(slopes=False)
    ]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def correlated_error_note(fitted: Fit) -> str:
    """Return in words how large the smooth errors of a fit's poses are."""
    found = correlated_error_rms(fitted)
    return (
        f"distances of every pose err smoothly over the image, by {found * 1e3:.1f} mm (RMS) apart from "
        "tilts and all that is fitted, by light or shapes that the scene file does not describe: neighbours "
        "share these errors, and count for less than independent pixels would"
    )


def pose_variance_factors(problem: Problem, fitted: Fit) -> dict[Key, float] | None:
    """Return factors on the variances of poses that make them agree with the median pose; None: not needed.

    With correlated errors, factors by which they agree with the noise. It takes some rounds, as factors
    change the fit and the fit changes them.
    """
    found = pose_chi_squares(fitted)
    if len(found) < LEAST_POSES:
        return None
    # given the waves of each pose, all poses can disagree only by shorter waves, which are no effect
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
    """Return the chi-square of the median pose, 1 at least: a misfit of all poses is no error of one pose."""
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
