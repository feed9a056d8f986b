"""Angle of incidence (Kahlmann 2007, sec. 3.3.6, eqs. 3.8, 3.9, table 3.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, Undo
from rim_camera_ros.effects.candidate import TERM_SIZE, Candidate, Facts, linear
from rim_camera_ros.effects.graph import POINTS, Graph, Line
from rim_camera_ros.effects.incidence import IncidenceTerm, incidence_gon
from rim_camera_ros.effects.rows import combine_rows, need_rows, row_name, row_weights
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import quantity

#: Angle [gon] at which the polynomial's prior has the size of a term.
_STEEP = 60.0

Quartic = tuple[float, float, float, float]


@dataclass(frozen=True)
class IncidenceAngle(IncidenceTerm):
    """The measured distance is *shorter* by a1 x^4 + a2 x^3 + a3 x^2 + a4 x, x in gon.

    x is the absolute angle between ray and normal (the thesis prints x without saying so; the
    correction is added). In a correction the normals come from the frame itself.
    """

    has_discrepancy = True
    name = "incidence_angle"
    title = "angle of incidence"
    observable = "planes of different tilt and of different reflectivity (else the amplitude term cancels it)"
    refuted_by = "a tilted uniform plane that is as flat as one seen perpendicularly after the amplitude term"
    pointwise = True
    absolute = True
    undo: ClassVar[Undo] = "planes"

    drawn_over = ("incidence",)

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

    def rows(self) -> frozenset[float]:
        return frozenset(self.polynomial)

    def priors(self) -> dict[str, float]:
        return {
            f"polynomial.{row_name(key)}.{i}": TERM_SIZE / _STEEP ** (4 - i)
            for key in self.polynomial
            for i in range(4)
        }

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        none = (0.0, 0.0, 0.0, 0.0)
        base = cls(polynomial=MappingProxyType(dict.fromkeys(facts.integration_times, none)))
        return [linear(base, base.priors())]

    def graph(self, camera: Camera) -> Graph:
        """The term over the angle in degrees."""
        degrees = np.linspace(0.0, 72.0, POINTS)

        def value(incidence_angle: IncidenceAngle, key: float) -> Image:
            # the polynomial is of gon
            return -1e3 * np.asarray(
                sum(c * (degrees / 0.9) ** (4 - i) for i, c in enumerate(incidence_angle.polynomial[key]))
            )

        lines = tuple(
            Line(degrees, partial(value, key=key), f"setting {row_name(key)}") for key in self.polynomial
        )
        return Graph("angle of incidence", "angle [deg]", "error [mm]", lines)

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
