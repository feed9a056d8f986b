"""Offset per integration time (Kahlmann 2007, sec. 3.3.2, table 3.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import (
    Column,
    Context,
    DistanceTerm,
    Image,
    Signal,
    combine_rows,
    need_rows,
    row_name,
    row_weights,
)
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class IntegrationTimeOffset(DistanceTerm):
    """An offset by integration time. Its sign is data: the thesis states both (table 3.3 says longer)."""

    name = "integration_time_offset"
    title = "offset per integration time"
    observable = "the same scene at each integration time"
    refuted_by = "means of a fixed scene that do not depend on the setting, after the amplitude term"

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

    @classmethod
    def example(cls, camera: Camera) -> IntegrationTimeOffset:
        return cls(offset=MappingProxyType({16.0: -0.073, 60.0: -0.009, 100.0: 0.004}))
