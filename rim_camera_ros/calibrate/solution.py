"""A finished adjustment and its results: cameras of folds, shrunk pattern, stated covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rim_camera_ros.camera import Camera, Covariance
from rim_camera_ros.camera_file import added, camera_numbers, with_numbers
from rim_camera_ros.effects import PixelMap
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.light_curves import of_light
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.covariate_table import with_empirical_changes
from rim_camera_ros.fit.design import GAIN, is_linear, pattern_field
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.select.evidence import Scores

Array = NDArray[Any]
Key = tuple[int, int]

#: Ratio of posterior to prior sigma above which the data do not determine a parameter.
BARELY_NARROWED = 0.9
#: Correlations above this are reported.
HIGH_CORRELATION = 0.9
#: Width [px] over which the smooth part of the fixed pattern is averaged.
_SMOOTH = 3.0
#: Weight, as a share of that of an area that was seen, at which the mean about a pixel is shrunk half-way to
#: that of all pixels, and its slope half-way to 0. At the rim of the area seen that reduces a slope by 5 %;
#: six pixels beyond it by two thirds, where it would be an extrapolation of the noise at the rim.
_FEW = 1e-3
_FEW_OF_LINES = 0.01
#: Share of a change of parameters below which none of it is made.
_LEAST_SHARE = 1e-3


@dataclass
class Solution:
    """The fit, its scores (base: all that is fitted), the folds of poses, chi-square per value held out.

    ``factor`` is the variance factor a posteriori, at least 1. It scales the covariance, and ``widened`` that
    of each parameter by label (`sandwich_covariance.widening`). ``outliers`` is the number of distances
    beyond the robust limit among ``values``.
    """

    fit: Fit
    scores: Scores
    folds: Mapping[Key, int]
    start: Camera
    outliers: int = 0
    values: int = 0
    notes: list[str] = field(default_factory=list)
    widened: Mapping[str, float] = field(default_factory=dict)

    @property
    def labels(self) -> list[str]:
        """Dotted paths of all that is fitted."""
        return [self.scores.regressors[int(i)].label for i in self.scores.base]

    def held_out_chi_square(self) -> float | None:
        """Return chi-square per value of held-out poses by their predictive distribution; None: one fold."""
        if not self.scores.trained:
            return None
        total, rows = self.scores.chi_square(held_out=True)
        return total / max(rows, 1)

    @property
    def factor(self) -> float:
        """Variance factor a posteriori, at least 1."""
        total, rows = self.scores.chi_square()
        return max(1.0, (self.held_out_chi_square() or total / max(rows, 1)))

    def camera(self, leave_out: int | None = None) -> Camera:
        """Return the camera of all poses, or of all folds but one, with its fixed pattern shrunk.

        The camera of some folds is one Gauss-Newton step from that of all.
        """
        camera = self.fit.camera
        if leave_out is None:
            pattern = self.fit.pattern + pattern_field(self.fit.nuisances, camera.shape)
            return with_pattern(camera, pattern, self.pattern_variance())
        reduced = self.scores.trained[leave_out]
        values = self.scores.values(leave_out=leave_out)
        moved = moved_by(camera, values)
        everything = np.zeros(len(self.scores.regressors))
        for i in self.scores.base:
            everything[int(i)] = values[self.scores.regressors[int(i)].label]
        _, flat, _ = reduced.recover(everything)
        pattern = flat.reshape(camera.shape) if flat.size == self.fit.pattern.size else self.fit.pattern * 0.0
        pattern = pattern + pattern_field(values, camera.shape)
        return with_pattern(moved, pattern, self.pattern_variance(leave_out))

    def pattern_variance(self, leave_out: int | None = None) -> Array:
        """Return the variance of the pattern's estimate (H, W) in m^2 by the noise; infinite where unseen."""
        kept = [fold for i, fold in enumerate(self.fit.equations.folds) if i != leave_out]
        weight = self.fit.equations.pixels.everywhere(np.sum([fold.weight for fold in kept], axis=0))
        shape = self.fit.camera.shape
        if weight.size != shape[0] * shape[1]:
            return np.full(shape, np.inf)
        with np.errstate(divide="ignore"):
            return np.asarray(self.factor / weight.reshape(shape))

    def covariance(self) -> tuple[list[str], Array]:
        """Return the paths and the covariance of the parameters that the data determine."""
        scale = np.array([self._unit(label) for label in self.labels])
        matrix = self.scores.covariance(self.scores.base) * self.factor
        wider = scale * np.sqrt([self.widened.get(label, 1.0) for label in self.labels])
        narrowed = np.sqrt(np.diag(matrix)) < BARELY_NARROWED * self.scores.prior[self.scores.base] * np.sqrt(
            self.factor
        )
        matrix = matrix * wider[:, None] * wider[None, :]
        # reflectances of surfaces are no numbers of the camera file
        keep = np.flatnonzero(
            narrowed & [not of_light(label) and not is_linear(label) for label in self.labels]
        )
        return [self.labels[i] for i in keep], np.asarray(matrix[np.ix_(keep, keep)])

    def undetermined(self) -> list[str]:
        """Return the paths of fitted parameters that the data do not determine: they stay as in the file."""
        determined, _ = self.covariance()
        own = [label for label in self.labels if not of_light(label) and not is_linear(label)]
        return [label for label in own if label not in set(determined)]

    def _unit(self, label: str) -> float:
        return self.fit.camera.radiometry.gain if label == GAIN else 1.0


def moved_by(camera: Camera, changes: Mapping[str, float]) -> Camera:
    """Return the camera with its numbers changed by the values of regressors, kept within bounds.

    The change is halved until the camera is a valid one (for example with a falloff that leaves light in
    every corner). Errors of scene poses among the changes are ignored.
    """
    share = 1.0
    while True:
        try:
            return _moved_by(camera, {label: share * change for label, change in changes.items()})
        except (InputError, ValueError):
            share /= 2
            if share < _LEAST_SHARE:
                return camera


def _moved_by(camera: Camera, changes: Mapping[str, float]) -> Camera:
    numbers = camera_numbers(camera)
    limits = {
        f"effects.{name}.{path}": limit
        for name, effect in camera.effects.items()
        for path, limit in effect.bounds().items()
    }
    values: dict[str, float] = {}
    for label, change in changes.items():
        if label == GAIN:
            values[label] = numbers[label] * float(np.exp(change))
        elif label in numbers:
            low, high = limits.get(label, (-np.inf, np.inf))
            value = numbers[label] + change
            values[label] = float(np.clip(value, low + 1e-12 if low > 0 else low, high))
    if values:
        camera = with_numbers(camera, values)
    return with_empirical_changes(camera, changes)


def with_pattern(camera: Camera, pattern: Array, variance: Array) -> Camera:
    """Return the camera with a pattern (H, W) [m] added to its fixed pattern, shrunk by its variance [m^2].

    The pattern is split into a smooth part and the remainder of each pixel. The remainder is shrunk by its
    variance over pixels and the variance of its estimate (empirical Bayes). Pixels that were never seen get
    the smooth part of their neighbourhood.
    """
    seen = np.isfinite(variance)
    if not seen.any():
        return camera
    shrunk = shrink(pattern, variance)
    effect = effect_of(camera, PixelMap)
    before: Any = 0.0 if effect is None else effect.map.values
    values = np.asarray(before + shrunk, np.float32)
    name = "fixed_pattern.npy" if effect is None else effect.map.file
    return added(camera, PixelMap(ArrayFile(name, values)))


def shrink(pattern: Array, variance: Array) -> Array:
    """Return the best estimate (H, W) of a pattern known with a variance, see `with_pattern`."""
    seen = np.isfinite(variance)
    weight = np.where(seen, 1.0 / np.where(seen, np.maximum(variance, 1e-12), 1.0), 0.0)
    values = np.where(seen, pattern, 0.0)
    level = float(np.average(values[seen], weights=weight[seen]))
    smooth = _smooth_part(values, weight, level)
    rest = values - smooth
    spread = (1.4826 * float(np.median(np.abs(rest[seen])))) ** 2 - float(np.median(variance[seen]))
    spread = max(spread, 0.0)
    share = np.where(seen, spread / (spread + np.where(seen, variance, 1.0) + 1e-15), 0.0)
    return np.asarray(smooth + share * rest)


def _smooth_part(values: Array, weight: Array, level: float) -> Array:
    """Return the weighted mean (H, W) of values about each pixel, by a Gaussian of `_SMOOTH` pixels.

    A slope in both directions is fitted jointly with it (local linear regression; Fan 1992): otherwise, where
    pixels were seen on one side only, the mean would be that of another place. Far from any pixel that was
    seen it is the ``level``.
    """
    usual = float(np.median(weight[weight > 0]))
    few = _FEW * usual
    rows, columns = np.indices(values.shape) - np.array(values.shape).reshape(2, 1, 1) / 2

    def blurred(image: Array) -> Array:
        return np.asarray(gaussian_filter(image, _SMOOTH, mode="constant"))

    total = blurred(weight)
    safe = np.maximum(total, 1e-6 * few)
    mean, row, column = (blurred(weight * image) / safe for image in (values, rows, columns))

    def moment(a: Array, b: Array, of_a: Array, of_b: Array) -> Array:
        return np.asarray(total * (blurred(weight * a * b) / safe - of_a * of_b))

    # slopes that few pixels determine are shrunk to 0
    held = _FEW_OF_LINES * usual * _SMOOTH**2
    rr = np.maximum(moment(rows, rows, row, row), 0.0) + held
    cc = np.maximum(moment(columns, columns, column, column), 0.0) + held
    rc = moment(rows, columns, row, column)
    along_rows, along_columns = moment(rows, values, row, mean), moment(columns, values, column, mean)
    determinant = np.maximum(rr * cc - rc**2, 1e-12 * rr * cc)
    by_row = (cc * along_rows - rc * along_columns) / determinant
    by_column = (rr * along_columns - rc * along_rows) / determinant
    here = mean + by_row * (rows - row) + by_column * (columns - column)
    result: Array = (total * here + few * level) / (total + few)
    return result


def stated(camera: Camera, paths: list[str], matrix: Array) -> Camera:
    """Return the camera with a covariance; the one that its file states of other parameters is kept in it."""
    known = camera_numbers(camera)
    own = [i for i, path in enumerate(paths) if path in known]
    names = [paths[i] for i in own]
    block = matrix[np.ix_(own, own)]
    old = camera.covariance
    if old is not None:
        rest = [i for i, path in enumerate(old.parameters) if path not in set(names) and path in known]
        names = [*names, *(old.parameters[i] for i in rest)]
        whole = np.zeros((len(names), len(names)))
        whole[: len(own), : len(own)] = block
        whole[len(own) :, len(own) :] = old.matrix.values[np.ix_(rest, rest)]
        block = whole
    if not names:
        return replace(camera, covariance=None)
    return replace(camera, covariance=Covariance(tuple(names), ArrayFile("covariance.npy", block)))


def high_correlations(paths: list[str], matrix: Array) -> list[tuple[str, str, float]]:
    """Return pairs of parameters whose correlation exceeds `HIGH_CORRELATION`, the highest first."""
    sigma = np.sqrt(np.diag(matrix))
    correlation = matrix / np.where(sigma > 0, sigma, 1.0)[:, None] / np.where(sigma > 0, sigma, 1.0)[None, :]
    pairs = [
        (paths[i], paths[j], float(correlation[i, j]))
        for i, j in zip(*np.triu_indices(len(paths), 1), strict=True)
        if abs(correlation[i, j]) > HIGH_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def count_outliers(fitted: Fit, *, limit: float) -> tuple[int, int]:
    """Return how many distances lie beyond ``limit`` sigma after the fit, and how many were used."""
    beyond = total = 0
    for prediction in fitted.forward.predictions():
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        z = np.abs(rest[prediction.used]) / prediction.sigma[prediction.used]
        beyond += int((z > limit).sum())
        total += int(z.size)
    return beyond, total
