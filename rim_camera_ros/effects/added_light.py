"""Light of the emitter that does not come from the scene: a leak, or a reflection within the housing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.signal import Column, Context, Image, Signal, from_phasor, phasor_derivative
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor

Table = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class AddedLight(Effect):
    """S_out = S + gain t (real + i imaginary), bilinear between knots that are spaced evenly over the array.

    ``real`` and ``imaginary`` are images of few pixels: rows of knots from the upper to the lower edge of
    the array, each from its left to its right edge. ``gain`` is that of the radiometry and t the integration
    time: the light grows with the exposure and the power of the emitter as that of the scene does. Pixels
    without light of the scene stay without a measurement. Reflections between lens, filter and chip are of
    this kind as far as they do not depend on the scene (Kahlmann 2007, sec. 3.3.1, who has no equation for
    them). No diagnosis names it: as a smooth image it describes unknown physics, as `empirical` does.
    """

    name = "added_light"
    title = "light of the emitter that does not come from the scene"
    observable = "dark surfaces at several distances, all over the array"
    refuted_by = "errors that are the same in bright and in dark pixels"

    lacking = "no camera file has it at first: a diagnosis estimates it where it finds such light"
    pointwise = True
    steady = True
    planned = False

    real: Table = quantity("-", "rows of light, as of a surface of this reflectivity 1 m away", typical=0.005)
    imaginary: Table = quantity("-", "its part of phase pi / 2, of the same shape", typical=0.005)

    def __post_init__(self) -> None:
        for values in (self.real, self.imaginary):
            if not values or not values[0] or len({len(row) for row in values}) > 1:
                raise ValueError("real and imaginary need rows of the same length, one value at least")
        if np.shape(self.real) != np.shape(self.imaginary):
            raise ValueError(
                f"real has the shape {np.shape(self.real)}, imaginary {np.shape(self.imaginary)}"
            )

    @property
    def strength(self) -> Image:
        """The light at the knots, in rows, as of a surface of this reflectivity 1 m away."""
        strength: Image = np.hypot(np.array(self.real), np.array(self.imaginary))
        return strength

    def light(self, context: Context) -> Image:
        """Return the complex image [counts] that is added, (H, W) of the context's part of the array."""
        return _unit(context) * context.inside(_image(self, context.camera.shape))

    def image(self, shape: tuple[int, int]) -> Image:
        """Return the complex image over an array of a ``shape`` (H, W), in the unit of ``real``."""
        return _image(self, shape).copy()

    def simulate(self, signal: Signal, context: Context) -> Signal:
        return self._changed(signal, context, np.add)

    def correct(self, signal: Signal, context: Context) -> Signal:
        return self._changed(signal, context, np.subtract)

    def _changed(self, signal: Signal, context: Context, change: Callable[..., Image]) -> Signal:
        phasor = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        light = self.light(context).astype(phasor.dtype, copy=False)
        return from_phasor(np.where(phasor == 0, phasor, change(phasor, light)), signal, context)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        phasor = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        after = np.where(phasor == 0, phasor, phasor + self.light(context))
        sensor = context.camera.sensor
        rows, columns = np.shape(self.real)
        down = _shares(context.row, sensor.height, rows)
        across = _shares(context.column, sensor.width, columns)
        result: dict[str, Column] = {}
        for part, change in (("real", _unit(context)), ("imaginary", 1j * _unit(context))):
            distance, amplitude = phasor_derivative(after, np.asarray(change), context.ambiguity)
            for v, u in product(range(len(down)), range(len(across))):
                share = down[v][:, None] * across[u]
                result[f"{part}.{v}.{u}"] = (distance * share, amplitude * share)
        return result

    def sentence(self) -> str:
        return (
            f"added light: up to {self.strength.max():.2g} of the light that a white surface 1 m away would "
            "send is added to that of the scene, wherever the scene is"
        )

    @classmethod
    def example(cls, camera: Camera) -> AddedLight:
        return cls(
            real=((0.001, 0.003), (-0.002, 0.005), (0.0, 0.002)),
            imaginary=((0.002, 0.0), (0.004, -0.001), (0.003, 0.001)),
        )


def _shares(at: Image, size: int, number: int) -> Image:
    """Return the shares of evenly spaced knots in pixels at places along a side of the array, (knots, N)."""
    places, knots = (at.ravel() + 0.5) / size, np.linspace(0.0, 1.0, number)
    return np.stack([np.interp(places, knots, own) for own in np.eye(number)])


@lru_cache(maxsize=4)
def _image(effect: AddedLight, shape: tuple[int, int]) -> Image:
    down, across = (
        _shares(np.arange(size), size, number)
        for size, number in zip(shape, np.shape(effect.real), strict=True)
    )
    light: Image = down.T @ (np.array(effect.real) + 1j * np.array(effect.imaginary)) @ across
    return light


def _unit(context: Context) -> float:
    """Return the light [counts] of a white surface 1 m away that faces the camera."""
    return context.camera.radiometry.gain * context.integration_time
