"""External temperature (Kahlmann 2007, sec. 3.3.7; SR-2: about 8 mm per degC)."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.graph import POINTS, Graph, Line
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.frame import NANOSECONDS, Readings
from rim_camera_ros.parameters import quantity

#: 1-sigma of how far a thermometer lags behind the air [s]: in still air they take 10 to 60 s.
_THERMOMETER_LAG = 30.0


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
    lag is solved in closed form. Samples are the recording's readings, also those between and before its
    frames; where these are not at hand, as on a live camera, the one that came last with each frame. Without
    the topic T_a = reference. A stamp that jumps back starts anew.
    """

    name = "ambient_temperature"
    title = "external temperature"
    observable = (
        "a fixed scene while the room's temperature changes by several degrees, with the topic recorded"
    )
    refuted_by = "a drift without correlation to the temperature at any lag"
    pointwise = True
    remembers = True
    follows_frames = True
    lacking = "the recordings state no ambient temperature, or a constant one"
    in_time = True
    from_one_pose = True
    everywhere = True
    drifts = True
    drawn_over = ("time",)
    shapes = frozenset({"time_constant"})

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
        if self.time_constant == 0:
            return _Filter(context.stamp, ambient, ambient, 0.0)
        key = f"{self.name}:{self.time_constant:.17g}"
        state: _Filter | None = context.memory.get(key)
        if state is not None and context.stamp < state.stamp:
            state = None
        readings = context.settings.ambient_readings
        if readings is not None and readings.stamps and readings.stamps[0] <= context.stamp:
            state = context.memory[key] = self._after(readings, context.stamp, state)
            # the reading holds until the next one
            return self._advance(state, context.stamp, state.ambient)
        if state is None:
            state = _Filter(context.stamp, ambient, ambient, 0.0)
        elif context.stamp > state.stamp:
            state = self._advance(state, context.stamp, ambient)
        context.memory[key] = state
        return state

    def _after(self, readings: Readings, stamp: int, state: _Filter | None) -> _Filter:
        """Return the state at the last reading that is not later than a stamp."""
        stamps, values = readings.stamps, readings.values
        if state is None or state.stamp < stamps[0]:
            state = _Filter(stamps[0], values[0], values[0], 0.0)
        for i in range(bisect_right(stamps, state.stamp), bisect_right(stamps, stamp)):
            state = self._advance(state, stamps[i], values[i])
        return state

    def _advance(self, state: _Filter, stamp: int, ambient: float) -> _Filter:
        seconds = (stamp - state.stamp) / NANOSECONDS
        tau = self.time_constant
        if seconds == 0:
            return state
        slope = (ambient - state.ambient) / seconds
        decay = math.exp(-seconds / tau)
        behind = state.lagged - state.ambient + slope * tau
        lagged = ambient - slope * tau + behind * decay
        # derivative of the line above by tau, the state's own derivative included
        by_constant = -slope + (state.by_constant + slope) * decay + behind * decay * seconds / tau**2
        return _Filter(stamp, ambient, lagged, by_constant)

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

    def sensor_sigmas(self) -> dict[str, float]:
        """Return the 1-sigma of the lag [s] of the thermometer behind the air."""
        return {"lag": _THERMOMETER_LAG} if self.time_constant else {}

    def sensor_columns(self, context: Context) -> dict[str, Column]:
        """Return the error by a lagging thermometer: the air is warmer than its reading by lag * dT / dt."""
        readings = context.settings.ambient_readings
        if readings is None or not self.time_constant:
            return {"lag": (np.zeros(()), 0.0)}
        state = self._lagged(context)
        # the filter is linear: its response to dT / dt is the rate of T_f
        rate = (state.ambient - state.lagged) / self.time_constant
        return {"lag": (np.asarray(self.coefficient * rate), 0.0)}

    def sentence(self) -> str:
        lag = f", lagging by {self.time_constant:.0f} s" if self.time_constant else ""
        return (
            f"ambient temperature: {self.coefficient * 1e3:+.2g} mm per degree "
            f"from {self.reference:g} degC{lag}"
        )

    def own_covariates(self) -> frozenset[str]:
        return frozenset({"settings", "ambient_temperature", "temperature"})

    def priors(self) -> dict[str, float]:
        return {"coefficient": 0.005, "time_constant": max(0.5 * self.time_constant, 30.0)}

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        if facts.ambient is None or facts.ambient[1] - facts.ambient[0] < 0.5:
            return []
        middle = round(sum(facts.ambient) / 2, 1)
        return [
            linear(cls(0.0, middle, lag), {"coefficient": 0.005}, f"{lag:g} s")
            for lag in (0.0, 60.0, 150.0, 300.0, 600.0, 1200.0, 2400.0)
        ]

    def graph(self, camera: Camera) -> Graph:
        x = np.linspace(0.0, max(5 * self.time_constant, 60.0), POINTS)

        def value(ambient_temperature: AmbientTemperature) -> Image:
            if ambient_temperature.time_constant <= 0:
                return np.full_like(x, 1e3 * ambient_temperature.coefficient)
            return np.asarray(
                1e3 * ambient_temperature.coefficient * (1 - np.exp(-x / ambient_temperature.time_constant))
            )

        line = Line(x / 60, value)
        return Graph("ambient temperature, after a step of 1 °C", "time [min]", "error [mm]", (line,))

    @classmethod
    def example(cls, camera: Camera) -> AmbientTemperature:
        return cls(coefficient=0.0013, reference=21.5, time_constant=300.0)
