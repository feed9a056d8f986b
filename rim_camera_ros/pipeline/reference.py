"""The internal reference path over time: its errors in a simulation, its filter and linearity.

Kahlmann 2007, chapter 4. D_corr = D_ext + D_int_corr - D_int (eq. 4.4); with a scale (eq. 4.5); with the
linearity of both paths (eq. 4.6). There the correction of the reference is printed as a factor; here it is
added, as that of the external path is.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import Harmonic, HarmonicError, InternalReference, mean_reading
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.frame import NANOSECONDS, Settings

# --- linearity ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Linearity:
    """The cyclic error of the reference path: sinusoids over the ambiguity range [m].

    Without harmonics there is no error.
    """

    harmonics: tuple[Harmonic, ...] = ()
    ambiguity: float = math.inf

    @classmethod
    def of_camera(cls, camera: Camera) -> Linearity:
        """Return the camera's own cyclic error at its reference pixels, as both paths share the modulation.

        For a reference that comes on the topic, without pixels, the phase is that of the principal point.
        """
        cyclic, reference = effect_of(camera, HarmonicError), effect_of(camera, InternalReference)
        if cyclic is None:
            return cls()
        shift = 0.0
        if reference is not None and reference.pixels is not None:
            u0, v0, u1, v1 = reference.pixels
            shift = cyclic.gradient[0] * ((u0 + u1) / 2 - camera.optics.cx)
            shift += cyclic.gradient[1] * ((v0 + v1) / 2 - camera.optics.cy)
        harmonics = tuple(replace(harmonic, phase=harmonic.phase + shift) for harmonic in cyclic.harmonics)
        return cls(harmonics, camera.sensor.ambiguity)

    def measured(self, distance: float) -> float:
        """Return the measured distance [m] at a true distance [m]."""
        wave = 2 * math.pi / self.ambiguity
        return distance + sum(
            h.amplitude * math.sin(h.order * wave * distance + h.phase) for h in self.harmonics
        )

    def distance(self, measured: float) -> float:
        """Return the true distance [m] of a measured one [m], by Newton's method to 1e-12 m."""
        if not self.harmonics:
            return measured
        wave = 2 * math.pi / self.ambiguity
        found = measured
        for _ in range(20):
            slope = 1.0 + sum(
                h.amplitude * h.order * wave * math.cos(h.order * wave * found + h.phase)
                for h in self.harmonics
            )
            step = (self.measured(found) - measured) / slope
            found -= step
            if abs(step) < 1e-12:
                break
        return found


# --- simulation ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class SimulatedReference:
    """Departures of a simulated reference path from nominal + drift / scale; by default none.

    ``lag``: the reference follows the drift with this time constant [s] (sec. 4.3.1: inertia of the fibre).
    ``linearity``: its own cyclic error, evaluated at the drifted distance (sec. 4.4); the reading without
    drift stays ``nominal``. ``noise``: 1-sigma in metres of one reference pixel, or of one message on the
    topic; None: the floor of the camera's noise model. The scale is that of the simulated camera's file.
    Raises ValueError for a negative lag or noise.
    """

    lag: float = 0.0
    linearity: Linearity = Linearity()
    noise: float | None = None

    def __post_init__(self) -> None:
        if self.lag < 0 or (self.noise is not None and self.noise < 0):
            raise ValueError("lag and noise of the reference path must not be negative")

    def reading(
        self, effect: InternalReference, drift: float, *, stamp: int, memory: MutableMapping[str, Any]
    ) -> float:
        """Return the reading in metres, without noise, for the drift in metres at a stamp in ns.

        ``memory`` keeps the state of the lag from frame to frame.
        """
        drift = self._lagged(drift, stamp, memory)
        start = self.linearity.distance(effect.nominal)
        return self.linearity.measured(start + effect.reading(drift) - effect.nominal)

    def _lagged(self, drift: float, stamp: int, memory: MutableMapping[str, Any]) -> float:
        """Return the drift with a first-order lag that starts at the first drift; linear between frames."""
        if self.lag == 0:
            return drift
        state: tuple[int, float, float] | None = memory.get(f"{InternalReference.name}:lag")
        lagged = drift
        if state is not None and stamp > state[0]:
            seconds = (stamp - state[0]) / NANOSECONDS
            behind = (drift - state[1]) / seconds * self.lag
            lagged = drift - behind + (state[2] - state[1] + behind) * math.exp(-seconds / self.lag)
        elif state is not None and stamp == state[0]:
            lagged = state[2]
        memory[f"{InternalReference.name}:lag"] = (stamp, drift, lagged)
        return lagged


# --- filter -------------------------------------------------------------------------------------

#: Drift rates in m/s, from that of a warm camera in a room of constant temperature (4 mm/h) to that in the
#: first seconds after power-on (sec. 4.3.1: 7 cm of the reference in 30 s, most of it in the first 10 s).
RATES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
#: Logarithm of the prior probability of each rate, up to a constant: fast drift is rare.
_PRIOR = (0.0, -2.0, -4.0, -6.0, -8.0)
#: For how long the evidence of readings on the rate is kept: in readings, and in seconds.
_READINGS = 200.0
_SECONDS = 200.0
#: The variance of a reading begins as the stated one, with the weight of the first number of readings, and
#: later is a running mean over the second number of readings. Readings more than the third number [s] apart
#: are not used for it, as they contain drift as well.
_STATED, _OBSERVED, _NEAR = 20.0, 500.0, 1.0
#: An observation of the variance counts at most as so many times the present one: jumps are not noise.
_OUTLIER = 9.0
_LEAST_NOISE = 1e-4
#: After so many seconds without a reading, of stamps or of uptime, the filter starts anew.
GAP = 300.0


@dataclass(frozen=True, slots=True)
class FilterState:
    """State of the filter after the readings up to ``stamp`` [ns]; the result is ``level`` and ``sigma`` [m].

    For each of `RATES`: its level, the sigma of the level, and the logarithm of the probability of the rate.
    ``slope`` [m/s] and ``interval`` [s] are those of the last two readings. From ``count`` such pairs follows
    the variance of a reading, over the stated one.
    """

    stamp: int
    uptime: float | None
    reading: float
    level: float
    sigma: float
    levels: tuple[float, ...]
    sigmas: tuple[float, ...]
    plausibility: tuple[float, ...]
    interval: float = math.inf
    slope: float = 0.0
    noise: float = 1.0
    count: float = _STATED


def start_filter(reading: float, *, stamp: int, uptime: float | None, sigma: float) -> FilterState:
    """Return the state after a first reading in metres of 1-sigma ``sigma`` [m]."""
    # all rates are equally probable: a camera that was just switched on drifts fast
    n = len(RATES)
    return FilterState(
        stamp, uptime, reading, reading, sigma, (reading,) * n, (sigma,) * n, (-math.log(n),) * n
    )


def advance_filter(
    state: FilterState, reading: float, *, stamp: int, uptime: float | None, sigma: float
) -> FilterState:
    """Return the state after a further reading in metres of 1-sigma ``sigma`` [m] at a stamp in ns.

    There is an exponential filter for each drift rate r of `RATES`; filters are weighted by how well they
    have predicted recent readings. The uncertainty of a level grows by r dt between readings. In the steady
    state the gain then has the time constant (sigma^2 dt / (4 r^2))^(1/3), which minimises the sum of squared
    noise and lag, sigma^2 dt / (2 tau) + (r tau)^2. As dt is the true interval, frame rates may vary and
    frames may be missing. sigma^2 is the stated variance times a factor from the differences of successive
    readings.

    A repeated reading is the same message of a slower topic and adds nothing. The filter starts anew after
    `GAP`, and when time or uptime goes back (the camera was switched off).
    """
    elapsed = (stamp - state.stamp) / NANOSECONDS
    later = 0.0
    if uptime is not None and state.uptime is not None:
        # stamps of stations in a schedule may be closer together than their uptimes
        later = uptime - state.uptime
    if elapsed < 0 or later < 0 or max(elapsed, later) > GAP:
        return start_filter(reading, stamp=stamp, uptime=uptime, sigma=sigma)
    if reading == state.reading:
        return state
    elapsed = max(elapsed, later)
    slope, noise, count = 0.0, state.noise, state.count
    if 0 < elapsed <= _NEAR:
        slope = (reading - state.reading) / elapsed
        if state.interval <= _NEAR:
            now, then = 1 / elapsed, 1 / state.interval
            unit = sigma * sigma * (now * now + then * then + (now + then) ** 2)
            observed = min((slope - state.slope) ** 2 / unit, _OUTLIER * noise)
            count = min(count + 1, _OBSERVED)
            noise = max(noise + (observed - noise) / count, _LEAST_NOISE)
    variance = sigma * sigma * noise
    keep = math.exp(-1.0 / _READINGS - elapsed / _SECONDS)
    levels, sigmas, logs = [], [], []
    for rate, prior, level, before, log in zip(
        RATES, _PRIOR, state.levels, state.sigmas, state.plausibility, strict=True
    ):
        grown = (before + rate * elapsed) ** 2
        total = grown + variance
        innovation = reading - level
        gain = grown / total
        levels.append(level + gain * innovation)
        sigmas.append(math.sqrt(grown * variance / total))
        logs.append(prior + keep * (log - prior) - 0.5 * (math.log(total) + innovation * innovation / total))
    most = max(logs)
    weights = [math.exp(one - most) for one in logs]
    whole = sum(weights)
    level = sum(w * x for w, x in zip(weights, levels, strict=True)) / whole
    spread = sum(w * (s * s + (x - level) ** 2) for w, s, x in zip(weights, sigmas, levels, strict=True))
    offset = most + math.log(whole)
    return FilterState(
        stamp,
        uptime,
        reading,
        level,
        math.sqrt(spread / whole),
        tuple(levels),
        tuple(sigmas),
        tuple(one - offset for one in logs),
        elapsed if elapsed > 0 else math.inf,
        slope,
        noise,
        count,
    )


class ReferenceReader:
    """Takes the reading of each frame, filters it, and corrects its linearity.

    ``linearity``: the reference's own cyclic error (eq. 4.6). Without it readings are used as they are, and a
    scale that was estimated from such readings includes the slope of that error (eq. 4.5). The stated noise
    of a reading is the floor of the camera's noise model, over the root of the number of pixels.
    """

    def __init__(
        self, camera: Camera, effect: InternalReference, *, linearity: Linearity | None = None
    ) -> None:
        self._effect = effect
        self._linearity = linearity if linearity is not None and linearity.harmonics else None
        # at least the rounding to counts, so that the gain is defined for a noise-free camera, too
        self._noise = max(camera.noise.floor, camera.sensor.lsb / math.sqrt(12))
        if self._linearity is not None:
            self._start = self._linearity.distance(effect.nominal)
        self._key = f"{effect.name}:{effect.pixels}"

    def take(
        self, pixels: NDArray[Any] | None, settings: Settings, *, stamp: int, memory: MutableMapping[str, Any]
    ) -> Settings:
        """Return the settings with the filtered reading in place of the frame's own.

        ``pixels``: measured distances [m], or NaN, of the reference pixels; None where there are none.
        ``memory`` keeps the filter from frame to frame.
        """
        reading, count = settings.reference_distance, 1
        if pixels is not None:
            reading, count = mean_reading(pixels), int(np.count_nonzero(np.isfinite(pixels)))
        if reading is None or not math.isfinite(reading):
            return replace(settings, reference_distance=None)
        before: FilterState | None = memory.get(self._key)
        given: dict[str, Any] = {
            "stamp": stamp,
            "uptime": settings.uptime,
            "sigma": self._noise / math.sqrt(count),
        }
        state = start_filter(reading, **given) if before is None else advance_filter(before, reading, **given)
        memory[self._key] = state
        level = state.level
        if self._linearity is not None:
            level = self._effect.nominal + self._linearity.distance(level) - self._start
        return replace(settings, reference_distance=level)
