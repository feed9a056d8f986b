"""Unmodulated light (Kahlmann 2007, sec. 2.3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class BackgroundLight(DistanceTerm):
    """An offset is added; the noise variance gains noise.shot^2 * level / A^2 (see `noise.Noise`).

    Where the camera file states ``sensor.background_suppression`` [dB], level * 10^(-suppression / 20) fills
    the pixels as modulated light does (sec. 2.3.2): a pixel saturates where that and its amplitude reach
    ``sensor.saturation``.
    """

    name = "background_light"
    title = "unmodulated light"
    observable = "the same scene with the lamps on and off"
    refuted_by = "noise that stays when the room is darkened"

    shows_in = "noise"
    estimated = "elsewhere"
    estimated_elsewhere = "shows in the noise only"
    constant_in_setting = True
    drawn_over = ("amplitude",)

    level: float = quantity("counts", "unmodulated light", minimum=0.0, typical=1000.0)
    offset: float = quantity("m", "distance offset", default=0.0, typical=0.005)

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return self.offset

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        zero = np.zeros_like(signal.distance)
        return {"level": (zero, 0.0), "offset": (zero + 1.0, 0.0)}

    def sentence(self) -> str:
        return (
            f"background light: {self.level:.3g} counts of unmodulated light add photon noise and shift "
            f"distances by {self.offset * 1e3:.2g} mm"
        )

    @property
    def unmodulated_light(self) -> float:
        return self.level

    @classmethod
    def example(cls, camera: Camera) -> BackgroundLight:
        return cls(level=900.0, offset=0.0031)
