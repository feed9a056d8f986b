"""Light that reaches a point by way of the other wall: radiosity of patches with the phase of the path."""

import numpy as np
from scipy import ndimage

from .base import LeftOut
from .sensor import Array
from .tracing import hit

COLUMNS, ROWS = 20, 16
"""Patches over 1.3 times the field of view."""
STRIDE = 3
"""Pixels between the points at which the light is gathered; it is interpolated between."""


class Patches:
    """Patches of the scene as seen from the emitter of one exposure."""

    def __init__(self, effect: "Multipath", exposure: int) -> None:
        world = effect.world
        slope_x = np.linspace(-0.57, 0.57, COLUMNS)
        slope_y = np.linspace(-0.46, 0.46, ROWS)
        x, y = (array.ravel() for array in np.meshgrid(slope_x, slope_y))
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        solid_angle = (slope_x[1] - slope_x[0]) * (slope_y[1] - slope_y[0]) * rays[:, 2] ** 3
        near = np.full(len(rays), np.inf)
        self.surface = np.full(len(rays), -1)
        cosine, self.reflectivity = np.ones(len(rays)), np.zeros(len(rays))
        self.normals = np.zeros_like(rays)
        for number, surface in enumerate(world.scene.surfaces):
            pose = world.exposures.true[surface.name].take(np.array([exposure]))
            distance, cosines, u, v = (array[0] for array in hit(rays, pose, surface))
            closer = distance < near
            near[closer], cosine[closer], self.surface[closer] = distance[closer], cosines[closer], number
            self.reflectivity[closer] = surface.reflectivity_at(u[closer], v[closer])
            self.normals[closer] = -pose.rotation[0][:, 2]
        cosine = np.maximum(cosine, 0.05)
        near = np.where(np.isfinite(near), near, 1e3)
        self.points = rays * near[:, None]
        self.area = near**2 * solid_angle / cosine
        power = np.maximum(world.camera.relative_power(rays), 0.05)
        half = np.pi / world.camera.sensor.ambiguity
        self.direct = cosine * power / near**2 * np.exp(1j * half * near)


def transfer(points: Array, normals: Array, patches: Patches, wavenumber: float) -> "np.ndarray":
    """Irradiance at points from a radiosity of 1 on every patch, (points, patches), with the path's phase.

    The patch is a disc of its area, so that a point beside it gets no more than the disc sends.
    """
    way = patches.points[None] - points[:, None]
    squared = np.einsum("ijk,ijk->ij", way, way)
    length = np.sqrt(squared)
    safe = np.maximum(length, 1e-6)
    arriving = np.maximum(np.einsum("ijk,ik->ij", way, normals) / safe, 0.0)
    leaving = np.maximum(-np.einsum("ijk,jk->ij", way, patches.normals) / safe, 0.0)
    factor = arriving * leaving * patches.area / (np.pi * squared + patches.area)
    return np.asarray(factor * np.exp(1j * wavenumber * length))


class Multipath(LeftOut):
    """Diffuse light between two walls; amount [-]: on the light of one bounce."""

    name, stage, acts_on_image = "multipath", 3, True
    start, largest = 0.3, 3.0

    def draw(self, rng: np.random.Generator) -> None:
        world = self.world
        self.largest = 3.0 if self.tuning else 1.4
        self.half = np.pi / world.camera.sensor.ambiguity
        coarse = world.rays[::STRIDE, ::STRIDE]
        self._coarse_shape = coarse.shape[:2]
        rays = coarse.reshape(-1, 3)
        power = np.maximum(world.camera.relative_power(rays), 0.05)
        self._gathering: list[list[tuple[int, np.ndarray, np.ndarray]]] = []
        self._patches: list[Patches] = []
        for exposure in range(len(world.exposures)):
            patches = Patches(self, exposure)
            rows = []
            for number, surface in enumerate(world.scene.surfaces):
                pose = world.exposures.true[surface.name].take(np.array([exposure]))
                distance, cosine, _, _ = (array[0] for array in hit(rays, pose, surface))
                seen = np.isfinite(distance) & (distance < 20.0)
                near = np.where(seen, distance, 1.0)
                normal = np.repeat(-pose.rotation[0][None, :, 2], len(rays), axis=0)
                others = np.flatnonzero((patches.surface != number) & (patches.surface >= 0))
                factors = transfer(rays * near[:, None], normal, _chosen(patches, others), self.half)
                direct = np.maximum(cosine, 0.05) * power / near**2 * np.exp(1j * self.half * near)
                rows.append((number, others, np.where(seen[:, None], factors / direct[:, None], 0.0)))
            self._patches.append(patches)
            self._gathering.append(rows)
        self._exchange = [] if self.tuning else [self._between(patches) for patches in self._patches]

    def _between(self, patches: Patches) -> "np.ndarray":
        factors = transfer(patches.points, patches.normals, patches, self.half)
        same = patches.surface[:, None] == patches.surface[None, :]
        return np.where(same, 0.0, factors)

    def radiosity(self, exposure: int, amount: float) -> "np.ndarray":
        """Light leaving the patches, (patches,)."""
        patches = self._patches[exposure]
        if self.tuning:
            return np.asarray(amount * patches.reflectivity * patches.direct)
        reflectivity = np.minimum(np.sqrt(amount) * patches.reflectivity, 0.98)
        matrix = -reflectivity[:, None] * self._exchange[exposure]
        matrix[np.diag_indices(len(reflectivity))] += 1.0
        # what comes back is again a reflection: sqrt(amount) from the first wall, sqrt(amount) on the way
        return np.asarray(np.sqrt(amount) * np.linalg.solve(matrix, reflectivity * patches.direct))

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        height, width = light.shape[1:]
        v, u = np.mgrid[0:height, 0:width] / STRIDE
        total = np.zeros(light.shape, complex)
        index = self.world.geometry.surface
        for exposure, rows in enumerate(self._gathering):
            leaving = self.radiosity(exposure, amount)
            for number, others, factors in rows:
                coarse = (factors @ leaving[others]).reshape(self._coarse_shape)
                smooth = [
                    ndimage.map_coordinates(part, [v, u], order=1, mode="nearest")
                    for part in (coarse.real, coarse.imag)
                ]
                mine = index[exposure] == number
                total[exposure][mine] = (smooth[0] + 1j * smooth[1])[mine]
        return light * (1.0 + total)


def _chosen(patches: Patches, index: "np.ndarray") -> Patches:
    part = object.__new__(Patches)
    for key, value in vars(patches).items():
        setattr(part, key, value[index])
    return part


EFFECTS: tuple[type[LeftOut], ...] = (Multipath,)
