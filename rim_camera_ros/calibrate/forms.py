"""How the form of a named effect may be wrong: what it does, changed a little.

An effect's form is never quite the true one, and what a large effect leaves looks like small other ones.
So further effects are judged beside columns that change what the named ones do: by smooth factors over the
image, light and distance, by its spread along rows and columns, and by other variants of the effect.
A discrepancy of the model in the sense of Kennedy and O'Hagan (2001), with the named effect as its scale.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rim_camera_ros.calibrate.blocks import Block, Regressor, effect_block, present_priors
from rim_camera_ros.calibrate.candidate import Candidate
from rim_camera_ros.calibrate.library import GEOMETRY, OF_SURFACES
from rim_camera_ros.calibrate.prediction import Column, Prediction
from rim_camera_ros.calibrate.problem import Fit
from rim_camera_ros.calibrate.sizes import change_by
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm

Array = NDArray[Any]

#: 1-sigma of each change of a form, as a share of what the effect does (RMS in units of the noise).
SHARE = 0.3
#: Owner of these regressors.
FORM = "form"
#: Stations of which the sizes of columns are taken, at most.
_MOST_STATIONS = 12
#: Spreads along rows and along columns, as shares of the array's width.
_SPREADS = (0.02, 0.07, 0.25)
#: Effects whose changes of form the data do not determine where they act most.
_NOT_DETERMINED = frozenset({"emitter_offset", "mixed_pixels"})
#: Degree of polynomials of the direction.
_DEGREE = 4
#: Smooth factors that depend on the direction alone, the first of them.
_DIRECTIONS = 5
#: Effects that the image around a pixel makes.
_OF_IMAGE = frozenset({"scattering", "mixed_pixels", "multipath", "saturation_bleed"})


def form_blocks(fitted: Fit, names: Sequence[str], variants: Sequence[Candidate]) -> list[Block]:
    """Return one block of changes for each effect of a fitted camera that acts on the light of the image.

    ``variants`` of the same effects, as they stand in the library, join where they have their name.
    Effects of the geometry, of surfaces and of the response have no block: they have curves of their own. Nor
    have functions of distance, amplitude or angle: a free one could do what another effect does. The phase
    and size of a cyclic error may change over the array otherwise than in proportion to the pixel.
    """
    effects = fitted.camera.effects
    blocks = []
    for name in names:
        if name not in effects or name in {*GEOMETRY, *OF_SURFACES, "amplitude_nonlinearity"}:
            continue
        if isinstance(effects[name], DistanceTerm) and name not in {*_OF_IMAGE, "cyclic_error"}:
            continue
        own = [one.block for one in variants if one.effect == name]
        blocks.append(_sized(fitted, name, own))
    return blocks


def change_of_forms(
    camera: Camera, names: Sequence[str], forms: Sequence[Block], values: Mapping[str, float]
) -> Callable[[Prediction], Array]:
    """Return what changes of the forms of effects do to a station's distances [m].

    ``values`` are the coefficients of the ``forms`` and, beside them, of the parameters of the effects
    ``names`` of the camera, by label. Nothing of effects whose changes the data do not determine where they
    act most: mixed pixels, fitted where edges are not, and an emitter beside the lens, whose first order is
    the same in all frames as the fixed pattern is.
    """
    by_name = {one.regressors[0].label.split(".")[1]: one for one in forms}
    kept = [name for name in names if name in by_name and name not in _NOT_DETERMINED]
    effects = [camera.effects[name] for name in kept]
    blocks = [
        *(by_name[name] for name in kept),
        *(effect_block(one, present_priors(one, camera)) for one in effects),
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
    """Return the block whose priors are shares of what the effect does."""
    every = max(1, len(fitted.forward.dataset.stations) // _MOST_STATIONS)
    some = list(fitted.forward.predictions(every=every))
    weights = [_squares(one, change_by(one, name)) for one in some]
    whole = sum(float(one.sum()) for one in weights)

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

    middle, scale = moments([_factors(one) for one in some])

    def columns(prediction: Prediction) -> list[Column]:
        factors = (_factors(prediction) - middle) * scale
        result = list(_changes(prediction, name, factors))
        for block in variants:
            result += block.columns(prediction)
        return result

    sums: Any = 0.0
    for one in some:
        sums = sums + np.array([float(_squares(one, change).sum()) for change in columns(one)])
    priors = np.where(sums > 0, SHARE * np.sqrt(whole / np.where(sums > 0, sums, 1.0)), 0.0)
    regressors = tuple(
        Regressor(f"form.{name}.{i}", FORM, max(float(prior), 1e-9)) for i, prior in enumerate(priors)
    )
    return Block(regressors, columns, in_order=any(one.in_order for one in variants))


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
    if name == "cyclic_error":
        by_phase = prediction.columns(prediction.context.camera.effects[name])
        waves = [column for path, (column, _) in by_phase.items() if path.endswith(".phase")]
        for wave in (distance, *waves):
            for factor in factors[:_DIRECTIONS]:
                yield wave * factor, None
        return
    nothing = np.zeros(distance.shape)
    if amplitude is not None:
        yield nothing, amplitude
    for factor in factors:
        yield distance * factor, None
        if amplitude is not None:
            yield nothing, amplitude * factor
    if name == "emission_pattern":
        for bright in _of_direction(distance.shape):
            yield prediction.light_change(name, bright + 0j)
    if name == "motion":
        later, more = _later(prediction)
        assert more is not None
        for factor in (np.ones(1), *factors[:2]):
            # from row to row at another time, as with a rolling shutter
            yield later * factor, more * factor
    if name == "saturation_bleed":
        for fading in _beside_saturated(prediction):
            yield fading, None
    if name not in _OF_IMAGE:
        return
    for share in _SPREADS:
        width = share * distance.shape[1]
        for axis in (0, 1):
            yield gaussian_filter1d(distance, width, axis=axis, mode="nearest") - distance, None
            if amplitude is not None:
                yield nothing, gaussian_filter1d(amplitude, width, axis=axis, mode="nearest") - amplitude


def _beside_saturated(prediction: Prediction) -> list[Array]:
    """Return what fades with the gap to the nearest saturated pixel of the row, and of the column, (H, W).

    Of either side apart: a column that is read out downwards need not spread upwards.
    """
    saturated = prediction.context.saturated
    if saturated is None or not saturated.any():
        return [np.zeros(prediction.distance.shape)] * (4 * len(_SPREADS))
    width = saturated.shape[1]
    found = []
    for axis in (0, 1):
        after = _gap(saturated, axis)
        before = np.flip(_gap(np.flip(saturated, axis), axis), axis)
        for gap in (after, before):
            found += [np.where(saturated, 0.0, np.exp(-gap / (share * width))) for share in _SPREADS]
    return found


def _gap(marked: NDArray[np.bool_], axis: int) -> Array:
    """Return pixels since the last marked one along an axis, infinite before the first."""
    place = np.arange(marked.shape[axis], dtype=float).reshape((-1, 1) if axis == 0 else (1, -1))
    last = np.maximum.accumulate(np.where(marked, place, -np.inf), axis=axis)
    return np.asarray(place - last)


def _later(prediction: Prediction) -> Column:
    """Return what it does that a frame is stamped at another time of its exposure, by a millisecond."""
    context = prediction.context
    assert context.geometry_at is not None
    (before, light), (after, more) = context.geometry_at(-0.0005), context.geometry_at(0.0005)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where((light > 0) & (more > 0), np.log(more / light), 0.0)
    turned = 2 * np.pi / context.ambiguity * np.nan_to_num(after.distance - before.distance)
    return prediction.light_change(None, np.nan_to_num(relative) + 1j * turned)


def _of_direction(shape: tuple[int, ...]) -> list[Array]:
    """Return smooth functions (H, W) of the direction: a beam need not be round, nor point forwards."""
    v = np.linspace(-1.0, 1.0, shape[0])[:, None]
    u = np.linspace(-1.0, 1.0, shape[1])[None, :]
    degrees = range(_DEGREE + 1)
    return [u**i * v**j for i in degrees for j in degrees if 0 < i + j <= _DEGREE]


def _factors(prediction: Prediction) -> Array:
    """Return smooth factors (F, H, W) on what an effect does, where it acts otherwise from place to place."""
    shape = prediction.distance.shape
    v = np.linspace(-1.0, 1.0, shape[0])[:, None]
    u = np.linspace(-1.0, 1.0, shape[1])[None, :]
    found: list[Array] = [u, v, u * u, v * v, u * v]
    amplitude = np.where(prediction.view.geometry.hit, np.nan_to_num(prediction.amplitude), 0.0)
    light = np.log(np.maximum(amplitude, 1.0))
    distance = np.nan_to_num(prediction.delivered.distance)
    found += [light, light * light, distance, distance**2]
    return np.stack([np.broadcast_to(one, shape) for one in found])
