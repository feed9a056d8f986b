"""Distance terms: those of the camera file, and the hidden ones with forms of their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from .world import Light, World

#: gon per radian
GON = 200 / np.pi


def row(table: dict[int, Any], setting: float) -> Any:
    """The row of an integration time, which has one."""
    return table[int(setting)]


def lagged(history: tuple[np.ndarray, np.ndarray], constant: float, at: np.ndarray) -> np.ndarray:
    """A temperature behind a first-order lag [s], beginning at its first sample, at times [s]."""
    time, value = history
    out = np.empty_like(value)
    out[0] = value[0]
    for n in range(1, len(value)):
        share = 1 - np.exp(-(time[n] - time[n - 1]) / constant)
        out[n] = out[n - 1] + share * ((value[n] + value[n - 1]) / 2 - out[n - 1])
    return np.interp(at, time, out)


def known_terms(world: World, station: int, light: Light) -> np.ndarray:
    """Sum [m] of the terms whose rule is that of a camera file; NaN where there is no measurement."""
    total = np.zeros_like(light.distance)
    setting, known = world.settings[station], world.known
    if "amplitude_offset" in known:
        entry = row(known["amplitude_offset"]["hyperbola"], setting)
        with np.errstate(divide="ignore", invalid="ignore"):
            term = entry["a"] / (light.amplitude - entry["b"])
        total = total + np.where(light.amplitude > entry["b"] + 1, term, np.nan)
    if "incidence_angle" in known:
        a1, a2, a3, a4 = row(known["incidence_angle"]["polynomial"], setting)
        x = np.minimum(np.abs(light.angle) * GON, 90)
        total = total - x * (a4 + x * (a3 + x * (a2 + x * a1)))
    if "integration_time_offset" in known:
        total = total + row(known["integration_time_offset"]["offset"], setting)
    if "warm_up_drift" in known:
        for term in known["warm_up_drift"]["terms"]:
            total = total + term["amplitude"] * np.exp(-world.uptime[station] / term["time_constant"])
    if "distance_scale" in known:
        total = total + known["distance_scale"]["scale"] * light.distance
    return total


def hidden_terms(world: World, station: int, light: Light) -> np.ndarray:
    """Sum [m] of the hidden distance terms."""
    total = np.zeros_like(light.distance)
    for name in world.hidden:
        if name in FORMS:
            total = total + world.hidden[name] * FORMS[name](world, station, light)
    return total


def _amplitude(world: World, station: int, light: Light) -> np.ndarray:
    # a power of the amplitude instead of a hyperbola, larger for longer integration
    exponent = world.drawn("amplitude_offset", "exponent")
    level = (world.settings[station] / 60) ** world.drawn("amplitude_offset", "growth")
    return level * (100 / np.maximum(light.amplitude, 5)) ** exponent


def _incidence(world: World, station: int, light: Light) -> np.ndarray:
    # the secant instead of a polynomial in gon
    slant = np.minimum(1 / np.maximum(np.cos(light.angle), 0.15) - 1, 4.0)
    level = (60 / world.settings[station]) ** world.drawn("incidence_angle", "growth")
    return -level * slant


def _setting(world: World, station: int, light: Light) -> np.ndarray:
    offset = world.drawn("integration_time_offset", "offset")[int(world.settings[station])]
    return np.full_like(light.distance, offset)


def _warm_up(world: World, station: int, light: Light) -> np.ndarray:
    shares = world.drawn("warm_up_drift", "shares")
    drift = sum(share * np.exp(-world.uptime[station] / constant) for constant, share in shares)
    return np.full_like(light.distance, drift)


def _air(world: World, station: int, light: Light) -> np.ndarray:
    felt = lagged(world.air_history, world.drawn("ambient_temperature", "lag"), world.uptime)
    return np.full_like(light.distance, felt[station] - 22.0)


def _scale(world: World, station: int, light: Light) -> np.ndarray:
    return light.distance


def _row_brightness(world: World, station: int, light: Light) -> np.ndarray:
    # supply of a row: an offset by its mean amplitude in thousands of counts
    mean = light.amplitude.mean(axis=1, keepdims=True) / 1000
    return np.broadcast_to(mean, light.amplitude.shape).copy()


def _warm_gradient(world: World, station: int, light: Light) -> np.ndarray:
    # a chip that is warmed from one side: a slope along the rows by the temperature of the air
    height, width = light.distance.shape
    slope = np.linspace(-0.5, 0.5, width)[None, :] * np.ones((height, 1))
    felt = lagged(world.air_history, 40.0, world.uptime)
    return (felt[station] - 22.0) * slope


#: Hidden distance terms: metres per unit of strength.
FORMS = {
    "amplitude_offset": _amplitude,
    "incidence_angle": _incidence,
    "integration_time_offset": _setting,
    "warm_up_drift": _warm_up,
    "ambient_temperature": _air,
    "distance_scale": _scale,
    "unknown_row_brightness": _row_brightness,
    "unknown_warm_gradient": _warm_gradient,
}


def response(world: World, amplitude: np.ndarray) -> np.ndarray:
    """Published amplitude of a true one: saturating exponentially where the response is compressed."""
    if "amplitude_nonlinearity" not in world.hidden:
        return amplitude
    limit = 1 / world.hidden["amplitude_nonlinearity"]
    return limit / 2 * (1 - np.exp(-2 * amplitude / limit))


def draw_shape(
    name: str, rng: np.random.Generator, settings: tuple[int, ...], *, hot: bool = False
) -> dict[str, Any]:
    """Parameters of the form of a hidden effect (all but its strength)."""
    if name == "amplitude_offset":
        return {"exponent": rng.uniform(0.85, 1.15), "growth": rng.uniform(0.2, 0.6)}
    if name == "incidence_angle":
        return {"growth": rng.uniform(0.0, 0.4)}
    if name == "integration_time_offset":
        drawn = rng.permutation([-1.0, rng.uniform(-0.4, 0.4), 1.0])
        return {"offset": dict(zip((16, 60, 100), map(float, drawn), strict=True))}
    if name == "warm_up_drift":
        fast, slow = rng.uniform(40, 90), rng.uniform(200, 420)
        return {"shares": [(fast, 0.3), (slow, 0.7)]}
    if name == "ambient_temperature":
        return {"lag": rng.uniform(60, 240)}
    if name == "scattering":
        return {"radius": rng.uniform(3, 9), "exponent": rng.uniform(1.4, 2.0)}
    if name == "emitter_offset":
        # two rows of diodes, seen from the lens in one direction
        centre = np.array([np.cos(turn := rng.uniform(0, 2 * np.pi)), np.sin(turn), rng.uniform(-0.2, 0.2)])
        along = np.array([-centre[1], centre[0], 0.0]) * 0.25
        return {"lamps": [(centre + along).tolist(), (centre - along).tolist()]}
    if name == "cyclic_error":
        turn = rng.uniform(0, 2 * np.pi)
        return {"harmonics": (complex(np.exp(1j * turn)), complex(0.35 * np.exp(1j * rng.uniform(0, 6.28))))}
    if name == "lens_distortion":
        k1 = rng.choice([-1.0, 1.0])
        return {"direction": (k1, -0.35 * k1, rng.uniform(-0.04, 0.04), rng.uniform(-0.04, 0.04), 0.0)}
    if name == "unknown_light_leak":
        centre = rng.uniform(0.35, 0.65, 2)
        return {"ring": (*centre, rng.uniform(0.2, 0.35), rng.uniform(0.06, 0.12), rng.uniform(0, 2 * np.pi))}
    if name == "interference":
        return {"tilt": (rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2))}
    return {}
