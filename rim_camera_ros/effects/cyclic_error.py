"""Odd harmonics of the modulation (Kahlmann 2007, secs. 2.1.2.2, 3.3.8, figs. 3.45-3.51)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Column, Context, Dependency, DistanceTerm, Image, Signal
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import cosine_and_sine


@dataclass(frozen=True)
class Harmonic:
    """One sinusoid over the ambiguity range."""

    order: int = quantity("-", "periods per ambiguity range", minimum=1, maximum=64)
    amplitude: float = quantity("m", "of the distance error", typical=0.02)
    phase: float = quantity("rad", "at distance 0 and the principal point", typical=3.0)


@dataclass(frozen=True)
class CyclicError(DistanceTerm):
    """+ amplitude * sin(order * 2 pi d / L + phase + gradient . (u - cx, v - cy)).

    The third harmonic of the waveform makes order 4, the seventh order 8; even harmonics make
    nothing (sec. 2.1.2.2). The phase changes over the array (fig. 3.51; that it does so linearly is
    a description, not a claim of the thesis).
    """

    name = "cyclic_error"
    title = "odd harmonics of the modulation"
    observable = "distances over at least half the ambiguity range, at steps well below L / 16"
    refuted_by = "residuals over distance without a period of L / 4 or L / 8"

    harmonics: tuple[Harmonic, ...] = quantity("-", "sinusoids", most=16)
    gradient: tuple[float, float] = quantity(
        "rad/px", "phase per column, per row", default=(0.0, 0.0), typical=0.003
    )

    def __post_init__(self) -> None:
        if not self.harmonics:
            raise ValueError("harmonics is empty: give at least one")
        orders = [h.order for h in self.harmonics]
        if len(set(orders)) != len(orders):
            raise ValueError("harmonics: an order is given twice")

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"distance", "pixel"} if any(self.gradient) else {"distance"})

    def phase_shift(self, context: Context) -> Image | float:
        """Return the phase in rad that the gradient adds to every harmonic, (H, W), or 0."""
        if not any(self.gradient):
            return 0.0
        optics = context.camera.optics
        return self.gradient[0] * (context.column - optics.cx) + self.gradient[1] * (context.row - optics.cy)

    def _angles(self, distance: Image, context: Context) -> list[Image]:
        shift = self.phase_shift(context)
        wave = 2 * np.pi / context.ambiguity
        return [h.order * wave * distance + h.phase + shift for h in self.harmonics]

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        total: Image | float = 0.0
        for harmonic, angle in zip(self.harmonics, self._angles(distance, context), strict=True):
            total = total + harmonic.amplitude * cosine_and_sine(np.asarray(angle))[1]
        return total

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        optics = context.camera.optics
        result: dict[str, Column] = {}
        slope: Image | float = 0.0
        for i, (h, angle) in enumerate(
            zip(self.harmonics, self._angles(signal.distance, context), strict=True)
        ):
            by_phase = h.amplitude * np.cos(angle)
            result[f"harmonics.{i}.amplitude"] = (np.sin(angle), 0.0)
            result[f"harmonics.{i}.phase"] = (by_phase, 0.0)
            slope = slope + by_phase
        result["gradient.0"] = (slope * (context.column - optics.cx), 0.0)
        result["gradient.1"] = (slope * (context.row - optics.cy), 0.0)
        return result

    def sentence(self) -> str:
        parts = [f"±{abs(h.amplitude) * 1e3:.2g} mm with {h.order} periods" for h in self.harmonics]
        return (
            "cyclic error: odd harmonics of the modulation bend the distance by "
            + " and ".join(parts)
            + " over the ambiguity range"
        )

    @classmethod
    def example(cls, camera: Camera) -> CyclicError:
        return cls(harmonics=(Harmonic(4, 0.017, -1.3), Harmonic(8, 0.0025, 0.6)), gradient=(0.0021, -0.0013))
