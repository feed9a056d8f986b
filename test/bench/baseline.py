"""What the hot paths compute, written as one would first write it in numpy: float64, formula by formula.

They are kept to be compared with: each gives what the package gives (`test.test_bench` and the
benchmark itself check it), so that the ratio of their times says what tables and buffers are worth.
"""

from __future__ import annotations

import struct
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.scattering import Scattering

Array = NDArray[np.float64]

#: The implicit equation of the cyclic error counts as solved from this change in metres on.
SOLVED = 1e-6


def cloud(camera: Camera, integration_time: float, minimum: float, raw: Any, amplitude: Any) -> Array:
    """Return the organised cloud (H, W, 4) of a camera with cyclic, per-pixel and amplitude terms."""
    metres = raw * camera.sensor.lsb
    metres[raw == 0] = np.nan
    counts = amplitude.astype(float)
    invalid = (counts < minimum) | (counts >= camera.sensor.saturation)

    term = camera.effects["amplitude_offset"]
    assert isinstance(term, AmplitudeOffset)
    row = term.hyperbola[integration_time]
    with np.errstate(divide="ignore"):
        metres = metres - row.a / (counts - row.b)
    metres = metres - camera.effects["fixed_pattern_offset"].map.values

    cyclic = camera.effects["cyclic_error"]
    assert isinstance(cyclic, CyclicError)
    v, u = np.mgrid[: camera.shape[0], : camera.shape[1]]
    shift = cyclic.gradient[0] * (u - camera.optics.cx) + cyclic.gradient[1] * (v - camera.optics.cy)
    wave = 2 * np.pi / camera.sensor.ambiguity
    distance = metres
    while True:
        error = np.zeros_like(metres)
        for one in cyclic.harmonics:
            error += one.amplitude * np.sin(one.order * wave * distance + one.phase + shift)
        following = metres - error
        change = np.nanmax(np.abs(following - distance))
        distance = following
        if change < SOLVED:
            break
    distance = distance % camera.sensor.ambiguity
    distance[invalid] = np.nan
    points = camera.rays * distance[..., None]
    return np.concatenate([points, counts[..., None]], axis=-1)


class FourierDivision:
    """Stray light of Gaussian kernels, forward and undone in the Fourier domain, padded by zeros.

    Division takes the light that fell beside the sensor for measured zeros. It is what one writes first,
    and is what the package computes where no light reaches the sensor's edge.
    """

    def __init__(self, camera: Camera, pad: int = 2) -> None:
        effect = camera.effects["scattering"]
        assert isinstance(effect, Scattering)
        self.shape = camera.shape
        self.ambiguity = camera.sensor.ambiguity
        self.padded = (camera.shape[0] * pad, camera.shape[1] * pad)
        self.transfer = np.full(self.padded, 1.0 - effect.total_weight)
        for kernel in effect.kernels:
            profiles = []
            for size, sigma in ((self.padded[0], kernel.sigma[1]), (self.padded[1], kernel.sigma[0])):
                away = np.minimum(np.arange(size), size - np.arange(size))
                profile = np.exp(-0.5 * (away / sigma) ** 2)
                profiles.append(np.fft.fft(profile / profile.sum()).real)
            self.transfer += kernel.weight * np.outer(*profiles)

    def spread(self, image: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the complex image (H, W) with stray light."""
        return self._filtered(image, self.transfer)

    def _filtered(self, image: NDArray[np.complex128], transfer: Array) -> NDArray[np.complex128]:
        spectrum = np.fft.fft2(image, self.padded)
        result: NDArray[np.complex128] = np.fft.ifft2(spectrum * transfer)[: self.shape[0], : self.shape[1]]
        return result

    def undo(self, distance: Array, amplitude: Array) -> tuple[Array, Array]:
        """Return distance [m] and amplitude without stray light for delivered ones (H, W)."""
        image = amplitude * np.exp(2j * np.pi / self.ambiguity * distance)
        direct = self._filtered(image, 1.0 / self.transfer)
        phase = np.angle(direct) % (2 * np.pi)
        return phase * (self.ambiguity / (2 * np.pi)), np.abs(direct)


def demodulate(samples: Array) -> tuple[Array, Array, Array]:
    """Return phase, amplitude and offset of four samples (4, H, W), eqs. 2.5-2.7."""
    phase = np.arctan2(samples[1] - samples[3], samples[0] - samples[2]) % (2 * np.pi)
    amplitude = np.hypot(samples[1] - samples[3], samples[0] - samples[2]) / 2
    return phase, amplitude, samples.mean(axis=0)


def message_bytes(points: NDArray[np.float32]) -> array[int]:
    """Return the bytes of a cloud as the field of a message takes them."""
    return array("B", list(points.tobytes()))


def decode(data: bytes, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """Return a 16-bit image from its little-endian bytes."""
    return np.array(struct.unpack(f"<{shape[0] * shape[1]}H", data), np.uint16).reshape(shape)
