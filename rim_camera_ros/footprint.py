"""The light that pixels collect over an area, sampled in the scene more finely than the pixels.

Only pixels next to an edge of a surface or of its brightness are sampled. Elsewhere the light at the centre
is used for the whole area, with an error of second order in the size of a pixel. Mixed pixels: Kahlmann 2007,
sec. 3.3.10, fig. 3.58.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.geometry import Geometry, beside_edges, see
from rim_camera_ros.scene import Scene

Array = NDArray[Any]


@dataclass(frozen=True)
class Cells:
    """Square cells, each sampled at one place: side [px], and number along a side (odd)."""

    side: float
    number: int

    @property
    def places(self) -> tuple[Array, Array]:
        """Return the places of the samples, (K, K) px down and across from the middle of the pixel.

        No two samples are in the same row or column (multi-jittered: Chiu et al. 1994), so that an edge along
        the rows crosses samples at as many positions as there are cells, not as there are rows of cells.
        """
        cell = np.arange(self.number) - self.number // 2
        # a step that reaches all of an odd number of cells, near the golden section
        step = next(k for k in range(round(0.382 * self.number), self.number) if np.gcd(k, self.number) == 1)
        half = self.number // 2
        within = ((step * cell + half) % self.number - half) / self.number
        return (
            self.side * (cell[:, None] + within[None, :]),
            self.side * (cell[None, :] + within[:, None]),
        )

    @property
    def widest(self) -> float:
        """The largest side of a footprint [px] that the cells cover."""
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


#: Cells for the computation of effects, and coarse ones that suffice to see whether there is any effect.
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
            # cached, as a fit requests the same again and again
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
        down, across = (weight.astype(self.light.dtype) for weight in weights)
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
    where: NDArray[np.bool_] | bool = True,
) -> FootprintLight:
    """Return the light around the centres of the pixels of a ``geometry``, seen through ``rays`` (H, W, 3).

    ``ambiguity`` is the ambiguity range [m]. Pixels not ``where`` (H, W) see the same all around.
    """
    pixels = np.flatnonzero(beside_edges(geometry, 1) & geometry.hit & where)
    down, across = (np.gradient(rays, axis=axis).reshape(-1, 1, 1, 3)[pixels] for axis in (0, 1))
    rows, columns = (place[..., None] for place in cells.places)
    moved = rays.reshape(-1, 1, 1, 3)[pixels] + rows * down + columns * across
    moved /= np.sqrt(np.einsum("nijk,nijk->nij", moved, moved))[..., None]
    shape = moved.shape[:3]
    seen = see(scene, poses, moved.reshape(shape[0], shape[1] * shape[2], 3))
    around = _light(seen, ambiguity).reshape(shape)
    centre = _light(geometry, ambiguity).ravel()[pixels]
    dark = centre == 0
    relative = around / np.where(dark, 1.0, centre)[:, None, None]
    relative[dark] = 1.0
    return FootprintLight(rays.shape[:2], pixels, relative.astype(np.complex64), cells)


def _light(seen: Geometry, ambiguity: float) -> Array:
    """Return reflectivity cos(incidence) / d^2 exp(i 2 pi d / L), complex [1/m^2]; 0 for nothing."""
    distance = np.where(seen.hit, seen.distance, 1.0)
    power = np.where(seen.hit, seen.reflectivity * seen.cos_incidence, 0.0)
    return np.asarray(power / distance**2 * np.exp(2j * np.pi / ambiguity * distance))
