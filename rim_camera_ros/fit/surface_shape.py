"""Departures of surfaces from a plane, which are the same in all poses: a board bows and twists.

A printed board of a metre sags or warps by a millimetre (ISO 12781 calls it flatness). In coordinates of the
surface, from -1 to 1 over its extent, the departure along its normal is a polynomial of the second degree;
what is constant or linear in it is an error of its poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.candidate import Block, Column, Regressor
from rim_camera_ros.fit.pose_columns import PoseColumn, by_shift
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene, Surface

Array = NDArray[Any]

#: Labels of departures from a plane: ``surface_shape.SURFACE.bow_x|bow_y|twist``.
SHAPE = "surface_shape."

#: By name: the departure at surface coordinates x and y, each from -1 to 1. A bow is from the middle to the
#: edge, a twist from the middle to a corner.
FORMS: Mapping[str, Callable[[Array, Array], Array]] = {
    "bow_x": lambda x, y: x**2 - 1 / 3,
    "bow_y": lambda x, y: y**2 - 1 / 3,
    "twist": lambda x, y: x * y,
}


def surface_shape_block(scene: Scene) -> Block:
    """Return a bow along each axis and a twist [m] of every surface with ``flatness_sigma``."""
    shaped = [
        (number, surface)
        for number, surface in enumerate(scene.surfaces)
        if surface.half_extent is not None and surface.flatness_sigma > 0
    ]
    regressors = tuple(
        Regressor(f"{SHAPE}{surface.name}.{form}", "shape", surface.flatness_sigma)
        for _, surface in shaped
        for form in FORMS
    )

    def columns(prediction: Prediction) -> list[Column]:
        return [
            prediction.pose_change(column)
            for number, surface in shaped
            for column in _of_surface(prediction, number, surface)
        ]

    return Block(regressors, columns, pointwise=True)


def _of_surface(prediction: Prediction, number: int, surface: Surface) -> list[PoseColumn]:
    """Return the derivatives of a station's distances by the forms of a surface."""
    view = prediction.view
    mine = view.geometry.surface == number
    labels = [f"{SHAPE}{surface.name}.{form}" for form in FORMS]
    if not mine.any():
        nothing = np.zeros(mine.shape)
        return [PoseColumn(label, surface.flatness_sigma, nothing, nothing) for label in labels]
    assert surface.half_extent is not None
    pose = view.poses[surface.name]
    rotation = rotation_matrix(pose.orientation)
    along, light = by_shift(rotation[:, 2], view.geometry, mine, prediction.context.rays)
    local = (view.geometry.points[mine] - np.array(pose.position)) @ rotation
    x, y = local[:, 0] / surface.half_extent[0], local[:, 1] / surface.half_extent[1]
    result = []
    for label, form in zip(labels, FORMS.values(), strict=True):
        departure = np.zeros(mine.shape)
        departure[mine] = form(x, y)
        result.append(PoseColumn(label, surface.flatness_sigma, along * departure, light * departure))
    return result
