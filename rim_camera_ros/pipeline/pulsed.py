"""Simulation of cameras whose light comes in pulses: the light of a pixel over the time since the pulse.

The effects of the optics act on the complex image of light at one modulation frequency. Light that arrives
at several times is described by its Fourier series over the period of the pulses, and each of its harmonics
k f is such an image. The same effects, computed for every harmonic, thus give the light of a pixel over time,
with all returns by surfaces, bounces and stray light.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.signal import Signal
from rim_camera_ros.pipeline.simulate import Exposure, Simulation

Array = NDArray[Any]

#: Frequency for the sum of the light, as a share of the pulse rate: its phase over a period is negligible.
_SUM = 1e-6


@dataclass(frozen=True)
class _Kept:
    """The harmonics of a scene at rest, and what they were computed from."""

    distance: Array
    amplitude: Array
    harmonics: Array


@dataclass
class PulsedSimulation(Simulation):
    """A camera with pulses at the sensor's modulation frequency; subclasses define what is measured."""

    _at: dict[int, Simulation] = field(default_factory=dict, repr=False)
    _spectrum: _Kept | None = field(default=None, repr=False)

    def arrivals(self, signal: Signal, exposure: Exposure, *, harmonics: int) -> Array:
        """Return the Fourier series (harmonics + 1, H, W) of the light over the time of its arrival, complex.

        In counts of the amplitude, for exp(+ i 2 pi k t f); index 0 is the sum of the light. The terms [m] of
        ``signal`` delay all light of a pixel alike; where they are NaN the result is NaN.
        """
        kept = self._spectrum
        if (
            kept is None
            or len(kept.harmonics) != harmonics + 1
            or not np.array_equal(kept.distance, signal.distance, equal_nan=True)
            or not np.array_equal(kept.amplitude, signal.amplitude)
        ):
            light = np.stack([self._harmonic(k).light(exposure).conj() for k in range(harmonics + 1)])
            kept = self._spectrum = _Kept(signal.distance, signal.amplitude, light)
        turns = np.asarray(signal.offset, float) / self.camera.sensor.ambiguity
        if not np.any(turns):
            return kept.harmonics
        step = np.broadcast_to(np.exp(-2j * np.pi * turns), self.camera.shape)
        result = kept.harmonics.copy()
        delay = np.ones_like(step)
        for one in result[1:]:
            delay = delay * step
            one *= delay
        result[0] += 0.0 * turns
        return result

    def _harmonic(self, k: int) -> Simulation:
        """Return the simulation of the same camera with light modulated at k times the pulse rate."""
        if k not in self._at:
            own = self.camera.sensor
            sensor = replace(own, modulation_frequency=own.modulation_frequency * (k or _SUM))
            simulation = Simulation(
                replace(self.camera, sensor=sensor), self.scene, seed=self.seed, noise=False
            )
            # the pixels see the same surfaces
            simulation._seen = self._seen
            self._at[k] = simulation
        return self._at[k]
