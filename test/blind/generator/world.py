"""One recording in the making: camera, scene, geometry, and the chain from light to noise-free images."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .base import LeftOut, State
from .known import Camera
from .scenes import Exposures, Scene
from .sensor import Array, axis_angle_squared
from .tracing import Geometry, Poses, trace

Hidden = list[tuple[LeftOut, float]]
"""Left-out effects with their amounts, in the order in which they act."""


@dataclass(frozen=True)
class World:
    """What really is there, and what the camera knows of itself."""

    camera: Camera
    scene: Scene

    @property
    def exposures(self) -> Exposures:
        """The exposures of the scene."""
        return self.scene.exposures

    @cached_property
    def rays(self) -> Array:
        """Unit vectors through the pixels, (height, width, 3)."""
        return self.camera.sensor.rays()

    @cached_property
    def axis_angle(self) -> Array:
        """Angle of the pixels' rays from the optical axis, rad, (height, width)."""
        return np.sqrt(axis_angle_squared(self.rays))

    @cached_property
    def geometry(self) -> Geometry:
        """What the pixels truly see."""
        return trace(self.rays, self.scene.surfaces, self.exposures.true)

    @cached_property
    def told(self) -> Geometry:
        """What they see according to the reference poses."""
        return trace(self.rays, self.scene.surfaces, self.exposures.told)

    @cached_property
    def light(self) -> Array:
        """The complex image without any left-out effect, (n, height, width)."""
        return self.light_of(self.rays, self.geometry)

    def light_at(self, rays: Array, poses: dict[str, Poses]) -> Array:
        """The complex image along other rays or at other poses."""
        return self.light_of(rays, trace(rays, self.scene.surfaces, poses))

    def light_of(self, rays: Array, seen: Geometry, *, power: Array | None = None) -> Array:
        """The complex image of what is seen: counts, phase 2 pi r / L."""
        power = self.exposures.power if power is None else power
        brightness = (self.camera.gain * power * self.exposures.integration_time)[:, None, None]
        near = np.where(seen.seen, seen.range, 1.0)
        modulus = brightness * seen.reflectivity * seen.cosine * self.camera.relative_power(rays) / near**2
        modulus = np.where(seen.seen, modulus, 0.0)
        return np.asarray(modulus * np.exp(2j * np.pi / self.camera.sensor.ambiguity * near))

    def with_exposures(self, exposures: Exposures) -> "World":
        """The same with other exposures."""
        return World(self.camera, replace(self.scene, exposures=exposures))

    def image(self, hidden: Hidden) -> State:
        """Noise-free state: distance [m] and amplitude [counts] before the terms in metres."""
        light = self.light
        for effect, amount in hidden:
            light = effect.image(light, amount)
        direct = np.where(self.geometry.seen, self.geometry.range, 0.0)
        interval = self.camera.sensor.ambiguity
        if hidden and any(effect.acts_on_image for effect, _ in hidden):
            turn = np.angle(light * np.exp(-2j * np.pi / interval * direct))
            distance = np.where(self.geometry.seen, direct + turn * interval / (2.0 * np.pi), 0.0)
        else:
            distance = direct
        return State(distance=distance, amplitude=np.where(self.geometry.seen, np.abs(light), 0.0))

    def measure(self, hidden: Hidden) -> "Measured":
        """Noise-free measured distance and published amplitude with everything in it."""
        state = self.image(hidden)
        settings = self.exposures.integration_time
        distance = state.distance + self.camera.metres(
            state.distance, state.amplitude, self.geometry.incidence, settings
        )
        published, variance = state.amplitude, np.zeros_like(distance)
        for effect, amount in hidden:
            distance = distance + effect.metres(state, amount)
            published = effect.published(published, amount)
            variance = variance + effect.extra_variance(state, amount)
        valid = self.geometry.seen & self.camera.measurable(state.amplitude, settings)
        valid &= (published >= self.camera.threshold) & (published < self.camera.saturation)
        return Measured(distance, state.amplitude, published, variance, valid)


@dataclass
class Measured:
    """Noise-free images (n, height, width): metres, counts, counts, m^2, and where something is published."""

    distance: Array
    amplitude: Array
    published: Array
    extra_variance: Array
    valid: "np.ndarray"
