"""The geometry that each station's pixels see, which pixels are clean, and derivatives by errors of poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.signal import Window
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.pose_columns import PoseColumn, free_columns, truth_columns
from rim_camera_ros.footprint import Cells, FootprintLight, footprint_light
from rim_camera_ros.frame import Pose
from rim_camera_ros.geometry import Geometry, see, surface_seen
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene, ScenePose, Surface

Array = NDArray[Any]


class Margins(NamedTuple):
    """How near to the outline of a surface, and to the edge of a tile, rays may pass [px]."""

    outline: float
    tile: float


#: Share of the array up to which a window is computed alone. Its images are put back, so that a hundredth of
#: 176 x 144 pixels still takes 1.8 ms where all of them take 5.5 (no effects); derivatives are not put back.
LARGEST_WINDOW = 0.5
#: Pixels whose rays pass nearer are excluded: a pixel has an area, and a lens spreads its light.
CLEAN = Margins(1.1, 1.1)
#: ... while rays are fitted: pixels that stay clean where rays move by about a pixel.
WIDE = Margins(2.2, 2.2)
#: ... of surfaces and tiles so small that an edge reaches every pixel.
SMALL = Margins(0.4, 0.3)
#: ... where pixels beside edges are included: as far as errors of poses move edges.
NEAR = Margins(0.25, 0.12)
#: ... and for effects that show in pixels which an edge crosses: such pixels are included as well.
CROSSED = Margins(0.1, 0.05)

#: Errors of predicted amplitudes are alike within a tile over this share of the array's width.
PATCH = 0.1

#: Geometries are kept up to this many bytes; beyond, they are computed again in each pass.
_KEPT_BYTES = 400_000_000
#: Bytes that a pixel of a view takes, by the arrays of its geometry and of the errors of a pose.
_PIXEL_BYTES = 140


@dataclass(frozen=True)
class View:
    """Geometry of a station and the pixels (H, W) whose ray stays away from outlines and tile edges.

    ``memory`` keeps results of effects for this geometry. ``whole`` is the view of the whole array of which
    this is a ``window`` (None: this is). No pixel is clean outside of the rows and columns that were
    ``measured`` (None: all).
    """

    geometry: Geometry
    clean: NDArray[np.bool_]
    poses: Mapping[str, Pose]
    pose_columns: list[PoseColumn] = field(default_factory=list)
    memory: dict[str, Any] = field(default_factory=dict)
    whole: View | None = None
    window: Window | None = None
    measured: tuple[Array, Array] | None = None

    @property
    def where_measured(self) -> NDArray[np.bool_]:
        """The pixels of the whole array, (H, W) or (1, 1) for all, in the rows and columns measured."""
        return np.ones((1, 1), bool) if self.measured is None else np.logical_and.outer(*self.measured)


class Views:
    """The views of a scene's stations through one camera geometry; the latest are kept.

    The camera has every ``decimation``-th pixel of the sensor; margins are in pixels of the sensor.
    ``alike`` are views of the same surfaces with other reflectivities of their tiles.
    """

    def __init__(
        self, camera: Camera, scene: Scene, *, decimation: int = 1, alike: Views | None = None
    ) -> None:
        self.camera, self.scene, self._decimation = camera, scene, decimation
        self._alike = alike
        height, width = camera.shape
        self._most = max(4, _KEPT_BYTES // (height * width * _PIXEL_BYTES))
        self._kept: dict[Any, View] = {}
        self._around: dict[float, list[Array]] = {}

    def fits(self, camera: Camera, scene: Scene) -> bool:
        """Return whether these views hold for a camera and a scene: same rays, same surfaces."""
        same_rays = camera.optics == self.camera.optics and camera.shape == self.camera.shape
        return same_rays and scene.surfaces == self.scene.surfaces

    def of_scene(self, camera: Camera, scene: Scene) -> Views | None:
        """Return these views, or views for other reflectivities; None where rays or surfaces differ."""
        if self.fits(camera, scene):
            return self
        same_rays = self.fits(camera, self.scene)
        if not same_rays or _unpainted(self.scene) != _unpainted(scene):
            return None
        return Views(self.camera, scene, decimation=self._decimation, alike=self)

    def view(self, station: Station, measured: tuple[Array, Array] | None = None) -> View:
        """Return what a station's pixels see. Raises `InputError` for a missing pose.

        Where only few rows and columns were ``measured`` (as `Dataset.measured`), no others are clean or
        have derivatives by the poses.
        """
        poses = self.scene.poses_for(station.truth)
        where = None
        if measured is not None and measured[0].mean() * measured[1].mean() <= LARGEST_WINDOW:
            where = tuple(side.tobytes() for side in measured)
        key = (*(poses.get(surface.name) for surface in self.scene.surfaces), where)
        found = self._kept.get(key)
        if found is None:
            found = (
                self._seen(poses, measured if where else None)
                if self._alike is None
                else _repainted(self._alike.view(station, measured), self.scene)
            )
            if len(self._kept) >= self._most:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = found
        return found

    def _seen(self, poses: Mapping[str, Pose], measured: tuple[Array, Array] | None) -> View:
        geometry = see(self.scene, poses, self.camera.rays)
        found = View(geometry, geometry.hit, poses, measured=measured)
        clean = self._clean(found, CLEAN)
        if not clean.any():
            # of surfaces so small that edges reach all pixels, those that they reach least
            clean = self._clean(found, SMALL)
        found = replace(found, clean=clean)
        found.pose_columns.extend(self._pose_columns(found))
        return found

    def clean(self, view: View, margins: Margins) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of a view that are clean by other margins."""
        if view.whole is not None:
            return self.clean(view.whole, margins)[view.window]
        return self._clean(view, margins)

    def patches(self, view: View) -> NDArray[np.int64]:
        """Return the numbers of patches (H, W): pixels of one tile and of one part of the array."""
        if view.whole is not None:
            return self.patches(view.whole)[view.window]
        found = view.memory.get("patches")
        if found is None:
            height, width = self.camera.shape
            side = max(PATCH * width, 1.0)
            rows, columns = (np.arange(n) // side for n in (height, width))
            patch = (rows[:, None] * width + columns[None, :]).astype(np.int64)
            patch = patch + height * width * view.geometry.tile.astype(np.int64)
            found = np.unique(patch, return_inverse=True)[1].reshape(height, width)
            view.memory["patches"] = found
        return np.asarray(found, np.int64)

    def alike(self, view: View) -> Array:
        """Return how many clean pixels (H, W) are in the patch of each pixel."""
        if view.whole is not None:
            return self.alike(view.whole)[view.window]
        found = view.memory.get("alike")
        if found is None:
            group = self.patches(view)
            found = np.maximum(np.bincount(group[view.clean], minlength=int(group.max()) + 1)[group], 1)
            view.memory["alike"] = found
        return np.asarray(found)

    def footprint(self, view: View, cells: Cells, *, ambiguity: float) -> FootprintLight:
        """Return the light around the centres of a view's pixels, for an ambiguity range [m]; it is kept."""
        found: FootprintLight | None = view.memory.get(f"footprint {cells.number}")
        if found is None:
            found = footprint_light(
                self.scene,
                view.poses,
                view.geometry,
                self.camera.rays,
                ambiguity=ambiguity,
                cells=cells,
                where=view.where_measured,
            )
            view.memory[f"footprint {cells.number}"] = found
        return found

    def _rays_around(self, margin: float) -> list[Array]:
        if margin not in self._around:
            self._around[margin] = _rays_around(self.camera.rays, margin / self._decimation)
        return self._around[margin]

    def _clean(self, view: View, margins: Margins) -> NDArray[np.bool_]:
        geometry, poses = view.geometry, view.poses
        clean = geometry.hit & view.where_measured
        if min(margins) > self._decimation:
            # corners may lie between the rays around a pixel, and between tiles of one reflectivity
            clean &= _alone(geometry.tile)
        surfaces = self.scene.surfaces
        there = [plane for plane in surfaces if plane.name in poses]
        if len(there) > 1 or there[0].type != "plane":
            pixels = np.flatnonzero(clean)
            for rays in self._rays_around(margins.outline):
                seen = surface_seen(self.scene, poses, rays.reshape(-1, 3)[pixels])
                pixels = pixels[seen == geometry.surface.ravel()[pixels]]
            clean = _pixels(pixels, clean.shape)
        first = 0
        for i, surface in enumerate(surfaces):
            start, first = first, first + surface.tiles
            texture = surface.texture
            if texture is None or surface not in there:
                continue
            pose = poses[surfaces[i].name]
            rotation = rotation_matrix(pose.orientation)
            mine = clean & (geometry.surface == i)
            pixels = np.flatnonzero(mine)
            for rays in self._rays_around(margins.tile):
                own = rays.reshape(-1, 3)[pixels]
                length = surfaces[i].lengths(pose, np.zeros(3), own)
                met = np.isfinite(length)
                local = (np.where(met, length, 0.0)[:, None] * own - np.array(pose.position)) @ rotation
                local = np.nan_to_num(local)  # beside pixels that have no ray
                same = start + texture.tile(local[:, 0], local[:, 1]) == geometry.tile.ravel()[pixels]
                pixels = pixels[same | ~met]
            clean = np.where(mine, _pixels(pixels, clean.shape), clean)
        return clean

    def _pose_columns(self, view: View) -> list[PoseColumn]:
        """Return how errors of the poses change the distance of a view, surface by surface."""
        result: list[PoseColumn] = []
        for i, surface in enumerate(self.scene.surfaces):
            mine = (view.geometry.surface == i) & view.where_measured
            if not mine.any():
                continue
            if surface.pose == "truth":
                result += truth_columns(
                    surface, view.poses[surface.name], view.geometry, mine, self.camera.rays
                )
            elif isinstance(surface.pose, ScenePose) and surface.pose.free:
                result += free_columns(
                    surface, view.poses[surface.name], view.geometry, mine, self.camera.rays
                )
        return result


def _unpainted(scene: Scene) -> tuple[Surface, ...]:
    """Return the surfaces with equal reflectivities of all tiles, which stay where they are."""
    return tuple(
        replace(surface, reflectivity_sigma=0.0)
        if surface.texture is None
        else replace(
            surface,
            reflectivity_sigma=0.0,
            texture=replace(surface.texture, values=NestedList(np.ones(surface.texture.values.values.shape))),
        )
        for surface in scene.surfaces
    )


def _repainted(view: View, scene: Scene) -> View:
    """Return a view with the reflectivities of a scene's tiles."""
    tiles = [
        [surface.nominal_reflectivity] if surface.texture is None else surface.texture.values.values.ravel()
        for surface in scene.surfaces
    ]
    values = np.concatenate([*tiles, [np.nan]])  # the last is for rays that meet nothing
    geometry = replace(view.geometry, reflectivity=values[view.geometry.tile])
    return replace(view, geometry=geometry, memory={})


def _alone(tile: Array) -> NDArray[np.bool_]:
    """Return the pixels (H, W) all of whose neighbours see the same tile."""
    from scipy.ndimage import maximum_filter, minimum_filter

    return np.asarray(minimum_filter(tile, 3) == maximum_filter(tile, 3))


def _pixels(pixels: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the image (H, W) of some pixels (N,), flat."""
    result = np.zeros(shape, bool)
    result.ravel()[pixels] = True
    return result


def _rays_around(rays: Array, margin: float) -> list[Array]:
    """Return the rays ``margin`` pixels to the eight sides, by linear interpolation."""
    result = []
    down = np.gradient(rays, axis=0)
    across = np.gradient(rays, axis=1)
    for dv, du in ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, -1), (0, 1), (-1, 0), (1, 0)):
        moved = rays + margin * (dv * down + du * across)
        result.append(moved / np.linalg.norm(moved, axis=-1, keepdims=True))
    return result
