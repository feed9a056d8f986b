"""Shares of a light pulse that gates transmit, by distance.

Kahlmann 2007, sec. 2.3.4: a shutter before an ordinary image sensor is open for a short time after the pulse.
The amount of transmitted light depends on the distance. With two gates or more the reflectivity cancels.
R. Gvili, A. Kaplan, E. Ofek & G. Yahav, *Depth keying*, Proc. SPIE 5006 (2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import SPEED_OF_LIGHT

Array = NDArray[Any]

#: An edge of a gate extends over so many of its standard deviations.
_EDGE = 8.0


@dataclass(frozen=True, kw_only=True)
class Gate:
    """A time for which the shutter is open, counted from the beginning of the light pulse."""

    delay: float = quantity("s", "when it opens after the pulse began", minimum=-1e-3, maximum=1e-3)
    width: float = quantity("s", "how long it is open", minimum=1e-11, maximum=1e-3)


@dataclass(frozen=True, kw_only=True)
class PulseAndGates:
    """A rectangular light pulse and its gates, without the rate of the pulses."""

    gates: tuple[Gate, ...] = quantity("-", "in the order of their images", most=64)
    pulse_width: float = quantity("s", "length of the light pulse", minimum=1e-11, maximum=1e-3)
    rise_time: float = quantity(
        "s",
        "1-sigma of the edges of pulse and gates, taken together",
        default=1e-9,
        minimum=1e-12,
        maximum=1e-6,
    )
    read_noise: float = quantity(
        "counts", "1-sigma of one image, in addition to that of the photons", default=5.0, minimum=0.0
    )
    black_level: float = quantity(
        "counts",
        "value of an image without any light; read-out noise is symmetric where it is not cut off at 0",
        default=0.0,
        minimum=0.0,
        maximum=65535.0,
    )


@dataclass(frozen=True, kw_only=True)
class GatedShutter(PulseAndGates):
    """Pulse, gates and the period of the pulses. One count of an image is one photo-electron."""

    pulse_rate: float = quantity("Hz", "light pulses per second", minimum=1e3)

    @property
    def period(self) -> float:
        """Seconds from pulse to pulse."""
        return 1.0 / self.pulse_rate

    @property
    def ambiguity(self) -> float:
        """Distance in metres from which light is attributed to the next pulse: c / (2 pulse_rate)."""
        return SPEED_OF_LIGHT / (2.0 * self.pulse_rate)

    @property
    def windows(self) -> Array:
        """Width of each gate (gates,) in widths of the pulse, which is its factor on unmodulated light."""
        return np.array([gate.width for gate in self.gates]) / self.pulse_width

    def shares(self, distance: Array) -> Array:
        """Return the share (gates, ...) of a pulse's light that each gate transmits, by distance [m].

        The pulse arrives from 2 d / c to 2 d / c + `pulse_width`. Its overlap with the gate, with edges that
        are integrals of a Gaussian, has four terms of F(x) = x Phi(x / s) + s phi(x / s). Distances that
        differ by `ambiguity` give the same shares.
        """
        arrival = np.mod(np.asarray(distance, float), self.ambiguity) * (2.0 / SPEED_OF_LIGHT)
        result = np.zeros((len(self.gates), *arrival.shape))
        for i, gate in enumerate(self.gates):
            first = math.floor((gate.delay - self.pulse_width - _EDGE * self.rise_time) / self.period)
            last = math.ceil((gate.delay + gate.width + _EDGE * self.rise_time) / self.period)
            for turn in range(first, last + 1):
                begin = arrival + turn * self.period - gate.delay
                end = begin + self.pulse_width
                result[i] += self._ramp(end) - self._ramp(begin)
                result[i] -= self._ramp(end - gate.width) - self._ramp(begin - gate.width)
        # differences of ramps may be negative by rounding
        return np.maximum(result, 0.0) / self.pulse_width

    def _ramp(self, time: Array) -> Array:
        from scipy.special import ndtr  # takes a good part of a node's start

        x = time / self.rise_time
        density = np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
        return np.asarray(self.rise_time * (x * ndtr(x) + density))

    def slice_of(self, gate: int) -> tuple[float, float]:
        """Return the limits [m] of the distances at which a gate transmits at least half of its maximum.

        A gate's image is a slice of the scene's depth (sec. 2.3.4, fig. 2.35).
        """
        one = self.gates[gate]
        shorter = min(one.width, self.pulse_width)
        begin = one.delay - self.pulse_width + shorter / 2.0
        end = one.delay + one.width - shorter / 2.0
        return begin * SPEED_OF_LIGHT / 2.0, end * SPEED_OF_LIGHT / 2.0
