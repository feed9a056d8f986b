"""Error by position instead of physics: the integral calibration (Kahlmann 2007, sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.effects.tables import check_knots, interpolate
from rim_camera_ros.parameters import ArrayFile, quantity


@dataclass(frozen=True)
class IntegralTable(DistanceTerm):
    """+ value(u, v, d), multilinear between knots, held constant outside.

    Like every term it states the error of the measurement; the correction subtracts it.
    """

    name = "integral_table"
    title = "error by position"
    observable = "a board at known poses throughout the volume"
    refuted_by = "residuals at one place that differ between surfaces"
    absolute = True

    estimated = "positions"
    needs_all_pixels = True
    pointwise = True
    stated_by_pixels = True

    knots: tuple[tuple[float, ...], ...] = quantity("px, px, m", "columns u, rows v, distances d")
    values: ArrayFile = quantity("m", ".npy of shape (knots of u, v, d)")

    def __post_init__(self) -> None:
        check_knots(self.knots, self.values.values.shape, ("u", "v", "d"))

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"pixel", "distance"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        values = self.values.values.astype(np.float64)
        return interpolate(self.knots, values, (context.column, context.row, distance))

    def distance_knots(self) -> tuple[float, ...]:
        return self.knots[2]

    def sentence(self) -> str:
        size = np.sqrt(np.mean(self.values.values**2))
        return f"integral table: errors by position of {size * 1e3:.1f} mm RMS"

    @classmethod
    def example(cls, camera: Camera) -> IntegralTable:
        w, h = float(camera.sensor.width - 1), float(camera.sensor.height - 1)
        knots = ((0.0, w / 3, w), (0.0, h), (0.5, 1.5, 3.0, 6.0))
        values = 0.004 * np.random.default_rng(11).standard_normal((3, 2, 4))
        return cls(knots=knots, values=ArrayFile("integral_table.npy", values))
