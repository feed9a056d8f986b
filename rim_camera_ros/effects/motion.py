"""Motion while the four samples are taken one after the other (Kahlmann 2007, sec. 2.3.1, 1-tap)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import (
    Column,
    Context,
    Effect,
    Image,
    Signal,
    Undo,
    from_phasor,
    phasor_derivative,
)
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor


@dataclass(frozen=True)
class Motion(Effect):
    """Sample k (0..3) is taken at stamp + (k - 1.5) * sample_interval.

    Samples are c_k = Re(S(t_k) exp(-i k pi / 2)) without the unmodulated offset, which these cameras
    subtract; what the earlier effects made of S is carried along as a factor per pixel.
    """

    name = "motion"
    title = "motion between the four samples"
    observable = "a moving camera (camera_motion) before edges or oblique surfaces"
    refuted_by = "errors that stay when the camera rests"
    undo: ClassVar[Undo] = "none"

    sample_interval: float = quantity("s", "time between two samples", minimum=0.0, typical=0.005)

    def _sampled(self, signal: Signal, context: Context, interval: float) -> Image:
        if context.geometry_at is None:
            raise InputError("motion needs the scene's geometry", remedy="simulate a scene file")
        here = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        geometry, amplitude = context.geometry_at(0.0)
        ideal = to_phasor(geometry.distance, amplitude, context.ambiguity)
        factor = np.divide(here, ideal, out=np.ones_like(here), where=ideal != 0)
        parts = []
        for k in range(4):
            geometry, amplitude = context.geometry_at((k - 1.5) * interval)
            moved = factor * to_phasor(geometry.distance, amplitude, context.ambiguity)
            parts.append(np.real(moved * (-1j) ** k))
        result: Image = ((parts[0] - parts[2]) + 1j * (parts[1] - parts[3])) / 2
        return result

    def simulate(self, signal: Signal, context: Context) -> Signal:
        if context.geometry_at is None or not context.moving:
            return signal
        return from_phasor(self._sampled(signal, context, self.sample_interval), signal, context)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        """Central difference over 10 us: the scene is a function of time only by its rays."""
        if not context.moving:
            zero = np.zeros_like(signal.distance)
            return {"sample_interval": (zero, zero)}
        step = 1e-5
        after = self._sampled(signal, context, self.sample_interval + step)
        before = self._sampled(signal, context, max(self.sample_interval - step, 0.0))
        change = (after - before) / (step + min(step, self.sample_interval))
        middle = self._sampled(signal, context, self.sample_interval)
        return {"sample_interval": phasor_derivative(middle, change, context.ambiguity)}

    def sentence(self) -> str:
        return (
            f"motion: the four samples are taken {self.sample_interval * 1e3:.2g} ms apart; while the camera "
            "moves, edges and oblique surfaces are measured wrong"
        )

    @classmethod
    def example(cls, camera: Camera) -> Motion:
        return cls(sample_interval=0.004)
