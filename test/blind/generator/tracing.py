"""Surfaces and what a bundle of rays sees of them, for all exposures at once."""

from dataclasses import dataclass, field

import numpy as np

from .sensor import Array


@dataclass
class Surface:
    """A plane or rectangle: the x-y plane of its own frame, front side towards -z."""

    name: str
    reflectivity: float
    size: tuple[float, float] | None = None
    cell: tuple[float, float] = (1.0, 1.0)
    tiles: Array | None = None
    pose_sigma: tuple[float, float] = (0.001, 0.0006)

    def reflectivity_at(self, x: Array, y: Array) -> Array:
        """Diffuse reflectivity at points of the surface frame."""
        if self.tiles is None:
            return np.full(np.shape(x), self.reflectivity)
        column = np.floor(x / self.cell[0]).astype(np.int64) % self.tiles.shape[1]
        row = np.floor(y / self.cell[1]).astype(np.int64) % self.tiles.shape[0]
        return np.asarray(self.tiles[row, column])


@dataclass
class Poses:
    """Poses of one surface in the camera frame: positions (n, 3), rotations (n, 3, 3)."""

    position: Array
    rotation: Array

    def take(self, index: "np.ndarray") -> "Poses":
        """The poses of a choice of exposures."""
        return Poses(self.position[index], self.rotation[index])


@dataclass
class Geometry:
    """What is seen; arrays are (exposures, *shape of the ray bundle)."""

    range: Array
    cosine: Array
    reflectivity: Array
    surface: "np.ndarray" = field(repr=False)

    @property
    def incidence(self) -> Array:
        """Angle of incidence, rad."""
        return np.asarray(np.arccos(np.clip(self.cosine, 0.0, 1.0)))

    @property
    def seen(self) -> "np.ndarray":
        """True where the ray meets a surface."""
        return np.asarray(self.surface >= 0)


def hit(rays: Array, poses: Poses, surface: Surface) -> tuple[Array, Array, Array, Array]:
    """Range (inf where missed), |cosine of incidence|, x and y on the surface; each (n, rays).

    `rays` is (rays, 3), unit vectors from the origin.
    """
    x_axis, y_axis, z_axis = (poses.rotation[:, :, k] for k in range(3))
    along = z_axis @ rays.T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("nk,nk->n", z_axis, poses.position)[:, None] / along
        x = distance * (x_axis @ rays.T) - np.einsum("nk,nk->n", x_axis, poses.position)[:, None]
        y = distance * (y_axis @ rays.T) - np.einsum("nk,nk->n", y_axis, poses.position)[:, None]
    met = np.isfinite(distance) & (distance > 0.0)
    if surface.size is not None:
        met &= (np.abs(x) <= surface.size[0] / 2.0) & (np.abs(y) <= surface.size[1] / 2.0)
    return np.where(met, distance, np.inf), np.abs(along), x, y


def trace(rays: Array, surfaces: list[Surface], poses: dict[str, Poses]) -> Geometry:
    """The nearest surface along every ray, for every exposure."""
    shape, flat = rays.shape[:-1], rays.reshape(-1, 3)
    count = len(next(iter(poses.values())).position)
    nearest = np.full((count, len(flat)), np.inf)
    cosine, reflectivity = np.zeros_like(nearest), np.zeros_like(nearest)
    index = np.full(nearest.shape, -1, np.int8)
    for number, surface in enumerate(surfaces):
        distance, cosines, x, y = hit(flat, poses[surface.name], surface)
        closer = distance < nearest
        if not closer.any():
            continue
        nearest[closer], cosine[closer], index[closer] = distance[closer], cosines[closer], number
        reflectivity[closer] = surface.reflectivity_at(x[closer], y[closer])
    return Geometry(
        *(array.reshape(count, *shape) for array in (nearest, cosine, reflectivity)),
        surface=index.reshape(count, *shape),
    )


def moved(poses: dict[str, Poses], *, linear: Array, angular: Array, seconds: float) -> dict[str, Poses]:
    """The poses in the frame of a camera that has moved with a constant twist in its own frame."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(-angular * seconds).as_matrix()
    return {
        name: Poses((pose.position - linear * seconds) @ turn.T, turn @ pose.rotation)
        for name, pose in poses.items()
    }
