"""The table over covariates as regressors: hat functions between knots of one or two covariates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.candidate import Block, Column, Regressor
from rim_camera_ros.effects.covariates import COVARIATES, covariate
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.parameters import NestedList

Array = NDArray[Any]

#: Knots of one covariate, or of each of two.
KNOTS = (12, 6)
#: Values per knot that a fit needs, and 1-sigma of a value's prior [m].
LEAST_VALUES = 200
PRIOR = 0.05
#: Begin of the labels of its values; their place in C order follows.
LABEL = f"effects.{CovariateTable.name}.values."
#: Covariates over which knots have constant ratios.
_BY_RATIO = frozenset({"amplitude", "row_amplitude", "column_amplitude"})
_SAMPLES = 2000


def empirical_covariates(word: str) -> tuple[str, ...]:
    """Return the covariates of a word ``TABLE:NAME`` or ``TABLE:NAME:NAME``; amplitude where it has none.

    Raises `InputError` for an unknown covariate.
    """
    names = tuple(name for name in word.split(":")[1:] if name) or ("amplitude",)
    for name in names:
        if name not in COVARIATES:
            remedy = nearest_name(name, COVARIATES)
            raise InputError(
                f"unknown covariate '{name}' of {CovariateTable.name}", place="--effects", remedy=remedy
            )
    if len(names) > 2:
        raise InputError(
            f"{CovariateTable.name} takes one or two covariates, '{word}' names {len(names)}",
            place="--effects",
            remedy=f"choose two: {':'.join([CovariateTable.name, *names[:2]])}",
        )
    return names


def empirical_start(forward: Forward, names: tuple[str, ...]) -> CovariateTable:
    """Return the effect at zero, with knots where the recordings have values.

    Knots lie between the 0.5 and 99.5 % quantiles, evenly or, for amplitudes, at constant ratios. A knot with
    few values below it is skipped. Raises `InputError` where a covariate is not recorded or does not vary.
    """
    parts: list[list[Array]] = [[] for _ in names]
    for prediction in forward.predictions(slopes=False):
        values = _values(names, prediction)
        if values is None:
            raise InputError(
                f"the recordings state no {' or '.join(names)}",
                place="--effects",
                remedy=f"choose another covariate of {CovariateTable.name}",
            )
        pixels = np.flatnonzero(prediction.used.ravel())
        pixels = pixels[:: max(1, pixels.size // _SAMPLES)]
        for part, value in zip(parts, values, strict=True):
            part.append(value.ravel()[pixels])
    samples = [np.concatenate(part) for part in parts]
    knots = tuple(_knots(name, x, KNOTS[len(names) - 1]) for name, x in zip(names, samples, strict=True))
    return CovariateTable(names, knots, NestedList(np.zeros([len(knot) for knot in knots])))


def _knots(name: str, values: Array, count: int) -> tuple[float, ...]:
    low, high = np.quantile(values, [0.005, 0.995])
    if not high > low:
        raise InputError(
            f"{name} does not vary in these recordings", place="--effects", remedy="choose another covariate"
        )
    if name in _BY_RATIO and low > 0:
        edges = np.geomspace(low, high, count)
    else:
        edges = np.linspace(low, high, count)
    kept = [float(edges[0])]
    for lower, upper in pairwise(edges):
        if np.sum((values >= kept[-1]) & (values < upper)) >= min(LEAST_VALUES, values.size / (3 * count)):
            kept.append(float(upper))
        elif upper == edges[-1] and lower != kept[-1]:
            kept[-1] = float(upper)
    if len(kept) < 2:
        kept = [float(low), float(high)]
    return tuple(float(f"{knot:.6g}") for knot in kept)


def empirical_block(effect: CovariateTable) -> Block:
    """Return the regressors of the values at the knots, labelled by `LABEL` and their number in C order."""
    count = int(np.prod([len(knot) for knot in effect.knots]))
    regressors = tuple(Regressor(f"{LABEL}{i}", effect.name, PRIOR) for i in range(count))

    def columns(prediction: Prediction) -> list[Column]:
        values = _values(effect.covariates, prediction)
        shape = prediction.distance.shape
        if values is None:
            return [(np.zeros(shape), None)] * count
        hats = [_hats(np.asarray(knot), x) for knot, x in zip(effect.knots, values, strict=True)]
        if len(hats) == 1:
            return [(hat, None) for hat in hats[0]]
        return [(a * b, None) for a in hats[0] for b in hats[1]]

    return Block(regressors, columns)


def with_empirical_changes(camera: Camera, changes: Mapping[str, float]) -> Camera:
    """Return the camera with changes [m] of the values of its table by label; other labels are ignored."""
    own = {
        int(path.removeprefix(LABEL)): change for path, change in changes.items() if path.startswith(LABEL)
    }
    effect = effect_of(camera, CovariateTable)
    if not own or effect is None:
        return camera
    flat = effect.values.values.ravel().copy()
    flat[list(own)] += list(own.values())
    moved = replace(effect, values=NestedList(flat.reshape(effect.values.values.shape)))
    return added(camera, moved)


def _values(names: Iterable[str], prediction: Prediction) -> list[Array] | None:
    found = []
    for name in names:
        value = covariate(name, prediction.delivered.distance, prediction.amplitude, prediction.context)
        if value is None:
            return None
        found.append(np.broadcast_to(np.asarray(value, float), prediction.distance.shape))
    return found


def _hats(knots: Array, x: Array) -> list[Array]:
    """Return the hat functions of linear interpolation between knots, held constant outside."""
    held = np.clip(np.nan_to_num(x, nan=float(knots[0])), knots[0], knots[-1])
    identity = np.eye(len(knots))
    return [np.interp(held, knots, identity[k]) for k in range(len(knots))]
