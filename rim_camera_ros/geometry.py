"""What each pixel of a camera sees of a scene: the nearest surface that its ray meets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Geometry:
    """What each pixel sees (all (H, W) or (H, W, 3)); NaN and surface -1 where a ray meets nothing.

    ``distance`` [m] from the projection centre along the ray, ``points`` [m], ``normals`` (towards the
    camera), ``cos_incidence`` = |ray . normal|, ``reflectivity``, ``surface`` index; ``tile`` numbers the
    tiles of all surfaces, those of the first surface first (-1: nothing). ``scene`` and ``poses``: those that
    the rays meet; None where these are not known.
    """

    surface: NDArray[np.int16]
    distance: Array
    points: Array
    normals: Array
    cos_incidence: Array
    reflectivity: Array
    tile: NDArray[np.int32]
    scene: Scene | None = None
    poses: Mapping[str, Pose] | None = None

    def along(self, rays: Array) -> Geometry | None:
        """Return the geometry for other rays (H, W, 3) from the same place; None if the scene is unknown."""
        if self.scene is None or self.poses is None:
            return None
        return see(self.scene, self.poses, rays)

    @property
    def hit(self) -> NDArray[np.bool_]:
        return self.surface >= 0

    @property
    def incidence(self) -> Array:
        """Angle between ray and normal in rad."""
        result: Array = np.arccos(np.clip(self.cos_incidence, 0.0, 1.0))
        return result


def see(scene: Scene, poses: Mapping[str, Pose], rays: Array) -> Geometry:
    """Return the geometry that rays (H, W, 3) from the origin meet: the nearest surface at positive length.

    Surfaces without a pose in ``poses`` are ignored.
    """
    shape = rays.shape[:2]
    directions = rays.reshape(-1, 3)
    index, distance = _first_met(scene, poses, directions)
    points = distance[:, None] * directions
    normals = np.full_like(points, np.nan)
    reflectivity = np.full(len(directions), np.nan)
    tile = np.full(len(directions), -1, np.int32)
    first = 0
    for i, surface in enumerate(scene.surfaces):
        start, first = first, first + surface.tiles
        mine = index == i
        if not mine.any():
            continue
        pose = poses[surface.name]
        rotation = rotation_matrix(pose.orientation)
        local = (points[mine] - np.array(pose.position)) @ rotation
        if surface.type == "sphere":
            assert surface.radius is not None
            normals[mine] = (points[mine] - np.array(pose.position)) / surface.radius
        else:
            normals[mine] = rotation[:, 2]
        if surface.texture is None:
            reflectivity[mine] = surface.nominal_reflectivity
            tile[mine] = start
        else:
            number = surface.texture.tile(local[:, 0], local[:, 1])
            reflectivity[mine] = surface.texture.values.values.ravel()[number]
            tile[mine] = start + number
    along = np.sum(directions * normals, axis=-1)
    normals = np.where(along[:, None] > 0, -normals, normals)
    return Geometry(
        surface=index.reshape(shape),
        distance=distance.reshape(shape),
        points=points.reshape(*shape, 3),
        normals=normals.reshape(*shape, 3),
        cos_incidence=np.abs(along).reshape(shape),
        reflectivity=reflectivity.reshape(shape),
        tile=tile.reshape(shape),
        scene=scene,
        poses=poses,
    )


def beside_edges(geometry: Geometry, margin: int) -> NDArray[np.bool_]:
    """Return the pixels (H, W) within ``margin`` [px] of another surface, another brightness, or nothing."""
    from scipy.ndimage import maximum_filter, minimum_filter  # here, as it slows nodes' start

    size = 2 * margin + 1
    bright = np.where(geometry.hit, geometry.reflectivity, -1.0)
    surface = geometry.surface
    same = minimum_filter(bright, size) == maximum_filter(bright, size)
    same &= minimum_filter(surface, size) == maximum_filter(surface, size)
    return np.asarray(~same)


def surface_seen(scene: Scene, poses: Mapping[str, Pose], rays: Array) -> NDArray[np.int16]:
    """Return the index of the surface that each of the rays (..., 3) meets, as `see` does."""
    return _first_met(scene, poses, rays.reshape(-1, 3))[0].reshape(rays.shape[:-1])


def _first_met(scene: Scene, poses: Mapping[str, Pose], directions: Array) -> tuple[NDArray[np.int16], Array]:
    """Return index and distance of the nearest surface along each ray (N, 3), -1 where there is none."""
    origin = np.zeros(3)
    nearest = np.full(len(directions), np.inf)
    index = np.full(len(directions), -1, np.int16)
    for i, surface in enumerate(scene.surfaces):
        if surface.name not in poses:
            continue
        length = surface.lengths(poses[surface.name], origin, directions)
        closer = length < nearest
        nearest[closer] = length[closer]
        index[closer] = i
    return index, np.where(index >= 0, nearest, np.nan)
