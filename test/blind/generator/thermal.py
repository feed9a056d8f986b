"""Left-out effects of temperature: circuits of two masses."""

import numpy as np

from .base import LeftOut, State
from .sensor import Array

STEP = 2.0
"""Seconds of a step of integration."""


def linear_warm_up(times: Array, *, emitter: float, body: float, ratio: float) -> Array:
    """Share of the emitter's final temperature rise still to come, 1 at switching on, (n,).

    The emitter (heat capacity 1) is heated and gives to the body (heat capacity `ratio`) with time constant
    `emitter`; the body loses to the air, with time constant `body` [s] if it were alone.
    """
    exchange, loss = 1.0 / emitter, ratio / body
    matrix = np.array([[-exchange, exchange], [exchange / ratio, -(exchange + loss) / ratio]])
    final = -np.linalg.solve(matrix, np.array([1.0, 0.0]))
    rates, modes = np.linalg.eig(matrix)
    weights = np.linalg.solve(modes, final)
    return np.asarray((modes[0] * weights * np.exp(np.outer(times, rates))).sum(axis=1).real / final[0])


def convective_warm_up(
    times: Array, *, emitter: float, body: float, ratio: float, rise: float = 25.0
) -> Array:
    """The same with free convection (loss ~ dT^1.25) and radiation of the body, its delay slightly quadratic.

    `rise` is about the body's final temperature rise [K]; integrated by Runge-Kutta of fourth order.
    """
    loss = ratio / body

    def to_air(temperature: float) -> float:
        warm = max(temperature, 0.0)
        convection = warm * (warm / rise) ** 0.25
        radiation = ((293.0 + warm) ** 4 - 293.0**4) / (4.0 * 293.0**3)
        return loss * (0.6 * convection + 0.4 * radiation)

    heating = to_air(rise)

    def change(state: Array) -> Array:
        flow = (state[0] - state[1]) / emitter
        return np.array([heating - flow, (flow - to_air(float(state[1]))) / ratio])

    count = int(np.ceil(max(float(times.max()), 1.0) / (2.0 * STEP))) + 1
    h = 2.0 * STEP
    states = np.zeros((count + 1, 2))
    for k in range(count):
        y = states[k]
        k1 = change(y)
        k2 = change(y + h / 2.0 * k1)
        k3 = change(y + h / 2.0 * k2)
        states[k + 1] = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + change(y + h * k3))
    final = rise + heating * emitter
    relative = np.interp(times, np.arange(count + 1) * h, states[:, 0]) / final
    delay = relative + 0.15 * relative**2
    return np.asarray((1.15 - delay) / 1.15)


def lagged(values: Array, time_constant: float, step: float = STEP) -> Array:
    """First-order lag of a sampled function, in balance at its first value, (n,)."""
    share = 1.0 - np.exp(-step / time_constant)
    out = np.empty_like(values)
    current = out[0] = values[0]
    for k in range(1, len(values)):
        current += share * (0.5 * (values[k] + values[k - 1]) - current)
        out[k] = current
    return out


class WarmUpDrift(LeftOut):
    """Drift after power-on; amount: metres at power-on."""

    name = "warm_up_drift"
    start = 0.03

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {
            "emitter": rng.uniform(35.0, 110.0),
            "body": rng.uniform(230.0, 520.0),
            "ratio": rng.uniform(2.0, 5.0),
            "sign": float(rng.choice([-1.0, 1.0])),
        }
        circuit = {key: self.drawn[key] for key in ("emitter", "body", "ratio")}
        solution = linear_warm_up if self.tuning else convective_warm_up
        self.course = solution(self.world.exposures.uptime, **circuit)

    def metres(self, state: State, amount: float) -> Array:
        return self.drawn["sign"] * amount * self.exposure(self.course) + 0.0 * state.distance


class AmbientTemperature(LeftOut):
    """Air warms the camera; amount: m/degC."""

    name = "ambient_temperature"
    start = 0.002

    def draw(self, rng: np.random.Generator) -> None:
        self.drawn = {
            "housing": rng.uniform(120.0, 420.0),
            "chip": rng.uniform(40.0, 150.0),
            "sign": float(rng.choice([-1.0, 1.0])),
        }
        exposures = self.world.exposures
        grid = np.arange(exposures.uptime[0], exposures.uptime[-1] + 2.0 * STEP, STEP)
        air = exposures.air(grid)
        housing = lagged(air, self.drawn["housing"])
        chip = lagged(housing, self.drawn["chip"])
        course = chip - air[0]
        if not self.tuning:
            rise = housing - air[0]
            course = 1.3 * rise - 0.3 * (chip - air[0]) + 0.01 * rise**2
        self.course = np.interp(exposures.uptime, grid, course)

    def metres(self, state: State, amount: float) -> Array:
        return self.drawn["sign"] * amount * self.exposure(self.course) + 0.0 * state.distance


EFFECTS: tuple[type[LeftOut], ...] = (WarmUpDrift, AmbientTemperature)
