"""Emission pattern of the LEDs and vignetting (Kahlmann 2007, sec. 3.3.4)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import ComplexEffect
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.covariates import AXIS
from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn, functions_of_direction
from rim_camera_ros.effects.graph import POINTS, Graph, Line
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.parameters import quantity


def squared_angle(camera: Camera) -> Image:
    """Return q (H, W): the square of the angle from the optical axis in rad; 0 for pixels without a ray."""
    return _squared_angle(camera.rays)


def _squared_angle(rays: Image) -> Image:
    return np.square(np.arccos(np.clip(np.nan_to_num(rays[..., 2], nan=1.0), -1.0, 1.0)))


@dataclass(frozen=True)
class EmissionPattern(ComplexEffect):
    """Relative power 1 + f1 q + f2 q^2 with q = (angle from the optical axis in rad)^2."""

    name = "emission_pattern"
    title = "LED lobe and vignetting"
    observable = "a surface of known reflectivity that fills the image, or one seen at many places of it"
    refuted_by = "amplitude over distance^2 of one patch that stays the same wherever in the image it is"

    pointwise = True
    steady = True
    shows_in = "amplitude"
    drawn_over = (AXIS,)

    falloff: tuple[float, float] = quantity("rad^-2, rad^-4", "f1, f2", typical=2.0)

    def check(self, camera: Camera) -> None:
        q = squared_angle(camera)
        if min(q.shape) > 1:
            # up to a pixel beside the array: that of a coarser grid ends within a pixel of the full one's
            q = np.maximum(np.pad(np.sqrt(q), 1, mode="reflect", reflect_type="odd"), 0.0) ** 2
        if np.any(self._at(q) <= 0):
            raise ValueError("falloff must leave the relative power positive over the whole array")

    def power(self, camera: Camera) -> Image:
        """Return the relative power (H, W)."""
        return self._at(squared_angle(camera))

    def towards(self, rays: Image, camera: Camera) -> Image:
        """Return the relative power (N,) along rays (N, 3) beyond the array: no more than at its far corner.

        The polynomial holds over the array alone.
        """
        q = np.square(np.arccos(np.clip(rays[..., 2], -1.0, 1.0)))
        at_corner = float(self._at(squared_angle(camera).max()))
        return np.clip(self._at(q), 0.0, at_corner)

    def _at(self, q: Image) -> Image:
        return 1 + q * (self.falloff[0] + q * self.falloff[1])

    def apply(self, phasor: Image, context: Context) -> Image:
        return phasor * self._at(_squared_angle(context.rays))

    def invert(self, phasor: Image, context: Context) -> Image:
        return phasor / self._at(_squared_angle(context.rays))

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        q = _squared_angle(context.rays)
        return {"falloff.0": phasor * q, "falloff.1": phasor * q * q}

    def sentence(self) -> str:
        q = np.radians(22.5) ** 2
        share = 1 + q * (self.falloff[0] + q * self.falloff[1])
        return (
            f"emission pattern: {share:.0%} of the light on the axis is emitted 22.5 degrees (25 gon) "
            f"beside it; amplitudes there are {abs(1 - share):.0%} {'lower' if share <= 1 else 'higher'}"
        )

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(falloff=(0.0, 0.0)), {"falloff.0": 2.0, "falloff.1": 4.0})]

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        yield from super().discrepancy(change)
        for bright in functions_of_direction(change.distance.shape):
            yield change.reading.light_change(self.name, bright + 0j)

    def graph(self, camera: Camera) -> Graph:
        x = np.linspace(0.0, float(np.arccos(np.nanmin(camera.rays[..., 2]))), POINTS)

        def value(emission_pattern: EmissionPattern) -> Image:
            return 100.0 * np.asarray(
                1 + emission_pattern.falloff[0] * x**2 + emission_pattern.falloff[1] * x**4
            )

        line = Line(np.degrees(x), value)
        return Graph("emission pattern", "angle from the axis [deg]", "power [%]", (line,))

    @classmethod
    def example(cls, camera: Camera) -> EmissionPattern:
        q = max(float(squared_angle(camera).max()), 1e-3)
        return cls(falloff=(-1.2 / q, 0.7 / q**2))
