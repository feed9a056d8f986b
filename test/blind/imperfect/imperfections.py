"""What every camera and every set-up has: drawn for each recording, each part can be switched off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from .electrons import Sensor
from .geometry import Lens, Placement, Spot, turn
from .scenes import Scene
from .world import World

#: Everything that can be switched off.
PARTS = ("poses", "power", "rho", "gloss", "psf", "pattern", "gains", "constant", "thermometer")
#: What each tier of imperfection switches off.
OFF: dict[str, tuple[str, ...]] = {"ideal": PARTS, "some": ("rho", "gloss", "psf"), "all": ()}

POWER, TILES, GAINS, CONSTANT = 0.015, 0.06, 0.015, 0.0015
SMOOTH, WHITE, COLUMNS = 0.009, 0.0015, 0.001
COMMON = 0.5
THERMOMETER_LAG, THERMOMETER_NOISE, THERMOMETER_PERIOD = 25.0, 0.14, 10.0
DISTORTION = (-0.11, 0.04, 0.0007, -0.0005, 0.0)


@dataclass(frozen=True)
class Stated:
    """What is said of the world, beside the world as it is.

    Reported `places` per station, the `lens` of the camera file with the `covariance` of fx and fy, what
    the `thermometer` read at times (pairs), `power_sigma` and `blur` of the camera file, `noise` model.
    """

    places: list[dict[str, Placement]]
    lens: Lens
    covariance: np.ndarray
    thermometer: tuple[np.ndarray, np.ndarray]
    power_sigma: float
    blur: float | None
    noise: dict[str, float]


def draw_world(scene: Scene, off: tuple[str, ...], rng: np.random.Generator) -> tuple[World, Stated]:
    """A world without hidden effects, and what is said of it."""
    stations = len(scene.places)
    sensor = _sensor(rng)
    height, width = scene.shape
    lens = Lens(
        scene.focal,
        scene.focal * (1 + rng.normal(0, 0.001)),
        width / 2 + rng.uniform(-3, 3),
        height / 2 + rng.uniform(-3, 3),
        DISTORTION,
    )
    settings = rng.permutation(np.resize(scene.settings, stations))
    uptime = rng.uniform(50, 100) + np.concatenate([[0], np.cumsum(rng.uniform(15, 90, stations - 1))])
    air = _air(rng, uptime[-1] + 60)
    world = World(
        scene=scene,
        lens=lens,
        sensor=sensor,
        spot=None if "psf" in off else Spot(rng.uniform(0.85, 1.0), rng.uniform(0.15, 0.25)),
        gain=scene.counts / 60,
        settings=settings,
        power=np.ones(stations) if "power" in off else 1 + rng.normal(0, POWER, stations),
        uptime=uptime,
        air_history=air,
        reflectivity={s.name: _albedo(s.values, "rho" in off, rng) for s in scene.surfaces},
        gloss=(0.0, 1.0) if "gloss" in off else (rng.uniform(0.02, 0.05), rng.uniform(0.15, 0.3)),
        pattern=np.zeros(scene.shape) if "pattern" in off else _pattern(scene.shape, rng),
        gains=np.ones(scene.shape) if "gains" in off else 1 + rng.normal(0, GAINS, scene.shape),
        known=_known(scene, rng),
    )
    said = world.lens
    shared, own = np.sqrt(0.9) * CONSTANT, np.sqrt(0.1) * CONSTANT
    if "constant" not in off:
        common = rng.normal(0, shared)
        said = replace(
            said,
            fx=said.fx * (1 + common + rng.normal(0, own)),
            fy=said.fy * (1 + common + rng.normal(0, own)),
        )
    focal = np.array([said.fx, said.fy])
    covariance = (shared**2 * np.ones((2, 2)) + own**2 * np.eye(2)) * np.outer(focal, focal)
    stated = Stated(
        places=scene.places if "poses" in off else reported(scene, rng),
        lens=said,
        covariance=covariance,
        thermometer=_thermometer(air, "thermometer" in off, rng),
        power_sigma=0.0 if "power" in off else POWER,
        blur=world.spot.blur if world.spot else None,
        noise=sensor.noise_model(),
    )
    return world, stated


def _sensor(rng: np.random.Generator) -> Sensor:
    # a few kinds of sensors, so that the noise of each is measured once
    kind = int(rng.integers(4))
    base = Sensor(
        electrons=(24.0, 26.0, 28.0, 30.0)[kind],
        contrast=(0.85, 0.8, 0.78, 0.75)[kind],
        read=(50.0, 55.0, 60.0, 52.0)[kind],
        dark=(300.0, 400.0, 350.0, 500.0)[kind],
    )
    third = rng.uniform(0.005, 0.011) * np.exp(2j * np.pi * rng.uniform())
    return replace(base, third=complex(third), fifth=complex(0.3 * third * np.exp(1j * rng.uniform(-1, 1))))


def _known(scene: Scene, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Terms of the camera file; the cyclic error is the sensor's, the falloff the scene's."""
    a = {16: 6.0, 60: 12.0, 100: 16.0}
    b = {16: 0.5, 60: 4.0, 100: 2.0}
    vary = float(rng.uniform(0.85, 1.15))
    known: dict[str, dict[str, Any]] = {
        "amplitude_offset": {"hyperbola": {t: {"a": a[t] * vary, "b": b[t]} for t in scene.settings}}
    }
    if len(scene.settings) > 1:
        slope = {16: 5e-4, 60: 3e-4, 100: 2.6e-4}
        known["incidence_angle"] = {"polynomial": {t: [4e-9, -2e-7, 3e-6, slope[t]] for t in scene.settings}}
        offsets = {16: -0.02, 60: -0.004, 100: 0.003}
        known["integration_time_offset"] = {"offset": {t: offsets[t] for t in scene.settings}}
    return known


def _albedo(values: np.ndarray, exact: bool, rng: np.random.Generator) -> np.ndarray:
    if exact:
        return values
    return np.clip(values * (1 + rng.normal(0, TILES, values.shape)), 0.02, 0.99)


def _pattern(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    smooth = gaussian_filter(rng.normal(size=shape), shape[0] / 6, mode="nearest")
    smooth *= SMOOTH / smooth.std()
    columns = rng.normal(0, COLUMNS, shape[1])
    found: np.ndarray = smooth + columns[None, :] + rng.normal(0, WHITE, shape)
    return found


def _air(rng: np.random.Generator, end: float) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(0, end, 1.0)
    period, phase = rng.uniform(500, 1100), rng.uniform(0, 2 * np.pi)
    ramp = rng.choice([-1.0, 1.0]) * rng.uniform(2, 6) * time / end
    return time, 22 + rng.uniform(2, 4) * np.sin(2 * np.pi * time / period + phase) + ramp


def _thermometer(
    air: tuple[np.ndarray, np.ndarray], exact: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    from .forms import lagged

    at = np.arange(0, air[0][-1], THERMOMETER_PERIOD)
    if exact:
        return at, np.interp(at, *air)
    return at, lagged(air, THERMOMETER_LAG, at) + rng.normal(0, THERMOMETER_NOISE, len(at))


def reported(scene: Scene, rng: np.random.Generator) -> list[dict[str, Placement]]:
    """Poses as the reference instrument gives them: half of the variance is common to all stations.

    An error is a shift along the surface's normal and a tilt about each of its two axes.
    """
    sigmas = np.array([scene.pose_sigma[0], scene.pose_sigma[1], scene.pose_sigma[1]])
    common = {s.name: rng.normal(size=3) * sigmas * np.sqrt(COMMON) for s in scene.surfaces}
    found = []
    for places in scene.places:
        station = {}
        for name, place in places.items():
            off = common[name] + rng.normal(size=3) * sigmas * np.sqrt(1 - COMMON)
            station[name] = displaced(place, *(float(value) for value in off))
        found.append(station)
    return found


def displaced(place: Placement, along: float, about_x: float, about_y: float) -> Placement:
    """A place moved along its normal [m] and tilted about its axes [rad]."""
    tilt = turn((1, 0, 0), about_x) @ turn((0, 1, 0), about_y)
    return Placement(place.position - along * place.rotation[:, 2], place.rotation @ tilt)
