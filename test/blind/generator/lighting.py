"""Left-out effects of emitter and surfaces: how much light, and by which way, a point returns."""

import numpy as np

from .base import LeftOut
from .sensor import Array


def oren_nayar_ratio(angle: Array, variance: float) -> Array:
    """Radiance of a rough surface over that of a Lambertian one (Oren and Nayar 1994), 1 at normal incidence.

    Light and eye are in the same direction.
    """
    limited = np.minimum(angle, 1.45)
    a = 1.0 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    return np.asarray(1.0 + b / a * np.sin(limited) * np.tan(limited))


def cook_torrance_lobe(angle: Array, roughness: float) -> Array:
    """Specular over Lambertian radiance, 1 at normal incidence: GGX facets, Smith shadowing.

    Light and eye are in the same direction.
    """
    cosine = np.maximum(np.cos(angle), 0.05)
    squared = roughness**2
    distribution = (squared / (cosine**2 * (squared - 1.0) + 1.0)) ** 2
    shadowing = (2.0 * cosine / (cosine + np.sqrt(squared + (1.0 - squared) * cosine**2))) ** 2
    return np.asarray(distribution * shadowing / cosine**2)


class EmissionPattern(LeftOut):
    """Lobe of the emitter and vignetting; amount [-]: exponent of the lobe."""

    name, stage, acts_on_image = "emission_pattern", 1, True
    start, largest = 0.3, 3.0

    def draw(self, rng: np.random.Generator) -> None:
        if self.tuning:
            self.drawn = {"exponent": rng.uniform(6.0, 9.0)}
        else:
            self.drawn = {
                "half_angle": rng.uniform(0.40, 0.52),
                "tilt": rng.uniform(-0.05, 0.05, 2).tolist(),
                "height": rng.uniform(0.75, 0.95),
            }

    def power(self, amount: float) -> Array:
        """Relative power per pixel, 1 on the axis, (height, width)."""
        drawn, rays, angle = self.drawn, self.world.rays, self.world.axis_angle
        if self.tuning:
            return np.asarray(np.cos(angle) ** (drawn["exponent"] * amount))
        axis = np.array([0.0, 0.0, 1.0])

        def lobe(directions: Array) -> Array:
            x = np.arctan2(directions[..., 0], directions[..., 2]) - drawn["tilt"][0]
            y = (np.arctan2(directions[..., 1], directions[..., 2]) - drawn["tilt"][1]) / drawn["height"]
            return np.asarray((1.0 + ((x**2 + y**2) / drawn["half_angle"] ** 2) ** 2) ** -amount)

        step = np.clip(angle / 0.6, 0.0, 1.0)
        vignetting = 1.0 - 0.15 * min(amount, 1.0) * step**2 * (3.0 - 2.0 * step)
        return np.asarray(lobe(rays) / lobe(axis) * vignetting)

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        return light * self.power(amount)


class EmitterOffset(LeftOut):
    """LEDs beside the lens; amount: metres from the lens to the centre of the LEDs."""

    name, stage, acts_on_image = "emitter_offset", 2, True
    start, largest = 0.05, 0.25

    def draw(self, rng: np.random.Generator) -> None:
        direction = rng.uniform(0.0, 2.0 * np.pi)
        self.drawn = {"direction": [float(np.cos(direction)), float(np.sin(direction))]}
        if self.tuning:
            lattice = [(x, y) for x in (-0.015, 0.015) for y in (-0.012, 0.0, 0.012)]
            self.around = np.array([(x, y, 0.0) for x, y in lattice])
            power = np.ones(len(self.around))
        else:
            turn = 2.0 * np.pi * np.arange(12) / 12.0
            self.around = 0.025 * np.stack([np.cos(turn), np.sin(turn), np.zeros(12)], axis=1)
            power = 1.0 + 0.1 * rng.standard_normal(12)
        self.power = power / power.sum()
        self.drawn["power"] = self.power.tolist()

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        geometry, rays, camera = self.world.geometry, self.world.rays, self.world.camera
        near = np.where(geometry.seen, geometry.range, 1.0)
        centre = amount * np.array([*self.drawn["direction"], 0.0])
        total = np.zeros(light.shape, complex)
        own = camera.relative_power(rays)
        for position, power in zip(self.around + centre, self.power, strict=True):
            squared = near**2 - 2.0 * near * (rays @ position) + position @ position
            length = np.sqrt(squared)
            lobe = 1.0
            if not self.tuning:
                angle = np.arccos(np.clip(near * rays[..., 2] / length, -1.0, 1.0))
                lobe = camera.pattern(angle**2) / own
            total += (
                power
                * lobe
                * near**2
                / squared
                * np.exp(1j * np.pi / camera.sensor.ambiguity * (length - near))
            )
        return light * total


class Radiometry(LeftOut):
    """Surfaces that are not Lambertian; amount: variance of the slope [rad^2], or specular radiance at normal
    incidence over that of a white Lambertian surface [-].
    """

    name, stage, acts_on_image = "radiometry", 0, True
    start, largest = 0.05, 2.0

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {} if self.tuning else {"roughness": rng.uniform(0.3, 0.45)}

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        geometry = self.world.geometry
        if self.tuning:
            return light * oren_nayar_ratio(geometry.incidence, amount)
        specular = cook_torrance_lobe(geometry.incidence, self.drawn["roughness"])
        return light * (1.0 + amount * specular / np.maximum(geometry.reflectivity, 0.02))


EFFECTS: tuple[type[LeftOut], ...] = (EmissionPattern, EmitterOffset, Radiometry)
