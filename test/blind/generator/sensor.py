"""The array: size, lens, rays through (parts of) pixels, ambiguity interval."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SPEED_OF_LIGHT = 299792458.0
MODULATION_FREQUENCY = 20e6
PLUMB_BOB = (-0.12, 0.05, 0.0008, -0.0006, 0.0)
FULL_SIZE = (176, 144)
FULL_FOCAL_LENGTH = 199.8875
FULL_PRINCIPAL_POINT = (89.9925, 82.3925)
FULL_PITCH = 40e-6


@dataclass(frozen=True)
class Sensor:
    """A SR-3000 binned to `width` x `height` pixels."""

    width: int = 88
    height: int = 72

    @property
    def ambiguity(self) -> float:
        """L = c / (2 f), metres."""
        return SPEED_OF_LIGHT / (2.0 * MODULATION_FREQUENCY)

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """(fx, fy), px."""
        return (
            FULL_FOCAL_LENGTH * self.width / FULL_SIZE[0],
            FULL_FOCAL_LENGTH * self.height / FULL_SIZE[1],
        )

    @property
    def principal_point(self) -> tuple[float, float]:
        """(cx, cy), px; integer coordinates are pixel centres, so binning shifts them by half a pixel."""
        x, y = FULL_PRINCIPAL_POINT
        return (
            (x + 0.5) * self.width / FULL_SIZE[0] - 0.5,
            (y + 0.5) * self.height / FULL_SIZE[1] - 0.5,
        )

    @property
    def pitch(self) -> tuple[float, float]:
        """Pixel pitch, metres."""
        return FULL_PITCH * FULL_SIZE[0] / self.width, FULL_PITCH * FULL_SIZE[1] / self.height

    def grid(self) -> tuple[Array, Array]:
        """Column u and row v of every pixel, each (height, width)."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(float)
        return u, v

    def rays(self) -> Array:
        """Unit vectors through the pixel centres, (height, width, 3)."""
        return self.rays_through(*self.grid())

    def fine_rays(self, *, factor: int, margin: int) -> Array:
        """Unit vectors through a grid `factor` times finer with `margin` px more on every side."""
        offsets = (np.arange(factor) - (factor - 1) / 2.0) / factor
        u = (np.arange(-margin, self.width + margin)[:, None] + offsets).ravel()
        v = (np.arange(-margin, self.height + margin)[:, None] + offsets).ravel()
        return self.rays_through(*np.meshgrid(u, v))

    def rays_through(self, u: Array, v: Array) -> Array:
        """Unit vectors through image points; plumb_bob is inverted by fixed-point iteration."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.principal_point
        k1, k2, p1, p2, k3 = PLUMB_BOB
        x_distorted, y_distorted = (u - cx) / fx, (v - cy) / fy
        x, y = x_distorted, y_distorted
        for _ in range(30):
            q = x * x + y * y
            radial = 1.0 + q * (k1 + q * (k2 + q * k3))
            x, y = (
                (x_distorted - 2.0 * p1 * x * y - p2 * (q + 2.0 * x * x)) / radial,
                (y_distorted - p1 * (q + 2.0 * y * y) - 2.0 * p2 * x * y) / radial,
            )
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def axis_angle_squared(rays: Array) -> Array:
    """Square of the angle from the optical axis, rad^2."""
    return np.arccos(np.clip(rays[..., 2], -1.0, 1.0)) ** 2
