"""From noise-free images to the counts of the recording."""

import numpy as np

from .scenes import Exposures
from .sensor import Array, Sensor
from .world import Hidden, World

WHITE_PATTERN, SMOOTH_PATTERN = 0.0015, 0.0025


def fixed_pattern(sensor: Sensor, rng: np.random.Generator) -> Array:
    """Offset per pixel, metres: white plus five cosines of at most one period over the array."""
    u, v = sensor.grid()
    smooth = np.zeros(u.shape)
    for _ in range(5):
        kx, ky = rng.uniform(-1.0, 1.0, 2)
        smooth += rng.standard_normal() * np.cos(
            2.0 * np.pi * (kx * u / sensor.width + ky * v / sensor.height) + rng.uniform(0.0, 2.0 * np.pi)
        )
    smooth -= smooth.mean()
    return np.asarray(SMOOTH_PATTERN * smooth / smooth.std() + WHITE_PATTERN * rng.standard_normal(u.shape))


def record(world: World, hidden: Hidden, rng: np.random.Generator) -> tuple["np.ndarray", "np.ndarray"]:
    """Distance and amplitude counts, each (exposures, frames, height, width) uint16."""
    camera, exposures = world.camera, world.exposures
    interval = camera.sensor.ambiguity
    measured = world.measure(hidden)
    mean = measured.distance + fixed_pattern(camera.sensor, rng)
    amplitude = np.maximum(measured.amplitude, 1e-3)
    sigma = np.sqrt(camera.sigma(amplitude) ** 2 + measured.extra_variance)
    measurable = world.geometry.seen & camera.measurable(measured.amplitude, exposures.integration_time)
    shape = (mean.shape[0], exposures.frames, *mean.shape[1:])
    distances, amplitudes = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    for frame in range(exposures.frames):
        noisy = mean + sigma * rng.standard_normal(mean.shape)
        for effect, amount in hidden:
            noisy = effect.convert(noisy, amount)
        counts = np.mod(np.rint(noisy / interval * 65536.0), 65536.0)
        counts = np.where(counts < 1.0, 1.0, counts)
        brightness = measured.published + 2.0 * np.pi / interval * amplitude * sigma * rng.standard_normal(
            mean.shape
        )
        brightness = np.rint(np.clip(brightness, 0.0, camera.saturation))
        delivered = measurable & (brightness >= camera.threshold)
        distances[:, frame] = np.where(delivered, counts, 0.0).astype(np.uint16)
        amplitudes[:, frame] = np.where(delivered, brightness, 0.0).astype(np.uint16)
    return distances, amplitudes


def frame_times(exposures: Exposures) -> Array:
    """Uptime of every frame, (exposures, frames), seconds."""
    from .scenes import FRAME_RATE

    return np.asarray(exposures.uptime[:, None] + np.arange(exposures.frames) / FRAME_RATE)
