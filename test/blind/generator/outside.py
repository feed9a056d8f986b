"""Physics outside the vocabulary."""

import numpy as np
from scipy import ndimage

from .base import LeftOut, State
from .sensor import Array
from .thermal import STEP, lagged


class Unknown(LeftOut):
    """An effect without a name in the vocabulary; amount: metres."""

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {"sign": float(rng.choice([-1.0, 1.0]))}
        self.draw_form(rng)

    def draw_form(self, rng: np.random.Generator) -> None:
        """Draw what the form needs besides its sign."""

    def metres(self, state: State, amount: float) -> Array:
        return self.drawn["sign"] * amount * self.shape(state)

    def shape(self, state: State) -> Array:
        """The effect for an amount of 1."""
        raise NotImplementedError

    def lit(self, values: Array) -> Array:
        """Those of pixels that receive enough light for a measurement, for medians, (any,)."""
        return np.asarray(values[values > self.world.camera.threshold])


class ColumnRipple(Unknown):
    """Column amplifiers differ, the more the brighter."""

    name, covariates = "column_ripple", ("column", "amplitude")

    def draw_form(self, rng: np.random.Generator) -> None:
        size = self.world.camera.sensor.width / 88.0
        self.drawn |= {"period": rng.uniform(5.0, 14.0) * size, "phase": rng.uniform(0.0, 2.0 * np.pi)}

    def shape(self, state: State) -> Array:
        u, _ = self.world.camera.sensor.grid()
        relative = np.maximum(state.amplitude, 1.0) / np.median(self.lit(state.amplitude))
        turn = 2.0 * np.pi * u / self.drawn["period"] + self.drawn["phase"]
        if self.tuning:
            return np.asarray(np.sin(turn) * np.log(relative))
        teeth = np.mod(turn / (2.0 * np.pi), 1.0) - 0.5 + 0.3 * (np.mod(u, 2.0) - 0.5)
        return np.asarray(teeth * (np.sqrt(relative) - 1.0))


class Height(Unknown):
    """The air or the light differ with height."""

    name, covariates = "height", ("height",)

    def draw_form(self, rng: np.random.Generator) -> None:
        self.drawn |= {"height": rng.uniform(-0.2, 0.2)}

    def shape(self, state: State) -> Array:
        geometry = self.world.geometry
        height = -np.where(geometry.seen, geometry.range, 0.0) * self.world.rays[..., 1]
        if self.tuning:
            return np.asarray(height / 0.5 + 0.4 * (height / 0.5) ** 2)
        return np.asarray(np.tanh((height - self.drawn["height"]) / 0.25))


class RowAmplitude(Unknown):
    """The charge of a whole row pulls its readout."""

    name, covariates = "row_amplitude", ("row_amplitude",)

    def shape(self, state: State) -> Array:
        row = state.amplitude.mean(axis=2, keepdims=True)
        relative = row / np.median(row)
        shape = relative - 1.0 if self.tuning else np.log1p(relative**1.5)
        return np.broadcast_to(shape, state.amplitude.shape)


class BeatInTime(Unknown):
    """Something in the room beats."""

    name, covariates = "beat_in_time", ("time",)

    def draw_form(self, rng: np.random.Generator) -> None:
        self.drawn |= {"period": rng.uniform(420.0, 1300.0), "phase": rng.uniform(0.0, 2.0 * np.pi)}

    def shape(self, state: State) -> Array:
        turn = 2.0 * np.pi * self.world.exposures.uptime / self.drawn["period"] + self.drawn["phase"]
        wave = np.sin(turn) if self.tuning else 2.0 / np.pi * np.arcsin(np.sin(turn))
        return np.broadcast_to(self.exposure(wave), state.amplitude.shape)


class RowReadoutMemory(Unknown):
    """The readout remembers what it read before."""

    name, covariates = "row_readout_memory", ("amplitude", "row_amplitude")

    def draw_form(self, rng: np.random.Generator) -> None:
        self.drawn |= {"pixels": rng.uniform(4.0, 14.0) * self.world.camera.sensor.width / 88.0}

    def shape(self, state: State) -> Array:
        amplitude = np.maximum(state.amplitude, 1.0)
        if self.tuning:
            from scipy.signal import lfilter

            keep = np.exp(-1.0 / self.drawn["pixels"])
            memory = lfilter([0.0, 1.0 - keep], [1.0, -keep], amplitude, axis=2)
        else:
            row = amplitude.mean(axis=2, keepdims=True)
            memory = np.concatenate([row[:, :1], row[:, :-1]], axis=1)
        return np.asarray(memory / (memory + amplitude) - 0.5)


class TemperaturePattern(Unknown):
    """Pixels differ in how the temperature shifts them."""

    name, covariates = "temperature_pattern", ("ambient_temperature", "row", "column")

    def draw_form(self, rng: np.random.Generator) -> None:
        exposures = self.world.exposures
        u, v = self.world.camera.sensor.grid()
        x, y = u / u.max() - 0.5, v / v.max() - 0.5
        white = rng.standard_normal(u.shape)
        if self.tuning:
            slopes = rng.standard_normal(3)
            self.pattern = slopes[0] * x + slopes[1] * y + 3.0 * slopes[2] * x * y + 0.15 * white
            course = exposures.ambient
        else:
            phase = rng.uniform(0.0, 2.0 * np.pi)
            self.pattern = np.sin(2.0 * np.pi * 1.4 * x + phase) + 0.2 * white
            grid = np.arange(exposures.uptime[0], exposures.uptime[-1] + 2.0 * STEP, STEP)
            course = np.interp(exposures.uptime, grid, lagged(exposures.air(grid), 600.0))
        self.course = (course - course.mean()) / 5.0

    def shape(self, state: State) -> Array:
        return self.exposure(self.course) * self.pattern


class LocalContrast(Unknown):
    """Contrast within the neighbourhood shifts the distance."""

    name, covariates = "local_contrast", ("contrast",)

    def shape(self, state: State) -> Array:
        window = (1, 5, 5)
        mean = ndimage.uniform_filter(state.amplitude, window)
        square = ndimage.uniform_filter(state.amplitude**2, window)
        contrast = np.sqrt(np.maximum(square - mean**2, 0.0)) / np.maximum(mean, 1.0)
        return np.asarray(contrast if self.tuning else contrast**2 / (0.1 + contrast))


class MissingCodes(LeftOut):
    """The converter misses codes; amount: metres."""

    name, covariates, start = "missing_codes", ("distance",), 0.03

    def draw(self, rng: np.random.Generator) -> None:
        if not self.tuning:
            self.drawn = {
                "bits": [9, 10, 11, 12],
                "weights": (rng.choice([-1.0, 1.0], 4) * rng.uniform(0.5, 1.5, 4)).tolist(),
            }

    def convert(self, distance: Array, amount: float) -> Array:
        if self.tuning:
            return np.asarray(np.round(distance / amount) * amount)
        code = np.floor(np.mod(distance / self.world.camera.sensor.ambiguity, 1.0) * 65536.0).astype(np.int64)
        error = sum(
            weight * ((code >> bit & 1) - 0.5)
            for bit, weight in zip(self.drawn["bits"], self.drawn["weights"], strict=True)
        )
        return np.asarray(distance + amount * error)


EFFECTS: tuple[type[LeftOut], ...] = (
    ColumnRipple,
    Height,
    RowAmplitude,
    BeatInTime,
    RowReadoutMemory,
    TemperaturePattern,
    LocalContrast,
    MissingCodes,
)
