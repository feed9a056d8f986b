"""Smooth functions of covariates: candidates for unknown physics, and tables that model it.

A smooth term is a table over covariates with unknown values at its knots, so that its fitted coefficients are
the values of the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.candidate import TERM_SIZE, Block, Candidate, Coefficients, Regressor
from rim_camera_ros.effects.covariates import SCALAR, covariate
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.parameters import NestedList

Array = NDArray[Any]

#: Owner of smooth terms among the candidates.
UNKNOWN = "unknown"
#: Covariates of smooth terms; saturation and edge belong to named effects or to masked pixels.
SMOOTH = (
    "distance",
    "amplitude",
    "row",
    "column",
    "incidence",
    "time",
    "temperature",
    "ambient_temperature",
    "integration_time",
    "row_amplitude",
    "column_amplitude",
    "contrast",
    "height",
)
#: Covariates that are the same in every frame: the fixed pattern absorbs functions of them alone.
STATIC = frozenset({"row", "column"})
_KNOTS_ALONE = 8
_KNOTS_TIME = 12
_KNOTS_PAIR = 5


@dataclass(frozen=True)
class Axis:
    """A covariate with its knots, at quantiles of the pixels that are fitted."""

    name: str
    knots: tuple[float, ...]


def values_of(name: str, prediction: Prediction) -> Array | float | None:
    """Return a covariate of a station: (H, W), a scalar, or None where it is not known."""
    amplitude = np.where(prediction.view.geometry.hit, prediction.amplitude, 0.0)
    return covariate(name, prediction.delivered.distance, amplitude, prediction.context)


def axes_of(forward: Forward, names: Sequence[str] = SMOOTH, *, seed: int = 0) -> dict[str, Array]:
    """Return a sample of the values of each covariate that varies, sorted."""
    rng = np.random.default_rng([seed, 5])
    samples: dict[str, list[Array]] = {name: [] for name in names}
    missing: set[str] = set()
    for prediction in forward.predictions(slopes=False):
        pixels = np.flatnonzero(prediction.used.ravel())
        if not pixels.size:
            continue
        chosen = rng.choice(pixels, min(300, pixels.size), replace=False)
        for name in names:
            value = values_of(name, prediction)
            if value is None:
                missing.add(name)
            elif np.ndim(value) == 0:
                samples[name].append(np.full(1 if name in SCALAR else len(chosen), float(value)))
            else:
                samples[name].append(np.asarray(value).ravel()[chosen])
    result = {}
    for name, parts in samples.items():
        if name in missing or not parts:
            continue
        values = np.sort(np.concatenate(parts))
        values = values[np.isfinite(values)]
        if values.size and np.ptp(values) > 1e-9 * max(abs(values[0]), abs(values[-1]), 1e-30):
            result[name] = values
    return result


def knots_at(values: Array, count: int) -> tuple[float, ...]:
    """Return increasing knots at quantiles of sorted values, the ends at 0.5 and 99.5 %."""
    different = np.unique(values)
    if len(different) <= count:
        return tuple(float(v) for v in different)
    knots = np.quantile(values, np.linspace(0.005, 0.995, count))
    # equal knots at least a hundredth of the range apart
    least = 0.01 * (knots[-1] - knots[0])
    kept = [knots[0]]
    for knot in knots[1:]:
        if knot - kept[-1] > least:
            kept.append(knot)
    return tuple(float(v) for v in kept)


def smooth_candidate(axes: Sequence[Axis]) -> Candidate:
    """Return a smooth term of one or two covariates; its regressors are the values at the knots."""
    names = tuple(axis.name for axis in axes)
    label = ",".join(names)
    shape = tuple(len(axis.knots) for axis in axes)
    regressors = tuple(
        Regressor(f"smooth.{label}.{'.'.join(map(str, index))}", UNKNOWN, 0.5 * TERM_SIZE)
        for index in np.ndindex(*shape)
    )

    def columns(prediction: Prediction) -> list[tuple[Array, Array | None]]:
        image = prediction.distance.shape
        weights: list[Array] = []
        for axis in axes:
            value = values_of(axis.name, prediction)
            if value is None:
                return [(np.zeros(image), None)] * len(regressors)
            weights.append(hats(np.asarray(value, float), np.array(axis.knots)))
        if len(weights) == 1:
            return [(np.broadcast_to(w, image), None) for w in weights[0]]
        return [
            (np.broadcast_to(a, image) * np.broadcast_to(b, image), None)
            for a in weights[0]
            for b in weights[1]
        ]

    def build(camera: Camera, values: Coefficients) -> Camera:
        table = np.array([values[regressor.label] for regressor in regressors]).reshape(shape)
        # a constant belongs to the fixed pattern
        table = table - table.mean()
        return added(
            camera,
            CovariateTable(
                covariates=names, knots=tuple(axis.knots for axis in axes), values=NestedList(table)
            ),
        )

    return Candidate(UNKNOWN, label, Block(regressors, columns), build)


def hats(value: Array, knots: Array) -> Array:
    """Return the hat functions (K, ...) of multilinear interpolation, constant outside."""
    inside = np.clip(np.nan_to_num(value, nan=knots[0]), knots[0], knots[-1])
    if len(knots) == 1:
        return np.ones((1, *inside.shape))
    lower = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    share = (inside - knots[lower]) / np.diff(knots)[lower]
    result = np.zeros((len(knots), *inside.shape))
    flat = result.reshape(len(knots), -1)
    number = np.arange(inside.size)
    flat[lower.ravel(), number] = 1.0 - share.ravel()
    flat[lower.ravel() + 1, number] += share.ravel()
    return result


def single_terms(samples: dict[str, Array]) -> list[Candidate]:
    """Return the smooth terms of one covariate each."""
    return [
        smooth_candidate([Axis(name, knots_at(values, _KNOTS_TIME if name == "time" else _KNOTS_ALONE))])
        for name, values in samples.items()
        if name not in STATIC
    ]


def gradient_terms(samples: dict[str, Array]) -> list[Candidate]:
    """Return bilinear terms of a covariate that is the same in a whole frame and the row or column.

    A gradient over the array that changes from pose to pose looks like tilts of the poses: only a term that
    is fitted jointly with these shows that they follow temperature, time or setting.
    """
    return [
        smooth_candidate([Axis(name, knots_at(samples[name], 2)) for name in (scalar, place)])
        for scalar in samples
        if scalar in SCALAR
        for place in sorted(STATIC & samples.keys())
    ]


def pair_terms(samples: dict[str, Array], pairs: Sequence[tuple[str, str]]) -> list[Candidate]:
    """Return the smooth terms of pairs of covariates."""
    return [
        smooth_candidate([Axis(name, knots_at(samples[name], _KNOTS_PAIR)) for name in pair])
        for pair in pairs
        if not set(pair) <= STATIC
    ]
