"""Light of a second camera (Kahlmann 2007, eq. 2.11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import ComplexEffect, Undo
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import selectivity_envelope


@dataclass(frozen=True)
class Interference(ComplexEffect):
    """A phasor of ``amplitude`` times the envelope of eq. 2.11 is added to S, of one random phase a frame."""

    name = "interference"
    title = "second camera"
    observable = "repeated frames of a fixed scene with dark surfaces: the noise is common to all pixels"
    refuted_by = "noise that is independent between pixels"
    undo: ClassVar[Undo] = "none"
    demodulates = True

    shows_in = "frames"
    estimated = "elsewhere"
    estimated_elsewhere = (
        "changes from frame to frame, so that means do not show it: switch the second camera off"
    )
    predictable = False
    shows_on_a_wall = False

    frequency: float = quantity("Hz", "modulation frequency of the other camera", above=0.0)
    amplitude: float = quantity(
        "counts", "its amplitude in each pixel, unsuppressed", minimum=0.0, typical=100.0
    )

    def suppressed(self, context: Context) -> float:
        """Return the amplitude in counts that is left after the frequency selectivity."""
        sensor = context.camera.sensor
        own = context.settings.modulation_frequency or sensor.modulation_frequency
        window = sensor.exposure_seconds(context.integration_time)
        return self.amplitude * selectivity_envelope(frequency_difference=self.frequency - own, window=window)

    def scatter(self, amplitude: Image, context: Context) -> Image:
        """Return the standard deviation of single distances in m that it makes at amplitudes in counts."""
        phase = self.suppressed(context) / (np.sqrt(2) * np.maximum(amplitude, 1e-9))
        return np.asarray(phase * context.ambiguity / (2 * np.pi))

    def apply(self, phasor: Image, context: Context) -> Image:
        phase = context.rng.uniform(0.0, 2 * np.pi)
        result: Image = phasor + self.suppressed(context) * np.exp(1j * phase)
        return result

    def sentence(self) -> str:
        return (
            f"interference: a second camera at {self.frequency / 1e6:.4g} MHz adds {self.amplitude:.3g} "
            "counts (before the frequency selectivity) of a phase that changes from frame to frame"
        )

    @classmethod
    def example(cls, camera: Camera) -> Interference:
        return cls(frequency=camera.sensor.modulation_frequency + 13.7e3, amplitude=150.0)
