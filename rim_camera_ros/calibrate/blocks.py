"""Regressors of a joint fit: columns by parameters of effects, poses, power, optics, the light's curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.light_curves import LOBE, LOBE_SIGMA, RIPPLES
from rim_camera_ros.calibrate.prediction import Column, Prediction
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset
from rim_camera_ros.effects.base import Effect, row_name
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Scattering
from rim_camera_ros.effects.warm_up_drift import WarmUpDrift
from rim_camera_ros.optics import pixel_rays
from rim_camera_ros.parameters import with_values

Array = NDArray[Any]


#: 1-sigma of the relative change of a surface's light at an angle of incidence, and of what is read of light.
REFLECTANCE_PRIOR = 0.2


#: ... and of its ripples over the phase.
_RIPPLE_PRIOR = 0.03


_EFFECTS_WITHOUT_AMPLITUDE = frozenset(
    {
        "cyclic_error",
        "background_light",
        "amplitude_offset",
        "incidence_angle",
        "integration_time_offset",
        "fixed_pattern_offset",
        "saturation_bleed",
        "warm_up_drift",
        "ambient_temperature",
        "distance_scale",
        "integral_table",
        "empirical",
    }
)


@dataclass(frozen=True)
class Regressor:
    """One column of the design: label, the effect or curve it belongs to, 1-sigma of its prior."""

    label: str
    owner: str
    prior: float


#: Label of the radiometric gain.
GAIN = "radiometry.gain"

#: The columns of each regressor of a block.
ColumnsOf = Callable[[Prediction], Sequence[Column]]


@dataclass(frozen=True)
class Block:
    """Regressors whose columns are computed together; ``in_order`` where they need the stations in order.

    ``grouped``, where each pixel has one of them at most: its number (-1: none), and the derivatives of
    distance and amplitude by it, (H, W) each.
    """

    regressors: tuple[Regressor, ...]
    columns: ColumnsOf
    in_order: bool = False
    grouped: Callable[[Prediction], tuple[Array, Array, Array]] | None = None


def effect_block(
    effect: Effect, priors: Mapping[str, float], *, owner: str | None = None, label: str = ""
) -> Block:
    """Return the regressors of some parameters of an effect: ``priors`` by dotted path.

    The label is ``effects.NAME.PATH``, with ``label`` appended where variants must be told apart.
    """
    paths = tuple(priors)
    has_amplitude = effect.name not in _EFFECTS_WITHOUT_AMPLITUDE

    def columns(prediction: Prediction) -> list[Column]:
        found = prediction.columns(effect)
        return [(found[path][0], found[path][1] if has_amplitude else None) for path in paths]

    name = effect.name if owner is None else owner
    regressors = tuple(Regressor(f"effects.{effect.name}.{p}{label}", name, priors[p]) for p in paths)
    return Block(regressors, columns, in_order=effect.remembers)


def together(*blocks: Block) -> Block:
    """Return one block of the regressors of several, in their order."""
    regressors = tuple(regressor for one in blocks for regressor in one.regressors)
    return Block(
        regressors,
        lambda prediction: [c for one in blocks for c in one.columns(prediction)],
        in_order=any(one.in_order for one in blocks),
    )


def light_block(labels: Sequence[str]) -> Block:
    """Return the regressors of curves of the light: `light_curves.RIPPLES` or `light_curves.SURFACES`."""
    prior = REFLECTANCE_PRIOR
    if labels[0] in RIPPLES:
        prior = _RIPPLE_PRIOR
    elif labels[0] in LOBE:
        prior = LOBE_SIGMA
    regressors = tuple(Regressor(label, "radiometry", prior) for label in labels)
    return Block(regressors, lambda prediction: prediction.curve_columns(labels))


def pose_block(paths: Sequence[tuple[str, float]]) -> Block:
    """Return the regressors of the free poses of a scene: ``scene.SURFACE.AXIS`` with their priors."""
    regressors = tuple(Regressor(path, "scene", prior) for path, prior in paths)

    def columns(prediction: Prediction) -> list[Column]:
        found = {one.path: one for one in prediction.pose_columns}
        zero = np.zeros(prediction.distance.shape)
        result: list[Column] = []
        for path, _ in paths:
            result.append(prediction.pose_change(found[path]) if path in found else (zero, zero))
        return result

    return Block(regressors, columns)


def gain_block(prior: float = 1.0) -> Block:
    """Return the regressor of the relative radiometric gain (label ``radiometry.gain``, relative)."""

    def columns(prediction: Prediction) -> list[Column]:
        return [prediction.gain_column()]

    return Block((Regressor(GAIN, "radiometry", prior),), columns)


#: 1-sigma of a distance term's prior [m] where it is at its largest.
TERM_SIZE = 0.05


#: Angle [gon] at which the incidence polynomial's prior has that size.
_STEEP = 60.0


#: Effects whose parameters no mean of a recording tells, or that are tables of their own.
UNFITTED = frozenset(
    {
        "fixed_pattern_offset",
        "integral_table",
        "empirical",
        "interference",
        "reference_path",
        "background_light",
    }
)


def present_blocks(
    camera: Camera, *, effects: Sequence[str] | None = None, origin: Camera | None = None
) -> list[Block]:
    """Return the regressors of a camera's own effects: its parameters, about their values.

    Priors are weak: as wide as the value itself, or as such effects are large; those of parameters that the
    ``origin`` has are as wide as there.
    """
    blocks = []
    for name, effect in camera.effects.items():
        if name in UNFITTED or (effects is not None and name not in effects):
            continue
        priors = present_priors(effect, camera)
        if origin is not None and name in origin.effects:
            there = present_priors(origin.effects[name], origin)
            priors = {path: there.get(path, width) for path, width in priors.items()}
        if priors:
            blocks.append(effect_block(effect, priors))
    return blocks


def present_priors(effect: Effect, camera: Camera) -> dict[str, float]:
    """Return the free parameters of an effect by path with the 1-sigma of their weak prior."""
    if isinstance(effect, IncidenceAngle):
        return {
            f"polynomial.{row_name(key)}.{i}": TERM_SIZE / _STEEP ** (4 - i)
            for key in effect.polynomial
            for i in range(4)
        }
    if isinstance(effect, AmplitudeOffset):
        priors = {}
        for key, one in effect.hyperbola.items():
            priors[f"hyperbola.{row_name(key)}.a"] = max(abs(one.a), 1e-3)
            priors[f"hyperbola.{row_name(key)}.b"] = max(abs(one.b), 0.02 * abs(one.a))
        return priors
    if isinstance(effect, AmbientTemperature):
        return {"coefficient": 0.005, "time_constant": max(0.5 * effect.time_constant, 30.0)}
    if isinstance(effect, CyclicError):
        priors = {}
        for i, harmonic in enumerate(effect.harmonics):
            priors[f"harmonics.{i}.amplitude"] = max(abs(harmonic.amplitude), 0.005)
            priors[f"harmonics.{i}.phase"] = 1.0
        priors |= {"gradient.0": 0.005, "gradient.1": 0.005}
        return priors
    if isinstance(effect, WarmUpDrift):
        priors = {}
        for i, term in enumerate(effect.terms):
            priors[f"terms.{i}.amplitude"] = max(abs(term.amplitude), 0.02)
            priors[f"terms.{i}.time_constant"] = 0.5 * term.time_constant
        return priors
    if isinstance(effect, Scattering):
        priors = {}
        for i, kernel in enumerate(effect.kernels):
            priors[f"kernels.{i}.weight"] = max(kernel.weight, 0.01)
            priors[f"kernels.{i}.sigma.0"] = max(0.5 * kernel.sigma[0], 0.3)
            priors[f"kernels.{i}.sigma.1"] = max(0.5 * kernel.sigma[1], 0.3)
        if effect.ghost is not None:
            priors["ghost.weight"] = max(effect.ghost.weight, 0.003)
        return priors
    if isinstance(effect, MixedPixels) and effect.footprint is not None and effect.blur == 0.0:
        return {"footprint": 0.3} if effect.share is None else {"footprint": 0.3, "share": 0.3}
    return dict(effect.priors())


_OPTICS: dict[str, tuple[tuple[str, float, float], ...]] = {
    # name of the diagnosis: (path, step of the derivative, prior)
    "camera_constant": (
        ("fx", 0.1, 5.0),
        ("fy", 0.1, 5.0),
        ("cx", 0.1, 3.0),
        ("cy", 0.1, 3.0),
    ),
    "lens_distortion": (
        ("d.0", 1e-3, 0.1),
        ("d.1", 1e-3, 0.1),
        ("d.2", 1e-4, 0.003),
        ("d.3", 1e-4, 0.003),
    ),
}


def optics_block(camera: Camera, name: str) -> Block:
    """Return the regressors of the camera geometry: the optics' parameters behind a name of the
    vocabulary.
    """
    parts = _OPTICS[name]
    regressors = tuple(Regressor(f"optics.{path}", name, prior) for path, _, prior in parts)
    return Block(regressors, optics_columns(camera, [path for path, _, _ in parts]))


#: Steps of the derivatives by the optics.
_STEPS = {path: step for parts in _OPTICS.values() for path, step, _ in parts}


def optics_columns(camera: Camera, paths: Sequence[str]) -> ColumnsOf:
    """Return the derivatives of the distances by numbers of the optics (``fx``, ``d.0``)."""
    changes: list[Array] = []
    for path in paths:
        step = _STEPS.get(path, 1e-3)
        sides = []
        for sign in (1.0, -1.0):
            value = optics_value(camera, path) + sign * step
            optics = with_values(camera.optics, {path: value})
            sides.append(pixel_rays(optics, width=camera.sensor.width, height=camera.sensor.height))
        changes.append((sides[0] - sides[1]) / (2 * step))

    def columns(prediction: Prediction) -> list[Column]:
        geometry = prediction.view.geometry
        rays = camera.rays
        along = np.einsum("ijk,ijk->ij", geometry.normals, rays)
        result: list[Column] = []
        for change in changes:
            with np.errstate(invalid="ignore", divide="ignore"):
                by = -geometry.distance * np.einsum("ijk,ijk->ij", geometry.normals, change) / along
            by = np.where(geometry.hit, np.nan_to_num(by), 0.0)
            result.append((np.asarray(prediction.reading_change(by, 0.0)[0]), None))
        return result

    return columns


def optics_value(camera: Camera, path: str) -> float:
    """Return a number of the optics by its path: ``fx`` in pixels, ``d.0`` the first of the distortion."""
    from rim_camera_ros.parameters import flatten

    return flatten(camera.optics)[path]
