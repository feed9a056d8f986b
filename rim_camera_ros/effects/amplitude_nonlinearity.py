"""Compressed amplitude response."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import ResponseEffect
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class AmplitudeNonlinearity(ResponseEffect):
    """The published amplitude is A / (1 + compression * A). Distances are not touched."""

    name = "amplitude_nonlinearity"
    title = "compressed amplitude response"
    observable = "one target at several integration times or distances, bright to dark"
    refuted_by = "amplitudes in proportion to integration time over distance^2 up to saturation"

    pointwise = True
    drawn_over = ("amplitude",)

    compression: float = quantity("1/counts", "0: linear", minimum=0.0, typical=1e-5)

    def compressed(self, amplitude: Image) -> Image:
        """Return the published amplitude in counts."""
        result: Image = amplitude / (1 + self.compression * amplitude)
        return result

    def expanded(self, published: Image) -> Image:
        """Return A = P / (1 - compression * P); infinite at and above its asymptote."""
        rest = 1 - self.compression * published
        with np.errstate(divide="ignore"):
            return np.where(rest > 0, published / np.where(rest > 0, rest, 1.0), np.inf)

    def slope(self, amplitude: Image) -> Image:
        """Return the derivative of the published amplitude by the amplitude."""
        result: Image = 1.0 / (1 + self.compression * amplitude) ** 2
        return result

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        compressed = self.compressed(signal.amplitude)
        return {"compression": (np.zeros_like(signal.distance), -(compressed**2))}

    def sentence(self) -> str:
        light = 10000.0
        published = light / (1 + self.compression * light)
        return f"amplitude response: {light:.0f} counts of light are published as {published:.0f}"

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(0.0), {"compression": 0.1 / max(facts.amplitude, 1.0)})]

    @classmethod
    def example(cls, camera: Camera) -> AmplitudeNonlinearity:
        return cls(compression=4e-6)
