"""Target fields that a scene file describes: discs as circles, textured rectangles as checkerboards."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose
from rim_camera_ros.photogrammetry.targets import Target, TargetField
from rim_camera_ros.scene import Scene, Surface, quaternion, rotation_matrix

Array = NDArray[np.float64]

#: Points of a surface's frame by which its pose is compared, m.
_ARM = 0.1


@dataclass(frozen=True)
class FieldOnSurfaces:
    """A target field whose targets lie on surfaces of a scene.

    ``surfaces``: their poses in the field's frame, which is that of the first of them. ``of``: the surface
    of each target; ``edges``: for corners the vectors [m] to the next corners along both edges (2, 3), in
    the field's frame.
    """

    field: TargetField
    surfaces: Mapping[str, Pose]
    of: Mapping[str, str]
    edges: Mapping[str, Array]

    @classmethod
    def from_scene(cls, scene: Scene, truth: Mapping[str, Pose]) -> FieldOnSurfaces:
        """Return the field of a scene's discs (circles) and checkerboards (textured rectangles).

        A disc's id is its surface's name; a corner's is ``board/row/column``, rows and columns of the
        texture's grid, 0 at the board's centre. The surfaces' poses to each other are those of the scene
        file, of surfaces with ``pose: truth`` those in ``truth``. Raises `InputError` without a target.
        """
        carriers = [one for one in scene.surfaces if one.type == "disc" or is_checkerboard(one)]
        if not carriers:
            raise InputError(
                "the scene has no targets",
                place="surfaces",
                remedy="describe the target field by surfaces of type disc (circles) "
                "or a rectangle with a 2 x 2 texture (checkerboard)",
            )
        poses = scene.poses_for(truth)
        first = poses[carriers[0].name]
        back = rotation_matrix(first.orientation).T
        targets: dict[str, Target] = {}
        surfaces: dict[str, Pose] = {}
        of: dict[str, str] = {}
        edges: dict[str, Array] = {}
        for one in carriers:
            pose = poses[one.name]
            turn = back @ rotation_matrix(pose.orientation)
            origin = back @ (np.array(pose.position) - np.array(first.position))
            surfaces[one.name] = Pose(_triple(origin), quaternion(turn))
            if one.type == "disc":
                assert one.radius is not None
                targets[one.name] = Target(_triple(origin), one.radius, _triple(turn[:, 2]))
                of[one.name] = one.name
                continue
            assert one.texture is not None
            cell = np.array(one.texture.cell)
            for (row, column), local in _corners(one).items():
                name = f"{one.name}/{row}/{column}"
                targets[name] = Target(_triple(origin + turn[:, :2] @ local))
                of[name] = one.name
                edges[name] = (turn[:, :2] * cell).T
        return cls(TargetField(targets), surfaces, of, edges)

    def pose(self, poses: Mapping[str, Pose]) -> tuple[Array, Array, float]:
        """Return rotation (3, 3) and translation (3,) m of the field in the optical frame, and the misfit.

        ``poses`` of surfaces in the optical frame; the least-squares rigid motion (Kabsch 1976) of the
        points 0.1 m along the axes of each surface.
        """
        known = [name for name in self.surfaces if name in poses]
        source = np.concatenate([_frame_points(self.surfaces[name]) for name in known])
        there = np.concatenate([_frame_points(poses[name]) for name in known])
        centre, centre_there = source.mean(axis=0), there.mean(axis=0)
        u, _, vt = np.linalg.svd((there - centre_there).T @ (source - centre))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        translation = centre_there - rotation @ centre
        misfit = np.linalg.norm(source @ rotation.T + translation - there, axis=1)
        return rotation, translation, float(misfit.max())


def is_checkerboard(surface: Surface) -> bool:
    """Whether a surface is a rectangle whose texture is one black and one white tile in turn."""
    if surface.type != "rectangle" or surface.texture is None:
        return False
    values = surface.texture.values.values
    return values.shape == (2, 2) and bool(
        values[0, 0] == values[1, 1] and values[0, 1] == values[1, 0] and values[0, 0] != values[0, 1]
    )


def _corners(board: Surface) -> dict[tuple[int, int], Array]:
    """Return the corners (2,) m in the surface's frame by (row, column), those strictly within the board."""
    assert board.size is not None
    assert board.texture is not None
    width, height = board.size
    wide, high = board.texture.cell
    # a corner on the rim is none
    columns = math.ceil(width / 2 / wide - 1e-6) - 1
    rows = math.ceil(height / 2 / high - 1e-6) - 1
    return {
        (row, column): np.array([column * wide, row * high])
        for row in range(-rows, rows + 1)
        for column in range(-columns, columns + 1)
    }


def _frame_points(pose: Pose) -> Array:
    """Return the origin and points on the axes (4, 3) of a surface's frame."""
    origin = np.array(pose.position)
    return np.concatenate([origin[None], origin + _ARM * rotation_matrix(pose.orientation).T])


def _triple(values: Array) -> tuple[float, float, float]:
    return (float(values[0]), float(values[1]), float(values[2]))
