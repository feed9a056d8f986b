"""Angle of incidence (Kahlmann 2007, sec. 3.3.6, eqs. 3.8, 3.9, table 3.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import (
    Column,
    Context,
    Dependency,
    DistanceTerm,
    Image,
    Signal,
    Undo,
    combine_rows,
    need_rows,
    row_name,
    row_weights,
)
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import quantity

Quartic = tuple[float, float, float, float]


def incidence_gon(angle: Image) -> Image:
    """Return min(|angle|, 90 gon) in gon for an angle in rad (400 gon = 360 degrees)."""
    result: Image = np.minimum(np.abs(angle) * (200.0 / np.pi), 90.0)
    return result


@dataclass(frozen=True)
class IncidenceAngle(DistanceTerm):
    """The measured distance is *shorter* by a1 x^4 + a2 x^3 + a3 x^2 + a4 x, x in gon.

    x is the absolute angle between ray and normal (the thesis prints x without saying so; the
    correction is added). In a correction the normals come from the frame itself.
    """

    name = "incidence_angle"
    title = "angle of incidence"
    observable = "planes of different tilt and of different reflectivity (else the amplitude term cancels it)"
    refuted_by = "a tilted uniform plane that is as flat as one seen perpendicularly after the amplitude term"
    undo: ClassVar[Undo] = "planes"

    polynomial: Mapping[float, Quartic] = quantity(
        "m/gon^4, m/gon^3, m/gon^2, m/gon", "a1 a2 a3 a4 by integration time"
    )

    def __post_init__(self) -> None:
        need_rows(self.polynomial, "polynomial")

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"incidence", "settings"})

    def at(self, gon: Image, context: Context) -> Image | float:
        """Return the term in metres (negative: shorter) at angles in gon."""

        def row(a: Quartic) -> Image:
            return -gon * (a[3] + gon * (a[2] + gon * (a[1] + gon * a[0])))

        return combine_rows(self.polynomial, context, row)

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return self.at(_angle(context), context)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        gon = _angle(context)
        weights = dict(row_weights(self.polynomial, lambda: context.integration_time))
        return {
            f"polynomial.{row_name(key)}.{i}": (-weights.get(key, 0.0) * gon ** (4 - i), 0.0)
            for key in self.polynomial
            for i in range(4)
        }

    def sentence(self) -> str:
        at_60 = {key: sum(c * 60.0 ** (4 - i) for i, c in enumerate(a)) for key, a in self.polynomial.items()}
        far = all(value < 0 for value in at_60.values())
        parts = []
        for key, value in sorted(at_60.items()):
            parts.append(
                f"{value * (-1e3 if far else 1e3):.0f} mm at 60 gon (54 degrees) with setting {row_name(key)}"
            )
        where = "far" if far else "near"
        return f"angle of incidence: oblique surfaces are measured too {where}, by " + ", ".join(parts)

    @classmethod
    def example(cls, camera: Camera) -> IncidenceAngle:
        rows: dict[float, Quartic] = {
            16.0: (5.768e-9, -4.555e-7, 9.834e-6, 5.655e-4),
            60.0: (4.122e-9, -1.806e-7, 1.757e-6, 2.996e-4),
            100.0: (3.065e-9, -1.691e-7, 4.899e-6, 2.817e-4),
        }
        return cls(polynomial=MappingProxyType(rows))


def _angle(context: Context) -> Image:
    if context.incidence is None:
        raise InputError(
            "the angle of incidence is not known", remedy="simulate a scene, or estimate normals"
        )
    return incidence_gon(context.incidence)
