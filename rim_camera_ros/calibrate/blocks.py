"""Regressors of what every fit has: parameters of the camera's own effects, free poses, the gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rim_camera_ros.calibrate.prediction import Prediction
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Block, Column, Regressor, effect_block

#: Label of the radiometric gain.
GAIN = "radiometry.gain"


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


def present_blocks(
    camera: Camera, *, effects: Sequence[str] | None = None, origin: Camera | None = None
) -> list[Block]:
    """Return the regressors of a camera's own effects: its parameters, about their values.

    Priors are weak: as wide as the value itself, or as such effects are large; those of parameters that the
    ``origin`` has are as wide as there.
    """
    blocks = []
    for name, effect in camera.effects.items():
        if effect.estimated != "joint" or (effects is not None and name not in effects):
            continue
        priors = effect.priors()
        if origin is not None and name in origin.effects:
            there = origin.effects[name].priors()
            priors = {path: there.get(path, width) for path, width in priors.items()}
        if priors:
            blocks.append(effect_block(effect, priors))
    return blocks
