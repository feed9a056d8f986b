"""Scale of distances: the modulation clock (Kahlmann 2007, secs. 3.3.7, 4.1), depth made by other optics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.graph import Graph, over_distance
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.optics import Optics, pixel_rays
from rim_camera_ros.parameters import quantity

#: No distance is longer [m]: between it and 0 the term is linear.
_FARTHEST = 1000.0
#: Prior of the principal point of a driver [px], by path.
_OTHER_AXIS = {"principal_point.0": 20.0, "principal_point.1": 20.0}


@dataclass(frozen=True)
class DistanceScale(DistanceTerm):
    """+ scale * d + d (c' / c - 1), with the cosines of a ray with the optical axis by two principal points.

    Many drivers deliver depth along the axis, distance times cosine, by optics of their own. Where it is
    made distance again by the optics of the camera file, distances are too long by c' / c, c' with the
    principal point of the driver, which is ``principal_point`` beside that of the camera file: nearly
    (du x / fx + dv y / fy) / (1 + x^2 + y^2) of the distance, x and y of the ray at z = 1. A plane is
    seen turned by that angle.
    """

    name = "distance_scale"
    title = "modulation clock error, or depth made by other optics"
    observable = "known distances over a range of metres; for the principal point known tilts over the array"
    refuted_by = "residuals without a trend over distance"
    pointwise = True
    absolute = True

    drawn_over = ("distance",)
    scales_distance = True
    in_pixels = frozenset({"principal_point"})

    scale: float = quantity("-", "relative", default=0.0, minimum=-0.5, maximum=0.5, typical=0.002)
    principal_point: tuple[float, float] | None = quantity(
        "px", "of the driver's depth along the axis, beside that of the optics", default=None
    )

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"distance"} if self.principal_point is None else {"distance", "pixel"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        if self.principal_point is None:
            return self.scale * distance
        result: Image = (self.scale - 1 + _by_other_axis(context, self.principal_point)[0]) * distance
        return result

    def distance_knots(self) -> tuple[float, ...]:
        return () if self.principal_point is None else (0.0, _FARTHEST)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        distance = np.asarray(signal.distance)
        if self.principal_point is None:
            return {"scale": (distance, 0.0)}
        _, across, down = _by_other_axis(context, self.principal_point)
        return {
            "scale": (distance, 0.0),
            "principal_point.0": (across * distance, 0.0),
            "principal_point.1": (down * distance, 0.0),
        }

    def sentence(self) -> str:
        wrong = "long" if self.scale >= 0 else "short"
        words = f"distance scale: distances are too {wrong} by {abs(self.scale) * 1e3:.3g} mm per metre"
        if self.principal_point is not None:
            u, v = self.principal_point
            words += (
                f"; they were made of depth along an axis through a point {u:.3g} columns and {v:.3g} rows "
                "beside the principal point"
            )
        return words

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        priors = {"scale": 0.02}
        beside = cls(principal_point=(0.0, 0.0))
        return [linear(cls(), priors), linear(beside, priors | _OTHER_AXIS, "principal point")]

    def priors(self) -> dict[str, float]:
        return dict(super().priors()) | ({} if self.principal_point is None else _OTHER_AXIS)

    def graph(self, camera: Camera) -> Graph:
        found = over_distance(replace(self, principal_point=None), camera)
        (line,) = found.lines
        # over the distance alone: the rest is of the pixel
        alone = replace(line, value=lambda term: line.value(replace(term, principal_point=None)))
        return replace(found, title="distance scale", lines=(alone,))

    @classmethod
    def example(cls, camera: Camera) -> DistanceScale:
        return cls(scale=-0.0011, principal_point=(0.35, -0.55))


def _by_other_axis(context: Context, point: tuple[float, float]) -> tuple[Image, Image, Image]:
    """Return the value of a distance of 1 m (H, W), and its derivatives by both numbers of ``point``."""
    optics, sensor = context.camera.optics, context.camera.sensor
    becomes, across, down = _at_one_metre(optics, sensor.width, sensor.height, point)
    return context.inside(becomes), context.inside(across), context.inside(down)


@lru_cache(maxsize=4)
def _at_one_metre(
    optics: Optics, width: int, height: int, point: tuple[float, float]
) -> tuple[Image, Image, Image]:
    rays = pixel_rays(optics, width=width, height=height)
    with np.errstate(divide="ignore", invalid="ignore"):
        ray = rays[..., :2] / rays[..., 2:]
    there = ray - np.array(point) / (optics.fx, optics.fy)
    own, other = (np.sqrt(1 + (one**2).sum(axis=-1)) for one in (ray, there))
    slopes = (own / other**3)[..., None] * there / (optics.fx, optics.fy)
    result = (own / other, np.ascontiguousarray(slopes[..., 0]), np.ascontiguousarray(slopes[..., 1]))
    for image in result:
        image.flags.writeable = False
    return result
