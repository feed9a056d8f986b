"""Candidates of a search, and possible changes of the forms of effects that were found.

The form of an effect is never quite the true one, and the residuals of a large effect look like small other
effects. So further effects are judged conditional on columns that change the contributions of those found: a
model discrepancy in the sense of Kennedy and O'Hagan (2001), scaled by the effect that was found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OPTICS, vocabulary
from rim_camera_ros.effects.candidate import Block, Candidate, Column, Facts, Regressor, effect_block
from rim_camera_ros.effects.discrepancy import Change
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.select.effect_sizes import change_by


def candidates(camera: Camera, facts: Facts, *, effects: Sequence[str] | None = None) -> list[Candidate]:
    """Return the variants of every effect that the camera lacks and the recordings could contain.

    Effects of the demodulation are candidates only where the camera demodulates.
    """
    known = vocabulary()
    if not measurement_of(camera).demodulates:
        known = {name: one for name, one in known.items() if not one.demodulates}
    # those of the optics last, whose columns need no light
    names = [*(name for name in known if name not in OPTICS), *OPTICS]
    return [
        candidate
        for name in names
        if name not in camera.effects and (effects is None or name in effects)
        for candidate in known[name].candidates(camera, facts)
    ]


Array = NDArray[Any]

#: 1-sigma of each change of a form, as a share of the effect's contribution (RMS in units of the noise).
SHARE = 0.3
#: Owner of these regressors.
FORM = "form"
#: Stations of which the sizes of columns are taken, at most.
_MOST_STATIONS = 12


def form_blocks(fitted: Fit, names: Sequence[str], variants: Sequence[Candidate]) -> list[Block]:
    """Return one block of changes for each effect of a fitted camera that acts on the light of the image.

    ``variants`` of the same effect add their columns to its block. Effects without a discrepancy have no
    block, nor have names that are no effects of the camera (optics, surfaces): these have own curves.
    """
    effects = fitted.camera.effects
    blocks = []
    for name in names:
        if name not in effects or not effects[name].has_discrepancy:
            continue
        own = [variant.block for variant in variants if variant.effect == name]
        blocks.append(_sized(fitted, name, own))
    return blocks


def change_of_forms(
    camera: Camera, names: Sequence[str], forms: Sequence[Block], values: Mapping[str, float]
) -> Callable[[Prediction], Array]:
    """Return a function for the change of a station's distances [m] by changes of the forms of effects.

    ``values`` are, by label, the coefficients of the ``forms`` and those of the parameters of the camera's
    effects ``names``. Effects whose changes the data do not determine where they act most contribute nothing.
    """
    by_name = {form.regressors[0].label.split(".")[1]: form for form in forms}
    kept = [name for name in names if name in by_name and camera.effects[name].discrepancy_is_determined]
    effects = [camera.effects[name] for name in kept]
    blocks = [
        *(by_name[name] for name in kept),
        *(effect_block(effect, effect.priors()) for effect in effects),
    ]

    def change(prediction: Prediction) -> Array:
        total = np.zeros(prediction.distance.shape)
        for block in blocks:
            for regressor, (column, _) in zip(block.regressors, block.columns(prediction), strict=True):
                total += values.get(regressor.label, 0.0) * np.nan_to_num(column)
        # factors of light and distance leave their range beside edges, where nothing was fitted
        used = np.abs(total[prediction.used])
        most = float(used.max()) if used.size else 0.0
        return np.clip(total, -most, most)

    return change


def _sized(fitted: Fit, name: str, variants: Sequence[Block]) -> Block:
    """Return the block of changes of an effect; its priors are shares of the effect's contribution."""
    every = max(1, len(fitted.forward.dataset.stations) // _MOST_STATIONS)
    some = list(fitted.forward.predictions(every=every))
    weights = [_squares(predicted, change_by(predicted, name)) for predicted in some]
    whole = sum(float(weight.sum()) for weight in weights)

    def moments(values: list[Array]) -> tuple[Array, Array]:
        """Return mean and inverse spread (K, 1, 1) where the effect acts."""
        first, second = (
            np.sum([np.sum(w * f**k, axis=(1, 2)) for w, f in zip(weights, values, strict=True)], axis=0)
            / max(whole, 1e-300)
            for k in (1, 2)
        )
        spread = np.sqrt(np.maximum(second - first**2, 0.0))
        inverse = np.where(spread > 1e-6, 1.0 / np.maximum(spread, 1e-6), 0.0)
        return first[:, None, None], inverse[:, None, None]

    middle, scale = moments([_factors(predicted) for predicted in some])

    def columns(prediction: Prediction) -> list[Column]:
        factors = (_factors(prediction) - middle) * scale
        result = list(_changes(prediction, name, factors))
        for block in variants:
            result += block.columns(prediction)
        return result

    sums: Any = 0.0
    for predicted in some:
        sums = sums + np.array([float(_squares(predicted, change).sum()) for change in columns(predicted)])
    priors = np.where(sums > 0, SHARE * np.sqrt(whole / np.where(sums > 0, sums, 1.0)), 0.0)
    regressors = tuple(
        Regressor(f"form.{name}.{i}", FORM, max(float(prior), 1e-9)) for i, prior in enumerate(priors)
    )
    return Block(regressors, columns, in_order=any(variant.in_order for variant in variants))


def _squares(prediction: Prediction, change: Column) -> Array:
    """Return the squares of a column in units of the noise, (H, W), 0 where a pixel is not used."""
    distance, amplitude = change
    total = np.where(prediction.used, np.nan_to_num(distance) / prediction.sigma, 0.0) ** 2
    if amplitude is not None:
        lit = np.nan_to_num(amplitude) / prediction.amplitude_sigma
        total = total + np.where(prediction.amplitude_used, lit, 0.0) ** 2
    return np.asarray(np.nan_to_num(total))


def _changes(prediction: Prediction, name: str, factors: Array) -> Iterator[Column]:
    distance, amplitude = (None if one is None else np.nan_to_num(one) for one in change_by(prediction, name))
    assert distance is not None
    effect = prediction.context.camera.effects[name]
    yield from effect.discrepancy(Change(prediction, distance, amplitude, factors))


def _factors(prediction: Prediction) -> Array:
    """Return smooth factors (F, H, W) that vary an effect's contribution over image, light and distance."""
    shape = prediction.distance.shape
    v = np.linspace(-1.0, 1.0, shape[0])[:, None]
    u = np.linspace(-1.0, 1.0, shape[1])[None, :]
    found: list[Array] = [u, v, u * u, v * v, u * v]
    amplitude = np.where(prediction.view.geometry.hit, np.nan_to_num(prediction.amplitude), 0.0)
    light = np.log(np.maximum(amplitude, 1.0))
    distance = np.nan_to_num(prediction.delivered.distance)
    found += [light, light * light, distance, distance**2]
    return np.stack([np.broadcast_to(one, shape) for one in found])
