"""The signal in a chain of effects: light and measurement of one exposure, and its context."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.footprint import Cells, FootprintLight
from rim_camera_ros.frame import Settings
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.phasor import nearest_period, phase_distance

Image = NDArray[Any]
#: Rows and columns of a part of the array.
Window = tuple[slice, slice]
#: Derivatives of measured distance [m] and published amplitude [counts] by one parameter.
Column = tuple[Image | float, Image | float]


@dataclass(frozen=True)
class Signal:
    """Light and measurement of one exposure, all (H, W).

    ``distance`` [m] and ``amplitude`` [counts] are what the optics deliver, noise-free and unwrapped;
    NaN and 0 where there is no light. ``offset`` [m] is the sum of the terms so far: the measured
    distance is ``distance + offset``. ``published`` is the amplitude after the electronics, None where
    it is the amplitude itself.
    """

    distance: Image
    amplitude: Image
    offset: Image | float = 0.0
    published: Image | None = None

    @property
    def measured(self) -> Image:
        """Measured distance in metres, before noise and wrapping."""
        result: Image = self.distance + self.offset
        return result

    @property
    def published_amplitude(self) -> Image:
        """Amplitude in counts before noise and clipping."""
        return self.amplitude if self.published is None else self.published


@dataclass
class Context:
    """What an effect may use in addition to the signal.

    ``geometry``, ``geometry_at(seconds)`` (the scene that much later, with its ideal amplitude) and
    ``footprint(cells)`` (the light around the centres of the pixels) only in simulation; ``moving`` says
    whether the camera moves meanwhile; ``incidence`` [rad] (H, W) is true in simulation, estimated in
    correction; ``saturated`` (H, W) marks saturated pixels; ``time`` [s] counts from the first frame;
    ``window`` is the part of the array that the images show (None: all of it); ``memory`` is kept from frame
    to frame; its content holds for light that changed by up to the share ``light_tolerance``; ``notes``
    collects messages to the user.
    """

    camera: Camera
    settings: Settings = field(default_factory=Settings)
    stamp: int = 0
    time: float = 0.0
    geometry: Geometry | None = None
    geometry_at: Callable[[float], tuple[Geometry, Image]] | None = None
    footprint: Callable[[Cells], FootprintLight] | None = None
    incidence: Image | None = None
    window: Window | None = None
    saturated: NDArray[np.bool_] | None = None
    moving: bool = False
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    memory: dict[str, Any] = field(default_factory=dict)
    light_tolerance: float = 1e-9
    notes: set[str] = field(default_factory=set)

    @property
    def ambiguity(self) -> float:
        return self.camera.sensor.ambiguity

    @cached_property
    def column(self) -> NDArray[np.float64]:
        """Column coordinate u, (1, W)."""
        columns = np.arange(self.camera.sensor.width, dtype=float)
        return (columns if self.window is None else columns[self.window[1]])[None, :]

    @cached_property
    def row(self) -> NDArray[np.float64]:
        """Row coordinate v, (H, 1)."""
        rows = np.arange(self.camera.sensor.height, dtype=float)
        return (rows if self.window is None else rows[self.window[0]])[:, None]

    @property
    def rays(self) -> NDArray[np.float64]:
        """Unit vectors (H, W, 3) along the rays of the pixels."""
        return self.inside(self.camera.rays)

    def inside(self, image: Image) -> Image:
        """Return the part of an image of the whole array that is within the window."""
        return image if self.window is None else image[self.window]

    @cached_property
    def integration_time(self) -> float:
        """The frame's integration time in the device's unit; `InputError` where unknown."""
        return self.camera.integration_time(self.settings)


def from_phasor(phasor: Image, signal: Signal, context: Context) -> Signal:
    """Return the signal of a complex image; the distance in the period nearest the one before."""
    distance = phase_distance(phasor, context.ambiguity)
    distance = nearest_period(distance, signal.distance, context.ambiguity)
    amplitude = np.abs(phasor).astype(signal.amplitude.dtype, copy=False)
    return replace(signal, distance=distance, amplitude=amplitude)


def phasor_derivative(phasor: Image, change: Image, ambiguity: float) -> Column:
    """Return the derivatives of distance and amplitude for a change of the complex image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(phasor == 0, 0, change / phasor)
    return relative.imag * (ambiguity / (2 * np.pi)), relative.real * np.abs(phasor)


def require_geometry(context: Context, name: str) -> Geometry:
    """Return the scene's geometry, or raise `InputError` where there is none (only a simulation has it)."""
    if context.geometry is None:
        raise InputError(f"{name} needs the scene's geometry", remedy="simulate a scene file")
    return context.geometry
