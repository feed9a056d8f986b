"""Left-out effects on the complex image: stray light, extended pixels, movement, a second camera."""

import numpy as np
from scipy import fft, ndimage

from .base import LeftOut
from .sensor import Array
from .tracing import moved, trace

FINE, MARGIN = 3, 2


class Scattering(LeftOut):
    """Stray light between lens, filter and chip; amount: share of the light [-]."""

    name, stage, acts_on_image = "scattering", 5, True
    start, largest = 0.02, 0.6

    def draw(self, rng: np.random.Generator) -> None:
        size = self.world.camera.sensor.width / 88.0
        if self.tuning:
            self.drawn = {"length": rng.uniform(6.0, 16.0) * size, "aspect": rng.uniform(0.75, 1.3)}
        else:
            self.drawn = {
                "radius": rng.uniform(4.0, 12.0) * size,
                "power": 1.4,
                "aspect": rng.uniform(0.75, 1.3),
                "ghost": rng.uniform(0.1, 0.33),
                "ghost_blur": rng.uniform(1.0, 2.5) * size,
            }
        self._stray: np.ndarray | None = None

    def kernel(self) -> Array:
        """Kernel of sum 1 over all pairs of pixels, (2 height - 1, 2 width - 1)."""
        sensor, drawn = self.world.camera.sensor, self.drawn
        v, u = np.mgrid[1 - sensor.height : sensor.height, 1 - sensor.width : sensor.width].astype(float)
        radius = np.hypot(u / drawn["aspect"], v * drawn["aspect"])
        if self.tuning:
            kernel = np.exp(-radius / drawn["length"])
        else:
            kernel = (1.0 + (radius / drawn["radius"]) ** 2) ** -drawn["power"]
        return np.asarray(kernel / kernel.sum())

    def stray(self, light: "np.ndarray") -> "np.ndarray":
        """The stray light if all light strayed, (n, height, width)."""
        sensor = self.world.camera.sensor
        shape = [fft.next_fast_len(3 * n - 2) for n in (sensor.height, sensor.width)]
        transfer = fft.fft2(self.kernel().astype(np.float32), shape)
        stray = np.empty(light.shape, complex)
        for k, image in enumerate(light):
            folded = fft.ifft2(fft.fft2(image.astype(np.complex64), shape) * transfer)
            stray[k] = folded[
                sensor.height - 1 : 2 * sensor.height - 1, sensor.width - 1 : 2 * sensor.width - 1
            ]
        if not self.tuning:
            stray = (1.0 - self.drawn["ghost"]) * stray + self.drawn["ghost"] * self._ghost(light)
        return stray

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        if self._stray is None or light is not self._source:
            self._source, self._stray = light, self.stray(light)
        return (1.0 - amount) * light + amount * self._stray

    def _ghost(self, light: "np.ndarray") -> "np.ndarray":
        """Image mirrored through the optical axis and blurred."""
        cx, cy = self.world.camera.sensor.principal_point
        u, v = self.world.camera.sensor.grid()
        row, column = np.rint(2.0 * cy - v).astype(int), np.rint(2.0 * cx - u).astype(int)
        inside = (row >= 0) & (row < u.shape[0]) & (column >= 0) & (column < u.shape[1])
        mirrored = light[:, np.where(inside, row, 0), np.where(inside, column, 0)] * inside
        blur = (0.0, self.drawn["ghost_blur"], self.drawn["ghost_blur"])
        real, imaginary = (
            ndimage.gaussian_filter(
                np.ascontiguousarray(part, np.float32), blur, mode="constant", truncate=3.0
            )
            for part in (mirrored.real, mirrored.imag)
        )
        return np.asarray(real + 1j * imaginary)


class MixedPixels(LeftOut):
    """Pixels with an extent; amount: width [px], below 1 the share of light spread over one."""

    name, stage, acts_on_image = "mixed_pixels", 4, True
    start, largest = 0.5, 5.0

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"soft": 0.12} if self.tuning else {"disc": rng.uniform(0.4, 0.6)}
        self._spectrum: np.ndarray | None = None

    def kernel(self, amount: float) -> Array:
        """Weights on the fine grid, of sum 1 and odd shape."""
        reach = int(np.ceil(FINE * (max(amount, 1.0) / 2.0 + 0.5)))
        offset = np.arange(-reach, reach + 1) / FINE
        if self.tuning:
            line = 1.0 / (1.0 + np.exp((np.abs(offset) - max(amount, 1.0) / 2.0) / self.drawn["soft"]))
            spread = np.outer(line, line)
        else:
            radius = self.drawn["disc"] * amount
            distance = np.hypot(*np.meshgrid(offset, offset))
            disc = np.clip((radius - distance) * FINE + 0.5, 0.0, 1.0)
            disc[reach, reach] = max(disc[reach, reach], 1e-6)
            spread = ndimage.uniform_filter(disc, FINE, mode="constant")
        spread /= spread.sum()
        share = min(amount, 1.0)
        point = np.zeros_like(spread)
        point[reach, reach] = 1.0
        return np.asarray((1.0 - share) * point + share * spread)

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        world = self.world
        if self._spectrum is None:
            rays = world.camera.sensor.fine_rays(factor=FINE, margin=MARGIN)
            fine = world.light_at(rays, world.exposures.true).astype(np.complex64)
            self._shape = tuple(fft.next_fast_len(n + 6 * FINE) for n in fine.shape[1:])
            self._spectrum = fft.fft2(fine, self._shape)
        kernel = self.kernel(amount)
        reach = kernel.shape[0] // 2
        folded = fft.ifft2(self._spectrum * fft.fft2(kernel.astype(np.float32), self._shape))
        first = reach + MARGIN * FINE + FINE // 2
        height, width = light.shape[1:]
        spread = folded[:, first : first + FINE * height : FINE, first : first + FINE * width : FINE]
        # what other effects did to the centre of the pixel holds for all of it
        with np.errstate(divide="ignore", invalid="ignore"):
            others = np.where(np.abs(world.light) > 0.0, light / world.light, 1.0)
        return np.asarray(spread * others, complex)


class Motion(LeftOut):
    """Four samples one after the other while the camera moves; amount: seconds between samples."""

    name, stage, acts_on_image = "motion", 3, True
    start, largest = 0.002, 0.02

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"intensity": 0.0 if self.tuning else rng.uniform(1.3, 2.0)}

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        world = self.world
        if world.exposures.twist is None:
            return light
        linear, angular = world.exposures.twist
        total = np.zeros(light.shape, complex)
        for k in range(4):
            poses = moved(world.exposures.true, linear=linear, angular=angular, seconds=(k - 1.5) * amount)
            sample = world.light_of(world.rays, trace(world.rays, world.scene.surfaces, poses))
            total += 0.5 * 1j**k * ((sample * (-1j) ** k).real + self.drawn["intensity"] * np.abs(sample))
        return total


class Interference(LeftOut):
    """A second camera at nearly the same frequency; amount: counts of its phasor."""

    name, stage, acts_on_image, per_frame = "interference", 6, True, True
    start = 5.0

    def draw(self, rng: np.random.Generator) -> None:
        world = self.world
        self.drawn = {"beat": rng.uniform(0.1, 0.5)}
        phase = rng.uniform(0.0, 2.0 * np.pi, len(world.exposures))[:, None, None]
        modulus = np.ones((1, 1, 1))
        if not self.tuning:
            other = np.array([rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.8), rng.uniform(-0.2, 0.2), 0.0])
            self.drawn["second_camera"] = other.tolist()
            geometry = world.geometry
            near = np.where(geometry.seen, geometry.range, 1.0)
            path = np.sqrt(near**2 - 2.0 * near * (world.rays @ other) + other @ other)
            lobe = (near * world.rays[..., 2] / path) ** 4
            settings = self.exposure(world.exposures.integration_time) / 100.0
            modulus = geometry.reflectivity * geometry.cosine * lobe / path**2 * settings
            modulus = modulus / np.median(modulus[geometry.seen])
            phase = phase + np.pi / world.camera.sensor.ambiguity * (near + path)
        taps = phase + self.drawn["beat"] * np.arange(4)[:, None, None, None]
        quarter = (np.pi / 2.0 * np.arange(4))[:, None, None, None]
        weights = (0.5 * 1j ** np.arange(4))[:, None, None, None]
        self.phasor = modulus * np.sum(weights * np.cos(taps - quarter), axis=0)

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        return light + amount * self.phasor * self.world.geometry.seen


EFFECTS: tuple[type[LeftOut], ...] = (Scattering, MixedPixels, Motion, Interference)
