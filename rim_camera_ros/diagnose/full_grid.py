"""A diagnosis of every k-th pixel, restated in pixels of the whole sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.added_light import place_of_light
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.formula import closed_form, formula_curve
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.effects import AdditionalLight, CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.fit.decimation import full_camera, full_image, full_number

_ONE_OF = "of every {0} x {0} pixels one was looked at"
#: Points of a closed form by which it is restated.
_POINTS = 32


def on_full_grid(result: Diagnosis, camera: Camera, step: int) -> Diagnosis:
    """Restate a diagnosis of every ``step``-th pixel for the ``camera`` with all pixels; in place.

    The diagnosis of a grid that was coarsened twice is restated twice.
    """
    before = _ONE_OF.format(result.step)
    small, full = result.camera, full_camera(result.camera, camera, step)
    result.missing = [restated(effect, small, full, step) for effect in result.missing]
    result.adjusted = [_adjusted(term, step) for term in result.adjusted]
    result.looked_at, result.camera = result.model, full
    result.where = replace(result.where, pixels=full_image(result.where.pixels, camera.shape, step))
    result.notes = [*(note for note in result.notes if note != before), _ONE_OF.format(result.step)]
    return result


def restated(effect: Missing, small: Camera, full: Camera, step: int) -> Missing:
    """Convert an effect found by the ``small`` camera of every ``step``-th pixel to the ``full`` camera."""
    prefix = _prefix(effect.effect, small)
    low_and_high = {
        path: (full_number(prefix + path, low, step), full_number(prefix + path, high, step))
        for path, (low, high) in effect.interval.items()
    }
    values = {path: full_number(prefix + path, value, step) for path, value in effect.parameters.items()}
    sentence, formula = effect.sentence, _formula(effect, small, full)
    if effect.effect in small.effects:
        sentence = sentence.replace(
            small.effects[effect.effect].sentence(), full.effects[effect.effect].sentence()
        )
    if effect.model == AdditionalLight.name:
        sentence = sentence.replace(place_of_light(small), place_of_light(full))
    if effect.formula is not None and formula is not None:
        sentence = sentence.replace(effect.formula, formula)
    return replace(effect, parameters=values, interval=low_and_high, sentence=sentence, formula=formula)


def _formula(effect: Missing, small: Camera, full: Camera) -> str | None:
    """Return a closed form restated for a covariate in pixels of the whole sensor, over its table's knots."""
    table, finer = (effect_of(camera, CovariateTable) for camera in (small, full))
    if (
        effect.formula is None
        or not isinstance(table, CovariateTable)
        or not isinstance(finer, CovariateTable)
    ):
        return effect.formula
    name = effect.formula.rpartition("x = ")[2]
    if name not in table.covariates:
        return effect.formula
    k = table.covariates.index(name)
    x, scaled = np.asarray(table.knots[k], float), np.asarray(finer.knots[k], float)
    if np.array_equal(x, scaled):
        return effect.formula
    fine = np.linspace(x[0], x[-1], _POINTS)
    curve = formula_curve(effect.formula, fine)
    if curve is None or not np.all(np.isfinite(curve)):
        return effect.formula
    return closed_form(name, np.interp(fine, x, scaled), curve, np.zeros(_POINTS))[0]


def _adjusted(term: Adjusted, step: int) -> Adjusted:
    def converted(values: dict[str, float]) -> dict[str, float]:
        return {path: full_number(f"effects.{term.effect}.{path}", v, step) for path, v in values.items()}

    return Adjusted(term.effect, converted(dict(term.before)), converted(dict(term.after)))


def _prefix(name: str, camera: Camera) -> str:
    return f"effects.{name}." if name in camera.effects else "optics."
