"""Four taps in electrons: demodulation, noise, and the noise model that a camera file may state of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import nnls

SPEED_OF_LIGHT = 299_792_458.0
#: Amplitudes [counts] at which the noise is measured, and repetitions at each.
_AMPLITUDES = np.geomspace(60.0, 6000.0, 10)
_REPETITIONS = 60_000


@dataclass(frozen=True)
class Sensor:
    """What turns light into counts.

    `electrons` of amplitude of one tap per count of published amplitude; `contrast` of the modulation,
    so that a tap collects amplitude / contrast on average; `dark` electrons of a tap that no light of the
    camera makes; `read` noise [electrons]; `step` of the analogue-to-digital converter [electrons];
    `jitter` of the whole phasor [rad, and relative amplitude]; `third`, `fifth` harmonic relative to the
    first.
    """

    frequency: float = 20e6
    electrons: float = 26.0
    contrast: float = 0.8
    dark: float = 400.0
    read: float = 55.0
    step: float = 12.0
    jitter: float = 0.0008
    third: complex = 0j
    fifth: complex = 0j

    @property
    def ambiguity(self) -> float:
        """Length of a period [m]."""
        return SPEED_OF_LIGHT / (2 * self.frequency)

    def demodulate(
        self,
        harmonics: tuple[np.ndarray, np.ndarray, np.ndarray],
        power: np.ndarray,
        rng: np.random.Generator | None,
        *,
        unmodulated: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """Measured phasor in counts of the phasors of 1st, 3rd, 5th harmonic [counts].

        `power` is the sum of the moduli [counts], `unmodulated` light beside it [counts]; without `rng`
        nothing is drawn. The leading axis of `harmonics` may hold one image per tap.
        """
        first, third, fifth = harmonics
        waves = first, self.third * third, self.fifth * fifth
        taps = []
        for k in range(4):
            mean = (power + unmodulated) / self.contrast + sum(
                np.real(wave * (-1j) ** (order * k)) for order, wave in zip((1, 3, 5), waves, strict=True)
            )
            taps.append(self.collect(mean * self.electrons + self.dark, rng))
        found = ((taps[0] - taps[2]) + 1j * (taps[1] - taps[3])) / (2 * self.electrons)
        if rng is not None and self.jitter:
            shake = rng.normal(size=found.shape) + 1j * rng.normal(size=found.shape)
            found = found * (1 + self.jitter * shake)
        return found

    def collect(self, mean: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """Electrons of a tap as they are digitised, of its expectation [electrons]."""
        if rng is None:
            return mean
        noisy = rng.poisson(np.maximum(mean, 0.0)) + rng.normal(0.0, self.read, np.shape(mean))
        return np.round(noisy / self.step) * self.step

    def cyclic(self) -> dict[int, tuple[float, float]]:
        """Amplitude [m] and phase [rad] of the cyclic error by order (4, 8) that the harmonics make."""
        angle = np.arange(4096) * 2 * np.pi / 4096
        wave = np.exp(1j * angle)
        measured = wave + np.conj(self.third * wave**3) + self.fifth * wave**5
        error = np.angle(measured * np.conj(wave)) * self.ambiguity / (2 * np.pi)
        spectrum = np.fft.rfft(error) / len(angle) * 2
        return {
            order: (float(abs(spectrum[order])), float(np.angle(spectrum[order]) + np.pi / 2))
            for order in (4, 8)
        }

    def measured_noise(
        self, amplitude: float, *, seed: int, repetitions: int = _REPETITIONS
    ) -> tuple[float, float]:
        """Standard deviations of distance [m] and amplitude [counts] at an amplitude, drawn.

        Phases are spread evenly, so that neither is that of one tap.
        """
        rng = np.random.default_rng([seed, int(amplitude)])
        phase = rng.uniform(0, 2 * np.pi, repetitions)
        wave = np.exp(1j * phase)
        clean = amplitude * wave, amplitude * wave**3, amplitude * wave**5
        power = np.full(repetitions, amplitude)
        off = self.demodulate(clean, power, rng) / self.demodulate(clean, power, None)
        return (
            float(np.std(np.angle(off)) * self.ambiguity / (2 * np.pi)),
            float(np.std(np.abs(off)) * amplitude),
        )

    def noise_model(self) -> dict[str, float]:
        """Floor, shot, amplitude of a camera file, fitted to drawn noise.

        Harmonics are left out: they change neither the light of the four taps together nor, to first order,
        the noise.
        """
        return dict(_fitted(replace(self, third=0j, fifth=0j)))


@lru_cache(maxsize=64)
def _fitted(sensor: Sensor) -> tuple[tuple[str, float], ...]:
    variance = np.array([sensor.measured_noise(a, seed=1)[0] ** 2 for a in _AMPLITUDES])
    model = np.stack([np.ones_like(_AMPLITUDES), 1 / _AMPLITUDES, 1 / _AMPLITUDES**2], axis=1)
    found, _ = nnls(model / variance[:, None], np.ones_like(variance))
    floor, shot, amplitude = np.sqrt(found)
    return ("floor", float(floor)), ("shot", float(shot)), ("amplitude", float(amplitude))


def sigma(noise: dict[str, float], amplitude: np.ndarray) -> np.ndarray:
    """Standard deviation of a distance [m] after `formats.md`, section 2."""
    a = np.maximum(amplitude, 1e-9)
    return np.sqrt(noise["floor"] ** 2 + noise["shot"] ** 2 / a + (noise["amplitude"] / a) ** 2)
