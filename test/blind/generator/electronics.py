"""Left-out effects of sensor and electronics: functions of distance, amplitude, angle and setting."""

import numpy as np

from .base import LeftOut, State
from .sensor import Array

PHASES = 1024
MODULATION_RATE = 2.0 * np.pi * 20e6


def led_waveform(phases: int, *, rise: float, fall: float) -> Array:
    """Steady state of an LED that is on for half a period, (phases,); `rise`, `fall` in rad."""
    x = 2.0 * np.pi * np.arange(phases) / phases
    e_rise, e_fall = np.exp(-np.pi / rise), np.exp(-np.pi / fall)
    low = e_fall * (1.0 - e_rise) / (1.0 - e_rise * e_fall)
    high = 1.0 - (1.0 - low) * e_rise
    on = 1.0 - (1.0 - low) * np.exp(-x / rise)
    off = high * np.exp(-np.maximum(x - np.pi, 0.0) / fall)
    return np.where(x < np.pi, on, off)


def gate_waveform(phases: int, *, ramp: float) -> Array:
    """Gate of half a period with linear ramps of `ramp` rad, (phases,)."""
    x = 2.0 * np.pi * (np.arange(phases) + 0.5) / phases
    if ramp <= 0.0:
        return np.where(x < np.pi, 1.0, 0.0)
    return np.clip(x / ramp, 0.0, 1.0) * np.clip((np.pi + ramp - x) / ramp, 0.0, 1.0)


def sampled_phasor(led: Array, gate: Array, share: float) -> "np.ndarray":
    """Measured over true phasor for every true phase 2 pi j / n, from four taps of the sampled correlation.

    Everything but the fundamental of the correlation is multiplied by `share`.
    """
    spectrum = np.fft.fft(led) * np.conj(np.fft.fft(gate))
    fundamental = np.zeros_like(spectrum)
    fundamental[[1, -1]] = spectrum[[1, -1]]
    # as function of the delay of the light; shifted in time until its fundamental is a cosine
    order = np.fft.fftfreq(len(led), 1.0 / len(led))
    mixed = (fundamental + share * (spectrum - fundamental)) * np.exp(-1j * order * np.angle(spectrum[1]))
    correlation = np.fft.ifft(mixed).real
    quarter = len(led) // 4
    taps = [np.roll(correlation, k * quarter) for k in range(4)]
    measured = (taps[0] - taps[2]) + 1j * (taps[1] - taps[3])
    true = np.exp(2j * np.pi * np.arange(len(led)) / len(led))
    relative = measured / true
    return np.asarray(relative / np.mean(np.abs(relative)))


class CyclicError(LeftOut):
    """Harmonics of the real waveform, seen by four taps; amount: share of the harmonics [-]."""

    name, stage, acts_on_image = "cyclic_error", 7, True
    start, largest = 0.1, 1.5

    def draw(self, rng: np.random.Generator) -> None:
        rise = rng.uniform(4e-9, 9e-9) * MODULATION_RATE
        if self.tuning:
            self.drawn = {"rise_rad": rise, "fall_rad": rise, "ramp_rad": 0.0, "gradient": [0.0, 0.0]}
        else:
            size = 88.0 / self.world.camera.sensor.width
            self.drawn = {
                "rise_rad": rise,
                "fall_rad": rise * rng.uniform(1.6, 2.6),
                "ramp_rad": rng.uniform(0.2, 0.5),
                "gradient": (rng.normal(0.0, 0.002, 2) * size).tolist(),
            }
        self.drawn["delay_rad"] = rng.uniform(0.0, 2.0 * np.pi)
        self.led = led_waveform(PHASES, rise=self.drawn["rise_rad"], fall=self.drawn["fall_rad"])
        self.gate = gate_waveform(PHASES, ramp=self.drawn["ramp_rad"])

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        relative = sampled_phasor(self.led, self.gate, amount)
        u, v = self.world.camera.sensor.grid()
        (cx, cy), (gu, gv) = self.world.camera.sensor.principal_point, self.drawn["gradient"]
        delay = self.drawn["delay_rad"] + gu * (u - cx) + gv * (v - cy)
        position = np.mod(np.angle(light) + delay, 2.0 * np.pi) * PHASES / (2.0 * np.pi)
        knots = np.arange(PHASES + 1)
        closed = np.append(relative, relative[0])
        return np.asarray(
            light * (np.interp(position, knots, closed.real) + 1j * np.interp(position, knots, closed.imag))
        )


class AmplitudeOffset(LeftOut):
    """Delay of the front end at low signal; amount: metres."""

    name = "amplitude_offset"
    start = 0.05

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"signal": rng.uniform(0.6, 1.6) if self.tuning else rng.uniform(0.25, 0.7)}

    def metres(self, state: State, amount: float) -> Array:
        return amount * self.shape(np.maximum(state.amplitude, 1.0) / self._settings())

    def shape(self, signal: Array) -> Array:
        """The form for `signal` = amplitude / integration time, relative to its amount."""
        ratio = signal / self.drawn["signal"]
        return np.asarray(np.log1p(1.0 / ratio) if self.tuning else 1.0 / (1.0 + ratio**1.25))

    def _settings(self) -> Array:
        return self.exposure(self.world.exposures.integration_time)


class IncidenceAngle(LeftOut):
    """Distance shorter on inclined surfaces; amount: metres."""

    name = "incidence_angle"
    start = 0.03

    def draw(self, rng: np.random.Generator) -> None:
        self.cancelling: tuple[float, float] | None = None

    def metres(self, state: State, amount: float) -> Array:
        angle = self.world.geometry.incidence
        settings = self.exposure(self.world.exposures.integration_time)
        return -amount * (100.0 / settings) ** 0.29 * self.shape(angle)

    def shape(self, angle: Array) -> Array:
        """The form, relative to its amount, at angles in rad."""
        limited = np.minimum(angle, 1.45)
        if self.cancelling is not None:
            scale, power = self.cancelling
            if self.tuning:
                return np.asarray(1.0 - np.exp(-((limited / scale) ** power)))
            return np.asarray(np.tan(np.minimum(scale * limited, 1.5)) ** power)
        if self.tuning:
            return np.asarray(1.0 - np.exp(-((angle / 0.6) ** 1.3)))
        return np.asarray(np.tan(0.8 * limited) * (1.0 - 0.3 * np.exp(-((limited / 0.25) ** 2))))


class IntegrationTimeOffset(LeftOut):
    """Offset per setting; amount: metres."""

    name = "integration_time_offset"

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"sign": float(rng.choice([-1.0, 1.0]))}

    def metres(self, state: State, amount: float) -> Array:
        settings = self.exposure(self.world.exposures.integration_time)
        shape = np.sqrt(16.0 / settings) if self.tuning else np.exp(-settings / 45.0) - 0.35
        return np.asarray(self.drawn["sign"] * amount * shape)


class DistanceScale(LeftOut):
    """Clock error; amount: relative [-]."""

    name = "distance_scale"
    start = 0.003

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"sign": float(rng.choice([-1.0, 1.0]))}

    def metres(self, state: State, amount: float) -> Array:
        scale = self.drawn["sign"] * amount
        if self.tuning:
            return scale * state.distance
        warming = 1.0 + 0.1 * np.exp(-self.exposure(self.world.exposures.uptime) / 400.0)
        return np.asarray(scale * warming * (state.distance + 0.4))


class AmplitudeNonlinearity(LeftOut):
    """Compressed amplitude response; amount [-]: compression at 10,000 counts."""

    name, kind = "amplitude_nonlinearity", "amplitude"
    start = 0.05

    def published(self, amplitude: Array, amount: float) -> Array:
        compressed = amount * amplitude / 1e4
        if self.tuning:
            return np.asarray(amplitude / np.sqrt(1.0 + compressed**2))
        return np.asarray(amplitude / (1.0 + np.log1p(compressed)))


class BackgroundLight(LeftOut):
    """Daylight on the surfaces; amount: metres of offset where the light saturates it."""

    name = "background_light"
    start = 0.02

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"level": rng.uniform(1500.0, 6000.0), "sign": float(rng.choice([-1.0, 1.0]))}
        if not self.tuning:
            self.drawn |= {
                "clouds": rng.uniform(0.15, 0.35),
                "period": rng.uniform(700.0, 1500.0),
                "phase": rng.uniform(0.0, 2.0 * np.pi),
                "slope": rng.uniform(-0.5, 0.5),
            }

    def level(self) -> Array:
        """Unmodulated light, counts, (n, height, width)."""
        drawn, geometry = self.drawn, self.world.geometry
        level = drawn["level"] * geometry.reflectivity
        if self.tuning:
            return level
        uptime = self.exposure(self.world.exposures.uptime)
        cover = 1.0 + drawn["clouds"] * np.sin(2.0 * np.pi * uptime / drawn["period"] + drawn["phase"])
        u, _ = self.world.camera.sensor.grid()
        gradient = 1.0 + drawn["slope"] * (u / self.world.camera.sensor.width - 0.5)
        return np.asarray(level * cover * gradient)

    def metres(self, state: State, amount: float) -> Array:
        level = self.level()
        return np.asarray(self.drawn["sign"] * amount * level / (level + 0.4 * self.drawn["level"]))

    def extra_variance(self, state: State, amount: float) -> Array:
        return self.world.camera.shot**2 * self.level() / np.maximum(state.amplitude, 1.0) ** 2


class Noise(LeftOut):
    """More noise than the camera file says; amount: excess over the stated sigma [-]."""

    name, kind = "noise", "noise"
    start = 0.5

    def extra_variance(self, state: State, amount: float) -> Array:
        amplitude = np.maximum(state.amplitude, 1.0)
        excess = amount * self.world.camera.sigma(amplitude)
        if not self.tuning:
            excess = excess * np.sqrt(np.median(amplitude[self.world.geometry.seen]) / amplitude)
        return np.asarray(excess**2)


class SaturationBleed(LeftOut):
    """Rows and columns beside saturated pixels; amount: metres next to one."""

    name = "saturation_bleed"
    start = 0.02

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"sign": float(rng.choice([-1.0, 1.0]))}

    def metres(self, state: State, amount: float) -> Array:
        saturated = state.amplitude >= self.world.camera.saturation
        signed = self.drawn["sign"] * amount
        if self.tuning:
            row = np.minimum(since(saturated, axis=2), since(saturated[:, :, ::-1], axis=2)[:, :, ::-1])
            column = np.minimum(since(saturated, axis=1), since(saturated[:, ::-1], axis=1)[:, ::-1])
            total = np.exp(-row / 25.0) + 0.6 * np.exp(-column / 25.0)
        else:
            counts = np.sum(saturated, axis=2, keepdims=True)
            total = counts**0.3 / (1.0 + since(saturated, axis=2) / 10.0)
            total = total - 0.4 * np.any(saturated, axis=1, keepdims=True)
        return np.where(saturated, 0.0, signed * total)


def since(flags: "np.ndarray", *, axis: int) -> Array:
    """Steps along `axis` since the last set flag, inf before the first."""
    shape = [1] * flags.ndim
    shape[axis] = -1
    position = np.arange(flags.shape[axis], dtype=float).reshape(shape)
    last = np.maximum.accumulate(np.where(flags, position, -np.inf), axis=axis)
    return np.asarray(position - last)


EFFECTS: tuple[type[LeftOut], ...] = (
    CyclicError,
    AmplitudeOffset,
    IncidenceAngle,
    IntegrationTimeOffset,
    DistanceScale,
    AmplitudeNonlinearity,
    BackgroundLight,
    Noise,
    SaturationBleed,
)
