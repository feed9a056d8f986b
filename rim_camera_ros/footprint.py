"""The light that pixels gather over an area, sampled in the scene more finely than the pixels.

Only pixels beside an edge of a surface or of its brightness are sampled: elsewhere the light at the centre
stands for that of the area (what it misses is of the second order in the size of a pixel).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.scene import Geometry, Scene, first_met, rotation_matrix

Array = NDArray[Any]


@dataclass(frozen=True)
class Cells:
    """Square cells that are sampled at their centres: side [px], and number along a side (odd)."""

    side: float
    number: int

    @property
    def widest(self) -> float:
        """The largest side of a footprint [px] that they cover."""
        return self.side * self.number

    def weights(self, side: float) -> tuple[Array, Array]:
        """Return the shares of the cells along a side of a square [px], of sum 1, and their derivatives."""
        side = max(side, 1e-3)
        number = np.abs(np.arange(self.number) - self.number // 2)
        low = self.side * (number - 0.5)
        # the cell at the centre lies on both sides of it
        inside = np.where(number == 0, min(side, self.side), np.clip(side / 2 - low, 0.0, self.side))
        last = min(int(side / (2 * self.side) + 0.5), self.number // 2)
        grows = np.where(number == last, 0.5 if last else 1.0, 0.0)
        return inside / side, grows / side - inside / side**2


#: What effects are computed with, and what is enough to see whether there is something.
FINE, COARSE = Cells(0.1, 13), Cells(0.15, 5)


@dataclass(frozen=True)
class FootprintLight:
    """The light around the centres of some pixels, relative to that at the centre.

    ``pixels`` (N,) are flat indices into images of ``shape`` (H, W); ``light`` (N, K, K) complex [-], by
    ``cells`` down and across.
    """

    shape: tuple[int, int]
    pixels: Array
    light: Array
    cells: Cells
    _last: dict[str, tuple[float, Array]] = field(default_factory=dict, repr=False, compare=False)

    def ratio(self, side: float) -> Array:
        """Return the light of a square of that side [px] over the light at the centre, (H, W) complex [-]."""
        found = self._last.get("ratio")
        if found is None or found[0] != side:
            weights, _ = self.cells.weights(side)
            # a fit asks for the same again and again
            found = (side, self._laid_out((weights, weights), np.ones(self.shape, complex)))
            self._last["ratio"] = found
        return found[1]

    def ratio_column(self, side: float) -> Array:
        """Return the derivative of `ratio` by the side, (H, W) complex [1/px]."""
        weights, change = self.cells.weights(side)
        result = np.zeros(self.shape, complex)
        for pair in ((change, weights), (weights, change)):
            result += self._laid_out(pair, np.zeros(self.shape, complex))
        return result

    def _laid_out(self, weights: tuple[Array, Array], result: Array) -> Array:
        down, across = (one.astype(self.light.dtype) for one in weights)
        np.put(result, self.pixels, (self.light @ across) @ down)
        return result


def footprint_light(
    scene: Scene,
    poses: Mapping[str, Pose],
    geometry: Geometry,
    rays: Array,
    *,
    ambiguity: float,
    cells: Cells = FINE,
) -> FootprintLight:
    """Return the light around the centres of the pixels of a ``geometry``, seen through ``rays`` (H, W, 3).

    ``ambiguity`` is the ambiguity range [m].
    """
    pixels = np.flatnonzero(_beside_edges(geometry) & geometry.hit)
    steps = cells.side * (np.arange(cells.number) - cells.number // 2)
    down, across = (np.gradient(rays, axis=axis).reshape(-1, 1, 1, 3)[pixels] for axis in (0, 1))
    moved = rays.reshape(-1, 1, 1, 3)[pixels] + steps[:, None, None] * down + steps[:, None] * across
    moved /= np.sqrt(np.einsum("nijk,nijk->nij", moved, moved))[..., None]
    wave = 2 * np.pi / ambiguity

    def light(distance: Array, power: Array) -> Array:
        # where nothing is seen the power is 0
        distance = np.nan_to_num(distance, nan=1.0)
        return np.asarray(power / distance**2 * np.exp(1j * wave * distance))

    around = light(*light_seen(scene, poses, moved))
    power = (geometry.reflectivity * geometry.cos_incidence).ravel()[pixels]
    centre = light(geometry.distance.ravel()[pixels], power)
    dark = centre == 0
    relative = around / np.where(dark, 1.0, centre)[:, None, None]
    relative[dark] = 1.0
    return FootprintLight(rays.shape[:2], pixels, relative.astype(np.complex64), cells)


def _beside_edges(geometry: Geometry) -> Array:
    """Return the pixels (H, W) beside which another surface, another brightness or nothing is seen."""
    bright = np.where(geometry.hit, geometry.reflectivity, -1.0)
    result = np.zeros(geometry.surface.shape, bool)
    for image in (bright, geometry.surface):
        padded = np.pad(image, 1, mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        result |= around.min(axis=(-2, -1)) != around.max(axis=(-2, -1))
    return result


def light_seen(scene: Scene, poses: Mapping[str, Pose], rays: Array) -> tuple[Array, Array]:
    """Return distance [m] and reflectivity * cos(incidence) [-] of what rays (..., 3) meet, as `see` does.

    NaN and 0 where they meet nothing.
    """
    directions = rays.reshape(-1, 3)
    index, distance = first_met(scene, poses, directions)
    power = np.zeros(len(directions))
    for i, surface in enumerate(scene.surfaces):
        mine = np.flatnonzero(index == i)
        if not mine.size:
            continue
        own, pose = directions[mine], poses[surface.name]
        rotation, centre = rotation_matrix(pose.orientation), np.array(pose.position)
        reflectivity: Array | float = surface.reflectivity
        normal = rotation[:, 2]
        if surface.type == "sphere":
            assert surface.radius is not None
            normal = (distance[mine, None] * own - centre) / surface.radius
        if surface.texture is not None:
            local = distance[mine, None] * (own @ rotation[:, :2]) - centre @ rotation[:, :2]
            reflectivity = surface.texture.reflectivity(local[:, 0], local[:, 1])
        cosine = np.einsum("nk,nk->n", own, normal) if normal.ndim > 1 else own @ normal
        power[mine] = reflectivity * np.abs(cosine)
    return distance.reshape(rays.shape[:-1]), power.reshape(rays.shape[:-1])
