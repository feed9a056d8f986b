"""Regressors that are not parameters of effects: free poses, the gain, and ordinary imperfections.

Nobody knows the reflectivity of a printed tile to a percent, the poses of a total station share the error of
its set-up, no surface is perfectly matt, and a camera constant is known within its covariance. An
imperfection that is not a nuisance parameter of the adjustment would be mistaken for physics (Kennedy &
O'Hagan 2001 on model discrepancy). The parameters here are common to all poses; gains of pixels and errors of
single poses are random effects in `normal_equations` and `fold_sums`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Block, Column, Groups, Regressor, effect_block
from rim_camera_ros.effects.light_curves import FALLOFF, LOBE, tile_labels
from rim_camera_ros.effects.sections import light_block, optics_columns
from rim_camera_ros.fit.pose_columns import PoseColumn, by_shift
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.surface_shape import SHAPE, surface_shape_block
from rim_camera_ros.scene import Scene

#: Label of the radiometric gain.
GAIN = "radiometry.gain"


def pose_block(paths: Sequence[tuple[str, float]]) -> Block:
    """Return the regressors of the free poses of a scene: ``scene.SURFACE.AXIS`` with their priors."""
    regressors = tuple(Regressor(path, "scene", prior) for path, prior in paths)

    def columns(prediction: Prediction) -> list[Column]:
        found = {column.path: column for column in prediction.pose_columns}
        zero = np.zeros(prediction.distance.shape)
        result: list[Column] = []
        for path, _ in paths:
            result.append(prediction.pose_change(found[path]) if path in found else (zero, zero))
        return result

    return Block(regressors, columns, pointwise=True)


def gain_block(prior: float = 1.0) -> Block:
    """Return the regressor of the relative radiometric gain (label ``radiometry.gain``, relative)."""

    def columns(prediction: Prediction) -> list[Column]:
        return [prediction.gain_column()]

    return Block((Regressor(GAIN, "radiometry", prior),), columns, pointwise=True)


def present_blocks(
    camera: Camera,
    *,
    effects: Sequence[str] | None = None,
    origin: Camera | None = None,
    widths: Mapping[str, float] | None = None,
) -> list[Block]:
    """Return the regressors of the effects of a camera: changes of their parameters.

    Priors are weak: as wide as the value itself, or as the usual size of such an effect. The priors of
    parameters that the ``origin`` has are as wide as there; ``widths`` states others by path.
    """
    blocks = []
    for name, effect in camera.effects.items():
        if effect.estimated != "joint" or (effects is not None and name not in effects):
            continue
        priors = effect.priors()
        if origin is not None and name in origin.effects:
            there = origin.effects[name].priors()
            priors = {path: there.get(path, width) for path, width in priors.items()}
        priors = {path: (widths or {}).get(f"effects.{name}.{path}", width) for path, width in priors.items()}
        if priors:
            blocks.append(effect_block(effect, priors))
    return blocks


Array = NDArray[Any]

#: Multiple of its stated size above which an imperfection is a fault of the set-up or of the camera file.
BEYOND = 3.0
#: Labels of errors that all poses of a surface share, and of the optics within their covariance.
COMMON_POSE, OPTICS = "common_pose.", "optics_covariance."
#: Labels of errors of sensors whose readings effects depend on.
SENSOR = "sensor."
#: Labels of the smooth field of the pixels' offsets: powers of row and column over the array.
PATTERN_FIELD = "pattern_field."
_POWERS = ((0, 0), (0, 1), (1, 0), (0, 2), (1, 1), (2, 0))
#: 1-sigma of each part of the field [m]: unknown.
_FIELD_SIGMA = 5.0
_DIRECTIONS = ("offset", "tilt_x", "tilt_y")
#: End of the label of the scale that all positions of a surface share.
POSE_SCALE = ".scale"


def imperfection_blocks(
    camera: Camera, scene: Scene, *, lobe: bool = True, pattern_field: bool = False
) -> list[Block]:
    """Return the regressors of reflectivities, a weak lobe, errors of poses and sensors, and known optics.

    Sizes are those of the files: ``reflectivity_sigma``, ``pose_sigma`` with ``pose_common``,
    ``flatness_sigma``, and the covariance of the optics; that of the lobe is `light_curves.LOBE_SIGMA`.
    Without ``lobe`` the caller has other curves for surfaces. With ``pattern_field`` a smooth field of the
    offsets of pixels is estimated in addition to single offsets that are taken to be small.
    """
    blocks = [
        reflectivity_block(scene),
        light_block(LOBE if lobe else FALLOFF),
        *linear_blocks(camera, scene, pattern_field=pattern_field),
    ]
    return [block for block in blocks if block.regressors]


def linear_blocks(camera: Camera, scene: Scene, *, pattern_field: bool = False) -> list[Block]:
    """Return the blocks that are linear nuisances: their values are added to predictions without steps."""
    blocks = [
        common_pose_block(scene),
        surface_shape_block(scene),
        known_optics(camera),
        sensor_block(camera),
    ]
    if pattern_field:
        blocks.append(pattern_field_block(camera.shape))
    return [block for block in blocks if block.regressors]


def pattern_field_block(shape: tuple[int, int]) -> Block:
    """Return the regressors of a smooth field of offsets over an array of ``shape`` (H, W), each in metres.

    Where single offsets are taken to be small, their mean and every smooth part of them would be known far
    better than for any real camera: the field leaves these free.
    """
    regressors = tuple(Regressor(f"{PATTERN_FIELD}{i}.{j}", "pattern", _FIELD_SIGMA) for i, j in _POWERS)
    images = [_power(i, j, shape) for i, j in _POWERS]

    def columns(prediction: Prediction) -> list[Column]:
        return [(image, None) for image in images]

    return Block(regressors, columns)


def pattern_field(values: Mapping[str, float], shape: tuple[int, ...]) -> Array:
    """Return the smooth field of offsets (H, W) [m] that fitted values, by label, describe."""
    return sum(
        (values.get(f"{PATTERN_FIELD}{i}.{j}", 0.0) * _power(i, j, shape) for i, j in _POWERS),
        np.zeros(shape),
    )


def _power(i: int, j: int, shape: tuple[int, ...]) -> Array:
    rows, columns = np.linspace(-1, 1, shape[0])[:, None], np.linspace(-1, 1, shape[1])[None, :]
    return np.asarray(rows**i * columns**j * np.ones(shape))


def reflectivity_block(scene: Scene) -> Block:
    """Return a regressor [relative] for each tile whose reflectivity is stated with an error."""
    regressors: list[Regressor] = []
    numbers: list[int] = []
    first = 0
    labels = tile_labels(scene)
    for surface in scene.surfaces:
        if surface.is_described and surface.reflectivity_sigma > 0:
            for number in range(first, first + surface.tiles):
                regressors.append(Regressor(labels[number], "radiometry", surface.reflectivity_sigma))
                numbers.append(number)
        first += surface.tiles

    places = np.full(first + 1, -1)
    places[numbers] = np.arange(len(numbers))

    def grouped(prediction: Prediction) -> Groups:
        return prediction.groups_change(places[prediction.view.geometry.tile], len(numbers))

    return Block(
        tuple(regressors),
        lambda prediction: grouped(prediction).columns(),
        grouped=grouped,
        pointwise=True,
    )


def common_pose_block(scene: Scene) -> Block:
    """Return the errors of the reference instrument that are the same in all poses of a surface.

    An offset and two tilts, and the scale of all its positions where one is stated.
    """
    regressors: list[Regressor] = []
    scaled: dict[str, tuple[int, str]] = {}
    for number, surface in enumerate(scene.surfaces):
        share = float(np.sqrt(surface.pose_common))
        if surface.pose != "truth":
            continue
        if surface.pose_scale_sigma > 0:
            label = f"{COMMON_POSE}{surface.name}{POSE_SCALE}"
            regressors.append(Regressor(label, "pose", surface.pose_scale_sigma))
            scaled[label] = (number, surface.name)
        if share == 0:
            continue
        offset, tilt = surface.pose_sigma
        tilt = 0.0 if surface.type == "sphere" else tilt
        for name, sigma in zip(_DIRECTIONS, (offset, tilt, tilt), strict=True):
            if sigma > 0:
                label = f"{COMMON_POSE}{surface.name}.{name}"
                regressors.append(Regressor(label, "pose", share * sigma))

    def columns(prediction: Prediction) -> list[Column]:
        found = {pose_column.path: pose_column for pose_column in prediction.pose_columns}
        nothing = np.zeros(prediction.distance.shape)
        result: list[Column] = []
        for regressor in regressors:
            if regressor.label in scaled:
                column = _scale_column(prediction, regressor, *scaled[regressor.label])
            else:
                column = found.get("pose." + regressor.label.removeprefix(COMMON_POSE))
            result.append((nothing, nothing) if column is None else prediction.pose_change(column))
        return result

    return Block(tuple(regressors), columns, pointwise=True)


def _scale_column(prediction: Prediction, scale: Regressor, number: int, surface: str) -> PoseColumn | None:
    """Return the derivative of a station's distances by the scale of all positions of a surface."""
    view = prediction.view
    mine = view.geometry.surface == number
    if not mine.any():
        return None
    shift = np.array(view.poses[surface].position)
    return PoseColumn(
        scale.label, scale.prior, *by_shift(shift, view.geometry, mine, prediction.context.rays)
    )


def known_optics(camera: Camera) -> Block:
    """Return the principal axes of the optics' covariance in the camera file, each with its 1-sigma."""
    stated = camera.covariance
    if stated is None:
        return Block((), lambda prediction: [])
    own = [i for i, path in enumerate(stated.parameters) if path.startswith("optics.")]
    paths = [stated.parameters[i].removeprefix("optics.") for i in own]
    matrix = np.asarray(stated.matrix.values, float)[np.ix_(own, own)]
    values, vectors = np.linalg.eigh(matrix) if own else (np.zeros(0), np.zeros((0, 0)))
    # directions that are known a thousand times better than the worst count as exactly known
    kept = [i for i, variance in enumerate(values) if variance > 1e-6 * max(values.max(), 1e-300)]
    regressors = tuple(
        Regressor(f"{OPTICS}{k}", "optics", float(np.sqrt(values[i]))) for k, i in enumerate(kept)
    )
    if not regressors:
        return Block((), lambda prediction: [])
    by_path = optics_columns(camera, paths)

    def columns(prediction: Prediction) -> list[Column]:
        found = by_path(prediction)
        return [
            (sum((vectors[j, i] * found[j][0] for j in range(len(paths))), np.zeros(())), None) for i in kept
        ]

    return Block(regressors, columns, pointwise=True)


def sensor_block(camera: Camera) -> Block:
    """Return the errors of sensors whose readings effects of the camera depend on."""
    errors = [
        (effect, name, sigma)
        for effect in camera.effects.values()
        for name, sigma in effect.sensor_sigmas().items()
    ]
    regressors = tuple(Regressor(f"{SENSOR}{effect.name}.{name}", "sensor", s) for effect, name, s in errors)

    def columns(prediction: Prediction) -> list[Column]:
        result: list[Column] = []
        for effect, name, _ in errors:
            distance, amplitude = effect.sensor_columns(prediction.context)[name]
            zero = np.zeros(prediction.distance.shape)
            result.append((zero + distance, zero + amplitude))
        return result

    return Block(
        regressors,
        columns,
        in_order=any(effect.remembers for effect, *_ in errors),
        pointwise=all(effect.pointwise for effect, *_ in errors),
    )


def is_linear(path: str) -> bool:
    """Whether a regressor is a linear nuisance, whose value is no parameter of camera or light."""
    return path.startswith((COMMON_POSE, OPTICS, PATTERN_FIELD, SENSOR, SHAPE))
