"""Rays, surfaces, and the sampling of a pixel's area and of the lens' point-spread function."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import erf

#: Directions from a pixel are sampled so often for finding edges: every third of a pixel.
_FINE = 3
#: Reach of the search for edges around a pixel centre, in thirds of a pixel, of an ordinary spot.
_REACH = 2


@dataclass(frozen=True)
class Lens:
    """Intrinsics: focal lengths and principal point in pixels, distortion k1 k2 p1 p2 k3."""

    fx: float
    fy: float
    cx: float
    cy: float
    d: tuple[float, ...]

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates of ideal normalised coordinates (Brown 1971)."""
        k1, k2, p1, p2, k3 = self.d
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        along_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        along_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return self.fx * along_x + self.cx, self.fy * along_y + self.cy

    def directions(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Unit rays (..., 3) through pixel coordinates: the distortion inverted by Newton steps."""
        goal_x, goal_y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        unit = replace(self, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
        x, y, step = goal_x.copy(), goal_y.copy(), 1e-5
        for _ in range(6):
            at_x, at_y = unit.project(x, y)
            right_x, right_y = unit.project(x + step, y)
            down_x, down_y = unit.project(x, y + step)
            a, b = (right_x - at_x) / step, (down_x - at_x) / step
            c, e = (right_y - at_y) / step, (down_y - at_y) / step
            off_x, off_y, det = goal_x - at_x, goal_y - at_y, a * e - b * c
            x = x + (e * off_x - b * off_y) / det
            y = y + (a * off_y - c * off_x) / det
        ray = np.stack([x, y, np.ones_like(x)], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Surface:
    """A surface of a scene: its shape in its own frame and the reflectivities of its tiles.

    `size` holds full width and height of a rectangle [m], `radius` that of a sphere; `values` (rows,
    columns) repeat, one per cell of `cell` (width, height) [m].
    """

    name: str
    kind: str
    values: np.ndarray
    cell: tuple[float, float] = (1.0, 1.0)
    size: tuple[float, float] | None = None
    radius: float = 0.0


@dataclass(frozen=True)
class Placement:
    """Where a surface is: position (3,) and rotation (3, 3) of its frame in the optical frame."""

    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Hits:
    """What rays meet, per ray: distance [m] (inf: nothing), surface (-1: nothing), cosine, tile, lobe."""

    distance: np.ndarray
    surface: np.ndarray
    cosine: np.ndarray
    tile: np.ndarray
    normal: np.ndarray


def trace(rays: np.ndarray, surfaces: list[Surface], places: dict[str, Placement]) -> Hits:
    """Nearest surface along each of `rays` (N, 3)."""
    count = len(rays)
    found = Hits(
        np.full(count, np.inf), np.full(count, -1), np.ones(count), np.zeros(count, int), np.zeros((count, 3))
    )
    for number, surface in enumerate(surfaces):
        place = places[surface.name]
        if surface.kind == "sphere":
            _meet_sphere(rays, surface, place, number, found)
        else:
            _meet_plane(rays, surface, place, number, found)
    return found


def _meet_plane(rays: np.ndarray, surface: Surface, place: Placement, number: int, found: Hits) -> None:
    normal = place.rotation[:, 2]
    along = rays @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (place.position @ normal) / along
    near = (length > 1e-6) & (length < found.distance)
    index = np.flatnonzero(near)
    local = (rays[index] * length[index, None] - place.position) @ place.rotation[:, :2]
    if surface.size is not None:
        inside = (np.abs(local) <= np.array(surface.size) / 2).all(axis=1)
        index, local = index[inside], local[inside]
    rows, columns = surface.values.shape
    j = np.floor(local[:, 0] / surface.cell[0]).astype(int) % columns
    i = np.floor(local[:, 1] / surface.cell[1]).astype(int) % rows
    found.distance[index] = length[index]
    found.surface[index] = number
    found.cosine[index] = np.abs(along[index])
    found.tile[index] = i * columns + j
    found.normal[index] = -np.sign(along[index])[:, None] * normal


def _meet_sphere(rays: np.ndarray, surface: Surface, place: Placement, number: int, found: Hits) -> None:
    along = rays @ place.position
    squared = along**2 - place.position @ place.position + surface.radius**2
    length = along - np.sqrt(np.maximum(squared, 0.0))
    index = np.flatnonzero((squared > 0) & (length > 1e-6) & (length < found.distance))
    normal = (rays[index] * length[index, None] - place.position) / surface.radius
    found.distance[index] = length[index]
    found.surface[index] = number
    found.cosine[index] = np.abs(np.einsum("ij,ij->i", normal, rays[index]))
    found.tile[index] = 0
    found.normal[index] = normal


@dataclass(frozen=True)
class Spot:
    """How a pixel gathers light: a square of `side` px, blurred by a Gaussian of `lens` px.

    A lens out of focus adds a disc of radius `disc` px.
    """

    side: float
    lens: float
    disc: float = 0.0

    @property
    def blur(self) -> float:
        """Standard deviation along an axis [px]."""
        return float(np.sqrt(self.side**2 / 12 + self.lens**2 + self.disc**2 / 4))

    def offsets(self, count: int = 8) -> np.ndarray:
        """Offsets (count^2, 2) in pixels of rays of equal weight.

        Without a disc: midpoints of equal shares of the square convolved with the Gaussian, along each axis,
        scaled so that their variance is the spot's. With one: a Fibonacci spiral over the disc, each of
        its points moved by one of those offsets.
        """
        axis = self._axis(count)
        x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
        if self.disc > 0:
            turn = np.arange(count**2) + 0.5
            radius = self.disc * np.sqrt(turn / count**2)
            angle = turn * np.pi * (3 - np.sqrt(5))
            order = np.random.default_rng(7).permutation(count**2)
            x, y = x[order] + radius * np.cos(angle), y[order] + radius * np.sin(angle)
            x, y = ((one - one.mean()) * self.blur / one.std() for one in (x, y))
        return np.stack([x, y], axis=1)

    def _axis(self, count: int) -> np.ndarray:
        grid = np.linspace(-2.5, 2.5, 5001) * max(self.side, self.lens)
        share = (np.arange(count) + 0.5) / count
        found = np.interp(share, self.coverage(grid), grid)
        return found * np.sqrt((self.side**2 / 12 + self.lens**2) / np.mean(found**2))

    def coverage(self, edge: np.ndarray) -> np.ndarray:
        """Share of the light from before a straight edge at `edge` px along an axis (without the disc)."""
        half, s = self.side / 2, self.lens * np.sqrt(2)

        def integral(x: np.ndarray) -> np.ndarray:
            return x * erf(x / s) + s / np.sqrt(np.pi) * np.exp(-((x / s) ** 2))

        return 0.5 + (integral(edge + half) - integral(edge - half)) / (4 * half)


def mixed(
    lens: Lens,
    shape: tuple[int, int],
    surfaces: list[Surface],
    places: dict[str, Placement],
    *,
    reach: int = _REACH,
) -> np.ndarray:
    """Pixels (height, width) within `reach` thirds of a pixel of whose centre anything changes."""
    height, width = shape
    fine = (np.arange(-1, _FINE * max(shape) + 1) - 1) / _FINE
    u, v = np.meshgrid(fine[: _FINE * width + 2], fine[: _FINE * height + 2])
    hits = trace(lens.directions(u.ravel(), v.ravel()), surfaces, places)
    kind = (hits.surface * 1000 + hits.tile).reshape(u.shape)
    spread = maximum_filter(kind, 2 * reach + 1) != minimum_filter(kind, 2 * reach + 1)
    return spread[2::_FINE, 2::_FINE][:height, :width]


def turn(axis: np.ndarray | tuple[float, ...], angle: float) -> np.ndarray:
    """Rotation matrix about an axis by an angle [rad] (Rodrigues)."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Unit quaternion x y z w of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(x), float(y), float(z), float(w)
