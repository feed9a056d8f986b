"""Offset per integration time (Kahlmann 2007, sec. 3.3.2, table 3.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.graph import Graph, Line
from rim_camera_ros.effects.rows import combine_rows, need_rows, row_name, row_weights
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class IntegrationTimeOffset(DistanceTerm):
    """An offset by integration time. Its sign is data: the thesis states both (table 3.3 says longer)."""

    name = "integration_time_offset"
    title = "offset per integration time"
    observable = "the same scene at each integration time"
    refuted_by = "means of a fixed scene that do not depend on the setting, after the amplitude term"

    pointwise = True
    from_one_pose = True
    everywhere = True
    lacking = "the recordings have one integration time"
    constant_in_setting = True
    drawn_over = ("integration_time",)

    offset: Mapping[float, float] = quantity("m", "by integration time", typical=0.05)

    def __post_init__(self) -> None:
        need_rows(self.offset, "offset")

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return combine_rows(self.offset, context, lambda value: value)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        weights = dict(row_weights(self.offset, lambda: context.integration_time))
        one = np.ones_like(signal.distance)
        return {f"offset.{row_name(key)}": (weights.get(key, 0.0) * one, 0.0) for key in self.offset}

    def sentence(self) -> str:
        parts = [f"{value * 1e3:+.1f} mm at {row_name(key)}" for key, value in sorted(self.offset.items())]
        return "integration time: distances are offset by " + ", ".join(parts)

    def rows(self) -> frozenset[float]:
        return frozenset(self.offset)

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        if len(facts.integration_times) < 2:
            return []
        base = cls(offset=MappingProxyType(dict.fromkeys(facts.integration_times, 0.0)))
        return [linear(base, base.priors())]

    def graph(self, camera: Camera) -> Graph:
        x = np.array(sorted(self.offset))

        def value(integration_time_offset: IntegrationTimeOffset) -> Image:
            return np.array([integration_time_offset.offset[float(key)] for key in x]) * 1e3

        line = Line(x, value, points=True)
        return Graph("integration time", "integration time", "error [mm]", (line,))

    @classmethod
    def example(cls, camera: Camera) -> IntegrationTimeOffset:
        return cls(offset=MappingProxyType({16.0: -0.073, 60.0: -0.009, 100.0: 0.004}))
