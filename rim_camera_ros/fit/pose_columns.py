"""Derivatives of distances and light by errors of the poses of surfaces.

The plane n . (d r) = n . p gives dd = n . dp / (n . r) for a shift, and (w x n) . (p - X) / (n . r) for a
small rotation w about p.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import ScenePose, Surface

Array = NDArray[Any]

#: Axes of the optical frame that a free surface turns about.
OPTICAL_AXES = {"roll": (0.0, 0.0, 1.0), "pitch": (1.0, 0.0, 0.0), "yaw": (0.0, 1.0, 0.0)}
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class PoseColumn:
    """Derivative of the distance by one error of one pose.

    ``path`` names it: ``pose.SURFACE.offset|tilt_x|tilt_y`` with the 1-sigma ``prior`` of the reference
    instrument, or ``scene.SURFACE.AXIS`` of a free pose. ``distance`` (H, W) in m per m or per rad;
    ``amplitude`` (H, W) the relative change of the light, by the distance and by the angle of incidence.
    ``is_smooth``: it is smooth over the array, so that optics which spread light do not change it.
    """

    path: str
    prior: float
    distance: Array
    amplitude: Array
    is_smooth: bool = False


def truth_columns(
    surface: Surface, pose: Pose, geometry: Geometry, mine: Array, rays: Array
) -> list[PoseColumn]:
    """Return the errors of a recorded pose, made independent of each other: C = L D L', L of unit diagonal.

    A column is the change of distances by its error and by the parts of later errors that correlate with it.
    """
    met = _Met.of(geometry, mine, rays)
    rotation = rotation_matrix(pose.orientation)
    names, changes = ["offset"], [met.shifted(rotation[:, 2])]
    if surface.type != "sphere":
        names += ["tilt_x", "tilt_y"]
        changes += [met.turned(axis, pose) for axis in (rotation[:, 0], rotation[:, 1])]
    rest = surface.pose_covariance(pose)[: len(names), : len(names)].copy()
    result = []
    for k, name in enumerate(names):
        variance = float(rest[k, k])
        if variance <= 0:
            continue
        share = rest[:, k] / variance
        rest -= np.outer(share, share) * variance
        column = met.image(sum((factor * change for factor, change in zip(share, changes, strict=True))))
        result.append(PoseColumn(f"pose.{surface.name}.{name}", float(np.sqrt(variance)), *column))
    return result


def free_columns(
    surface: Surface, pose: Pose, geometry: Geometry, mine: Array, rays: Array
) -> list[PoseColumn]:
    """Return the changes by a free pose of the scene file: shifts along the axes, and turns about them."""
    assert isinstance(surface.pose, ScenePose)
    met, result = _Met.of(geometry, mine, rays), []
    for name in surface.pose.free:
        path = f"scene.{surface.name}.{name}"
        if name in _AXES:
            result.append(PoseColumn(path, 1.0, *met.image(met.shifted(np.array(_AXES[name])))))
        else:
            turned = met.turned(np.array(OPTICAL_AXES[name]), pose)
            result.append(PoseColumn(path, 0.3, *met.image(turned)))
    return result


def by_shift(direction: Array, geometry: Geometry, mine: Array, rays: Array) -> tuple[Array, Array]:
    """Return the changes of distance and (relative) light by a shift; a plane's incidence does not change.

    ``direction`` (3,) or (N, 3) is that of each of the N pixels of ``mine`` (H, W); ``rays`` (H, W, 3).
    """
    met = _Met.of(geometry, mine, rays)
    return met.image(met.shifted(direction))


@dataclass(frozen=True)
class _Met:
    """What the rays of some pixels ``mine`` (H, W) meet: (N, 3), and distances (N,)."""

    mine: Array
    rays: Array
    normals: Array
    points: Array
    distance: Array
    along: Array

    @classmethod
    def of(cls, geometry: Geometry, mine: Array, rays: Array) -> _Met:
        own = rays[mine]
        normals = geometry.normals[mine]
        along = np.einsum("nk,nk->n", normals, own)
        return cls(mine, own, normals, geometry.points[mine], geometry.distance[mine], along)

    def image(self, changes: Array) -> tuple[Array, Array]:
        """Return images (H, W) of changes (2, N), 0 in all other pixels."""
        column, light = np.zeros((2, *self.mine.shape))
        column[self.mine], light[self.mine] = changes
        return column, light

    def shifted(self, direction: Array) -> Array:
        """Return the changes (2, N) of distance and relative light by a shift."""
        column = np.sum(self.normals * direction, axis=-1) / self.along
        return np.stack([column, -2 * column / self.distance])

    def turned(self, axis: Array, pose: Pose) -> Array:
        """Return the changes (2, N) of distance and relative light by a small rotation about a pose."""
        arm = np.array(pose.position) - self.points
        turned = np.cross(axis, self.normals)
        column = np.einsum("nk,nk->n", turned, arm) / self.along
        by_angle = np.einsum("nk,nk->n", turned, self.rays) / self.along
        return np.stack([column, by_angle - 2 * column / self.distance])
