"""A smooth function of at most two covariates, where the physics is unknown."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.covariates import COVARIATES, SCALAR, covariate, resampled_knots
from rim_camera_ros.effects.graph import Graph, Line
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.effects.tables import check_knots, interpolate
from rim_camera_ros.errors import nearest_name
from rim_camera_ros.parameters import NestedList, quantity

_KIND: dict[str, Dependency] = {
    "distance": "distance",
    "amplitude": "amplitude",
    "row": "pixel",
    "column": "pixel",
    "incidence": "incidence",
}


@dataclass(frozen=True)
class Empirical(DistanceTerm):
    """+ f(covariates), multilinear between knots, held constant outside.

    A covariate that the recording does not state switches the term off, which is said.
    """

    name = "empirical"
    title = "smooth function of covariates"
    observable = "recordings in which its covariates vary while the rest is known"
    refuted_by = "residuals that do not depend on its covariates"
    absolute = True

    estimated = "covariates"
    stated_by_pixels = True

    covariates: tuple[str, ...] = quantity("-", "one or two names")
    knots: tuple[tuple[float, ...], ...] = quantity("unit of the covariate", "one increasing list each")
    values: NestedList = quantity("m", "nested list of the knots' shape")

    def __post_init__(self) -> None:
        if not 1 <= len(self.covariates) <= 2:
            raise ValueError(f"covariates: give one or two names, found {len(self.covariates)}")
        for name in self.covariates:
            if name not in COVARIATES:
                raise ValueError(f"unknown covariate '{name}' ({nearest_name(name, COVARIATES)})")
        check_knots(self.knots, self.values.values.shape, self.covariates)

    def depends_on(self) -> frozenset[Dependency]:
        kinds: set[Dependency] = {"settings"}
        changing = False
        for name in self.covariates:
            if name == "height":
                kinds |= {"distance", "pixel"}
            elif name not in SCALAR:
                kinds.add(_KIND.get(name, "frame"))
            elif name != "integration_time":
                changing = True
        # a term that changes from frame to frame within one setting must not be folded into a table; if it
        # depends on the distance as well, it has to be solved for like a term of distance and amplitude
        if "distance" in kinds and (changing or "frame" in kinds):
            kinds = (kinds - {"frame"}) | {"amplitude"}
        elif changing and kinds != {"settings"}:
            kinds.add("frame")
        return frozenset(kinds)

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        coordinates: list[Image | float] = []
        for name in self.covariates:
            value = covariate(name, distance, amplitude, context)
            if value is None:
                context.notes.add(f"empirical is off: the recording states no {name}")
                return 0.0
            coordinates.append(value)
        return interpolate(self.knots, self.values.values, coordinates)

    def distance_knots(self) -> tuple[float, ...]:
        return self.knots[self.covariates.index("distance")] if "distance" in self.covariates else ()

    def sentence(self) -> str:
        spread = float(np.ptp(self.values.values)) * 1e3
        return f"empirical: a smooth function of {' and '.join(self.covariates)} that spans {spread:.1f} mm"

    def resampled(self, factor: float, step: int | None) -> Self:
        return replace(self, knots=tuple(map(partial(resampled_knots, factor), self.covariates, self.knots)))

    def graph(self, camera: Camera) -> Graph | None:
        if len(self.covariates) != 1:
            return None
        name = self.covariates[0]

        def value(empirical: Empirical) -> Image:
            return np.asarray(empirical.values.values) * 1e3

        line = Line(np.asarray(self.knots[0]), value)
        title = f"smooth function of {name}"
        return Graph(title, name, "error [mm]", (line,), log=name == "amplitude", banded=False)

    @classmethod
    def example(cls, camera: Camera) -> Empirical:
        values = np.array([[0.002, -0.001], [0.004, 0.003], [-0.005, 0.001]])
        h = float(camera.sensor.height)
        return cls(
            covariates=("distance", "row"), knots=((0.4, 2.0, 5.0), (0.0, h / 2)), values=NestedList(values)
        )
