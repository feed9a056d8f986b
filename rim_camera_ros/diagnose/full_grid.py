"""A diagnosis of every k-th pixel, told in pixels of the whole sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.formula import closed_form, formula_curve
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.fit.decimation import full_camera, full_image, full_number

_ONE_OF = "of every {0} x {0} pixels one was looked at"
#: Points of a closed form that it is restated from.
_POINTS = 32


def on_full_grid(result: Diagnosis, camera: Camera, step: int) -> Diagnosis:
    """Restate a diagnosis of every ``step``-th pixel for the ``camera`` of all of them; in place.

    That of a coarser grid's coarser grid is restated twice.
    """
    before = _ONE_OF.format(result.step)
    small, full = result.camera, full_camera(result.camera, camera, step)
    result.missing = [restated(one, small, full, step) for one in result.missing]
    result.adjusted = [_adjusted(one, step) for one in result.adjusted]
    result.looked_at, result.camera = result.model, full
    result.where = replace(result.where, pixels=full_image(result.where.pixels, camera.shape, step))
    result.notes = [*(one for one in result.notes if one != before), _ONE_OF.format(result.step)]
    return result


def restated(one: Missing, small: Camera, full: Camera, step: int) -> Missing:
    """Return what the ``small`` camera of every ``step``-th pixel found in pixels of the ``full`` one."""
    prefix = _prefix(one.effect, small)
    low_and_high = {
        path: (full_number(prefix + path, low, step), full_number(prefix + path, high, step))
        for path, (low, high) in one.interval.items()
    }
    values = {path: full_number(prefix + path, value, step) for path, value in one.parameters.items()}
    sentence, formula = one.sentence, _formula(one, small, full)
    if one.effect in small.effects:
        sentence = sentence.replace(small.effects[one.effect].sentence(), full.effects[one.effect].sentence())
    if one.formula is not None and formula is not None:
        sentence = sentence.replace(one.formula, formula)
    return replace(one, parameters=values, interval=low_and_high, sentence=sentence, formula=formula)


def _formula(one: Missing, small: Camera, full: Camera) -> str | None:
    """Return a closed form restated for a covariate in pixels of the whole sensor, over its table's knots."""
    table, finer = (effect_of(camera, CovariateTable) for camera in (small, full))
    if one.formula is None or not isinstance(table, CovariateTable) or not isinstance(finer, CovariateTable):
        return one.formula
    name = one.formula.rpartition("x = ")[2]
    if name not in table.covariates:
        return one.formula
    k = table.covariates.index(name)
    x, scaled = np.asarray(table.knots[k], float), np.asarray(finer.knots[k], float)
    if np.array_equal(x, scaled):
        return one.formula
    fine = np.linspace(x[0], x[-1], _POINTS)
    curve = formula_curve(one.formula, fine)
    if curve is None or not np.all(np.isfinite(curve)):
        return one.formula
    return closed_form(name, np.interp(fine, x, scaled), curve, np.zeros(_POINTS))[0]


def _adjusted(one: Adjusted, step: int) -> Adjusted:
    def told(values: dict[str, float]) -> dict[str, float]:
        return {path: full_number(f"effects.{one.effect}.{path}", v, step) for path, v in values.items()}

    return Adjusted(one.effect, told(dict(one.before)), told(dict(one.after)))


def _prefix(name: str, camera: Camera) -> str:
    return f"effects.{name}." if name in camera.effects else "optics."
