"""An effect as a curve over what it depends on, for reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.frame import Settings

Array = NDArray[Any]

#: Points of a curve.
POINTS = 240


@dataclass(frozen=True)
class Line:
    """``value`` of an effect with the same rows, over ``x``, both in the units of the axes' labels."""

    x: Array
    value: Callable[[Any], Array]
    label: str = ""
    points: bool = False


@dataclass(frozen=True)
class Graph:
    """Lines of one effect; ``compared`` where those of another camera may be drawn beside them.

    ``banded`` where the covariance of its parameters gives a band.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    log: bool = False
    compared: bool = False
    banded: bool = True


def context_at_axis(camera: Camera, **settings: Any) -> Context:
    """Return a context in which effects are evaluated for the principal point alone."""
    context = Context(camera=camera, settings=Settings(**settings))
    context.column = np.array(camera.optics.cx)
    context.row = np.array(camera.optics.cy)
    return context


def amplitudes_of(camera: Camera) -> Array:
    """Return amplitudes [counts] over the range of the camera's validity."""
    low, high = camera.validity.amplitude or (50.0, 20000.0)
    return np.geomspace(max(low, 1.0), max(high, 2 * low, 2.0), POINTS)


def millimetres(camera: Camera, distance: Array, amplitude: Array, **settings: Any) -> Callable[[Any], Array]:
    """Return the function that evaluates a term at distances [m] and amplitudes [counts], in mm."""

    def value(term: DistanceTerm) -> Array:
        found = np.asarray(term.term(distance, amplitude, context_at_axis(camera, **settings)), float)
        return np.broadcast_to(found, distance.shape) * 1e3

    return value


def over_distance(term: DistanceTerm, camera: Camera) -> Graph:
    """Return a term over the distances of the camera's validity, or over its ambiguity range."""
    low, high = camera.validity.distance or (0.0, camera.sensor.ambiguity)
    x = np.linspace(low, high, POINTS)
    line = Line(x, millimetres(camera, x, np.ones_like(x)))
    return Graph(term.title, "distance [m]", "error [mm]", (line,), compared=True)


def over_amplitude(term: DistanceTerm, camera: Camera) -> Graph:
    """Return a term over the amplitudes of the camera's validity."""
    x = amplitudes_of(camera)
    line = Line(x, millimetres(camera, np.ones_like(x), x))
    return Graph(term.title, "amplitude [counts]", "error [mm]", (line,), log=True, compared=True)
