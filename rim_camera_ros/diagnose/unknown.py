"""Physics outside the vocabulary: the covariates on which it depends, and a table that models it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added
from rim_camera_ros.diagnose.smooth import values_of
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.covariates import SCALAR
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.select.exploration import Exploration

Array = NDArray[Any]

#: Features whose slopes per column, per row and per pixel are scored.
_FEATURES = ("amplitude", "distance", "ambient_temperature", "time")
_GROUPS = ("column", "row", "pixel")


@dataclass(frozen=True)
class FineStructure:
    """Slopes on a feature that differ from column to column, row to row or pixel to pixel.

    ``gain`` in nats on held-out poses; ``slopes`` (groups,) in m per standard deviation of the feature, whose
    transformed ``centre`` and ``spread`` make it dimensionless.
    """

    group: str
    feature: str
    gain: float
    slopes: Array
    centre: float
    spread: float

    @property
    def covariates(self) -> tuple[str, ...]:
        """Names of the covariates in the report."""
        return ("row", "column", self.feature) if self.group == "pixel" else (self.group, self.feature)


def _transformed(name: str, value: Array) -> Array:
    return np.log(np.maximum(value, 1.0)) if name == "amplitude" else value


def fine_structures(fitted: Fit, folds: Mapping[tuple[int, int], int]) -> list[FineStructure]:
    """Score slopes per column, row and pixel on every feature, best first.

    Smooth terms cannot describe changes from one column to the next. Each group's slope is shrunk by the
    variance of the slopes and scored by the poses to which it was not fitted. Slopes are those of the
    residuals after the fit, with the feature's mean over each pixel removed, as the fixed pattern absorbs it.
    """
    height, width = fitted.camera.shape
    index = np.arange(height * width)
    groups = {"column": index % width, "row": index // width, "pixel": index}
    sizes = {"column": width, "row": height, "pixel": height * width}
    count = max(folds.values()) + 1
    scale = _scales(fitted)
    means = {name: np.zeros((2, height * width)) for name in scale}
    for prediction in fitted.forward.predictions(slopes=False):
        pixels = np.flatnonzero(prediction.used.ravel())
        weight = 1.0 / prediction.sigma.ravel()[pixels] ** 2
        for name, (centre, spread) in scale.items():
            x = _feature(name, prediction, pixels, centre, spread)
            means[name][0, pixels] += weight * x
            means[name][1, pixels] += weight
    sums = {(g, name): np.zeros((count, 2, sizes[g])) for g in _GROUPS for name in scale}
    for prediction in fitted.forward.predictions():
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        pixels = np.flatnonzero(prediction.used.ravel())
        if not pixels.size:
            continue
        weight = 1.0 / prediction.sigma.ravel()[pixels] ** 2
        residual = rest.ravel()[pixels]
        fold = folds[(prediction.station.recording, prediction.station.pose)]
        for name, (centre, spread) in scale.items():
            total, norm = means[name][:, pixels]
            x = _feature(name, prediction, pixels, centre, spread) - total / np.maximum(norm, 1e-300)
            for g in _GROUPS:
                own = groups[g][pixels]
                target = sums[(g, name)][fold]
                target[0] += np.bincount(own, weight * x * residual, sizes[g])
                target[1] += np.bincount(own, weight * x * x, sizes[g])
    result = []
    for (g, name), parts in sums.items():
        gain, slopes = _held_out(parts)
        result.append(FineStructure(g, name, gain, slopes, *scale[name]))
    return sorted(result, key=lambda fine_structure: -fine_structure.gain)


def _scales(fitted: Fit) -> dict[str, tuple[float, float]]:
    samples: dict[str, list[Array]] = {name: [] for name in _FEATURES}
    missing = set()
    for prediction in fitted.forward.predictions(slopes=False):
        pixels = np.flatnonzero(prediction.used.ravel())[::37]
        for name in _FEATURES:
            value = values_of(name, prediction)
            if value is None:
                missing.add(name)
            elif name in SCALAR:
                samples[name].append(np.full(1, float(value)))
            else:
                samples[name].append(_transformed(name, np.asarray(value).ravel()[pixels]))
    result = {}
    for name, parts in samples.items():
        if name in missing or not parts:
            continue
        values = np.concatenate(parts)
        if values.size and np.std(values) > 1e-9:
            result[name] = (float(np.mean(values)), float(np.std(values)))
    return result


def _feature(name: str, prediction: Any, pixels: Array, centre: float, spread: float) -> Array:
    value = values_of(name, prediction)
    assert value is not None
    if np.ndim(value) == 0:
        return np.full(len(pixels), (float(value) - centre) / spread)
    return (_transformed(name, np.asarray(value).ravel()[pixels]) - centre) / spread


def _held_out(parts: Array) -> tuple[float, Array]:
    """Return the gain [nats] of held-out folds by shrunk slopes, and the slopes by all data."""

    def slopes(right: Array, square: Array) -> Array:
        known = square > 0
        if known.sum() < 4:
            return np.zeros_like(right)
        raw = right[known] / square[known]
        variance = max(float(np.average(raw**2 - 1 / square[known], weights=square[known])), 0.0)
        if variance == 0.0:
            return np.zeros_like(right)
        return np.where(known, right / np.where(known, square + 1 / variance, 1.0), 0.0)

    total = parts.sum(axis=0)
    gain = 0.0
    for own in parts:
        train = total - own
        b = slopes(train[0], train[1])
        gain += float(np.sum(b * own[0] - 0.5 * b**2 * own[1]))
    return gain, slopes(total[0], total[1])


def fine_image(structure: FineStructure, one: Any) -> Array:
    """Return the change of a station's distances (H, W) [m] by a structure."""
    shape = one.used.shape
    pixels = np.arange(one.used.size)
    feature = np.clip(_feature(structure.feature, one, pixels, structure.centre, structure.spread), -3, 3)
    index = {"column": pixels % shape[1], "row": pixels // shape[1], "pixel": pixels}[structure.group]
    return np.asarray((structure.slopes[index] * feature).reshape(shape))


def fine_table(structure: FineStructure) -> CovariateTable | None:
    """Return the structure as a table over its two covariates; None for slopes per pixel."""
    if structure.group == "pixel":
        return None
    low, high = structure.centre - 2.5 * structure.spread, structure.centre + 2.5 * structure.spread
    feature = np.linspace(low, high, 9)
    knots = np.exp(feature) if structure.feature == "amplitude" else feature
    values = structure.slopes[:, None] * ((feature - structure.centre) / structure.spread)[None, :]
    return CovariateTable(
        covariates=(structure.group, structure.feature),
        knots=(tuple(float(i) for i in range(len(structure.slopes))), tuple(knots.tolist())),
        values=NestedList(values),
    )


def smooth_pairs(step: Exploration, most: int = 5) -> list[tuple[str, str]]:
    """Return the pairs of covariates to score: those of the best smooth terms of one covariate."""
    singles = [
        (float(step.gains[k]), step.candidates[k].variant)
        for k in range(step.named, len(step.candidates))
        if "," not in step.candidates[k].variant
    ]
    names = [name for _, name in sorted(singles, reverse=True)[:most]]
    best = names[:1]
    pairs = [(a, b) for a in best for b in names if a != b]
    pairs += [(a, b) for a in best for b in ("row", "column") if b not in names]
    return pairs


def with_table(camera: Camera, table: CovariateTable) -> Camera:
    """Return the camera with a table over covariates; a table that it already has is kept instead."""
    return camera if table.name in camera.effects else added(camera, table)
