"""Target fields that a scene file describes: discs, and corners and circles in textures of rectangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose
from rim_camera_ros.photogrammetry.targets import Target, TargetField
from rim_camera_ros.photogrammetry.texture_targets import targets_of
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene

Array = NDArray[np.float64]

#: Points of a surface's frame by which its pose is compared, m.
_ARM = 0.1


@dataclass(frozen=True)
class FieldOnSurfaces:
    """A target field whose targets lie on surfaces of a scene.

    ``surfaces``: poses of the surfaces in the field's frame, which is the frame of the first surface.
    ``of``: the surface of each target; ``edges``: for corners the vectors [m] to the next corners along both
    edges (2, 3), in the field's frame.
    """

    field: TargetField
    surfaces: Mapping[str, Pose]
    of: Mapping[str, str]
    edges: Mapping[str, Array]

    @classmethod
    def from_scene(cls, scene: Scene, truth: Mapping[str, Pose]) -> FieldOnSurfaces:
        """Return the field of a scene's discs (circles) and checkerboards (textured rectangles).

        A disc's id is its surface's name; a corner's is ``board/row/column``, rows and columns of the
        texture's grid, 0 at the board's centre. Relative poses of the surfaces are those of the scene file,
        or for surfaces with ``pose: truth`` those in ``truth``. Raises `InputError` without a target.
        """
        boards = {
            surface.name: found for surface in scene.surfaces if (found := targets_of(surface)) is not None
        }
        carriers = [surface for surface in scene.surfaces if surface.type == "disc" or surface.name in boards]
        if not carriers:
            raise InputError(
                "the scene has no targets",
                place="surfaces",
                remedy="describe the target field by surfaces of type disc (circles) "
                "or a rectangle with the texture of a board, such as rim board writes it",
            )
        poses = scene.poses_for(truth)
        first = poses[carriers[0].name]
        back = rotation_matrix(first.orientation).T
        targets: dict[str, Target] = {}
        surfaces: dict[str, Pose] = {}
        of: dict[str, str] = {}
        edges: dict[str, Array] = {}
        for carrier in carriers:
            pose = poses[carrier.name]
            turn = back @ rotation_matrix(pose.orientation)
            origin = back @ (np.array(pose.position) - np.array(first.position))
            surfaces[carrier.name] = Pose(_triple(origin), quaternion(turn))
            if carrier.type == "disc":
                assert carrier.radius is not None
                targets[carrier.name] = Target(_triple(origin), carrier.radius, _triple(turn[:, 2]))
                of[carrier.name] = carrier.name
                continue
            board = boards[carrier.name]
            for (row, column), local in board.crossings.items():
                name = f"{carrier.name}/{row}/{column}"
                targets[name] = Target(_triple(origin + turn[:, :2] @ local))
                of[name] = carrier.name
                edges[name] = (turn[:, :2] * board.arms[row, column]).T
            for (row, column), (x, y, radius) in board.circles.items():
                name = f"{carrier.name}/{row}/{column}"
                centre = origin + turn[:, :2] @ np.array([x, y])
                targets[name] = Target(_triple(centre), radius, _triple(turn[:, 2]))
                of[name] = carrier.name
        return cls(TargetField(targets), surfaces, of, edges)

    def pose(self, poses: Mapping[str, Pose]) -> tuple[Array, Array, float]:
        """Return rotation (3, 3) and translation (3,) m of the field in the optical frame, and the misfit.

        ``poses``: those of the surfaces in the optical frame. The result is the least-squares rigid motion
        (Kabsch 1976) of the origin and of points 0.1 m along the axes of each surface.
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


def _frame_points(pose: Pose) -> Array:
    """Return the origin and points on the axes (4, 3) of a surface's frame."""
    origin = np.array(pose.position)
    return np.concatenate([origin[None], origin + _ARM * rotation_matrix(pose.orientation).T])


def _triple(values: Array) -> tuple[float, float, float]:
    return (float(values[0]), float(values[1]), float(values[2]))
