"""External temperature (Kahlmann 2007, sec. 3.3.7; SR-2: about 8 mm per degC)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Column, Context, DistanceTerm, Image, Signal
from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class _Filter:
    """State of the first-order lag and of its derivative by the time constant."""

    stamp: int
    ambient: float
    lagged: float
    by_constant: float


@dataclass(frozen=True)
class AmbientTemperature(DistanceTerm):
    """+ coefficient * (T_f - reference), dT_f/dt = (T_a - T_f) / time_constant.

    T_f starts at the first sample; between samples T_a is taken as linear in time, for which the
    lag is solved in closed form. Without the topic T_a = reference. A stamp that jumps back starts anew.
    """

    name = "ambient_temperature"
    title = "external temperature"
    observable = (
        "a fixed scene while the room's temperature changes by several degrees, with the topic recorded"
    )
    refuted_by = "a drift without correlation to the temperature at any lag"
    remembers = True

    coefficient: float = quantity("m/degC", "longer when warmer", typical=0.005)
    reference: float = quantity("degC", "temperature without effect", default=20.0, typical=5.0)
    time_constant: float = quantity("s", "lag of the camera body", default=0.0, minimum=0.0, typical=600.0)

    def _lagged(self, context: Context) -> _Filter:
        ambient = context.settings.ambient_temperature
        if ambient is None:
            context.notes.add(
                f"ambient_temperature: no ambient temperature recorded, taken as {self.reference:g} degC"
            )
            ambient = self.reference
        key = f"{self.name}:{self.time_constant:.17g}"
        state: _Filter | None = context.memory.get(key)
        if state is None or context.stamp < state.stamp:
            state = _Filter(context.stamp, ambient, ambient, 0.0)
        elif context.stamp > state.stamp:
            state = self._advance(state, context.stamp, ambient)
        context.memory[key] = state
        return state

    def _advance(self, state: _Filter, stamp: int, ambient: float) -> _Filter:
        seconds = (stamp - state.stamp) / NANOSECONDS
        tau = self.time_constant
        if tau == 0:
            return _Filter(stamp, ambient, ambient, 0.0)
        slope = (ambient - state.ambient) / seconds
        decay = np.exp(-seconds / tau)
        behind = state.lagged - state.ambient + slope * tau
        lagged = ambient - slope * tau + behind * decay
        # derivative of the line above by tau, the state's own derivative included
        by_constant = -slope + (state.by_constant + slope) * decay + behind * decay * seconds / tau**2
        return _Filter(stamp, ambient, float(lagged), float(by_constant))

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return self.coefficient * (self._lagged(context).lagged - self.reference)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        state = self._lagged(context)
        ones = np.ones_like(signal.distance)
        unknown = context.settings.ambient_temperature is None
        return {
            "coefficient": (ones * (state.lagged - self.reference), 0.0),
            "reference": (ones * (0.0 if unknown else -self.coefficient), 0.0),
            "time_constant": (ones * self.coefficient * state.by_constant, 0.0),
        }

    def sentence(self) -> str:
        lag = f", lagging by {self.time_constant:.0f} s" if self.time_constant else ""
        return (
            f"ambient temperature: {self.coefficient * 1e3:+.2g} mm per degree "
            f"from {self.reference:g} degC{lag}"
        )

    @classmethod
    def example(cls, camera: Camera) -> AmbientTemperature:
        return cls(coefficient=0.0013, reference=21.5, time_constant=300.0)
