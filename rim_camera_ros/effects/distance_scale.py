"""Error of the modulation clock (Kahlmann 2007, secs. 3.3.7, 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Column, Context, Dependency, DistanceTerm, Image, Signal
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.graph import Graph, over_distance
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class DistanceScale(DistanceTerm):
    """+ scale * d."""

    name = "distance_scale"
    title = "modulation clock error"
    observable = "known distances over a range of metres"
    refuted_by = "residuals without a trend over distance"

    drawn_over = ("distance",)
    scales_distance = True

    scale: float = quantity("-", "relative", default=0.0, minimum=-0.5, maximum=0.5, typical=0.002)

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"distance"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return self.scale * distance

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        return {"scale": (np.asarray(signal.distance), 0.0)}

    def sentence(self) -> str:
        wrong = "long" if self.scale >= 0 else "short"
        return f"distance scale: distances are too {wrong} by {abs(self.scale) * 1e3:.3g} mm per metre"

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(scale=0.0), {"scale": 0.02})]

    def graph(self, camera: Camera) -> Graph:
        return replace(over_distance(self, camera), title="distance scale")

    @classmethod
    def example(cls, camera: Camera) -> DistanceScale:
        return cls(scale=-0.0011)
