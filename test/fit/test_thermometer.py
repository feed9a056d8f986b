"""A thermometer that lags behind the air: what it makes of the coefficient and the lag of a camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects import ambient_temperature
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.files import find_camera
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Readings, Settings

from ..calibrate.helpers import camera, record, scene

#: m/degC, s, and the lag of the thermometer [s].
COEFFICIENT, LAG, THERMOMETER = -0.0055, 210.0, 40.0
PATHS = [f"effects.ambient_temperature.{name}" for name in ("coefficient", "time_constant")]


def air(t: np.ndarray | float) -> np.ndarray | float:
    return 22.0 + 3.0 * np.sin(2 * np.pi * np.asarray(t) / 760.0 + 0.7) + 0.002 * np.asarray(t)


def behind(seconds: float, at: np.ndarray) -> np.ndarray:
    """A body that follows the air with a first-order lag."""
    start = float(air(0.0))
    solved = solve_ivp(
        lambda t, y: (air(t) - y) / seconds,
        (0.0, float(at[-1])),
        [start],
        t_eval=at,
        rtol=1e-9,
        atol=1e-9,
        max_step=5.0,
    )
    return np.asarray(solved.y[0])


def recording(tmp_path: Path, seed: int) -> Dataset:
    """Stations whose distances follow a body that the lagging thermometer does not measure."""
    data = record(camera(tmp_path), scene(tmp_path), seed=seed)
    times = np.array([one.stamp * 1e-9 for one in data.stations])
    shifts = COEFFICIENT * (behind(LAG, times) - 22.0)
    at = np.arange(0.0, times[-1] + 10.0, 10.0)
    readings = Readings()
    random = np.random.default_rng([seed, 5])
    for t, value in zip(at, behind(THERMOMETER, at), strict=True):
        readings.add(round(t * 1e9), float(value + 0.05 * random.standard_normal()))
    stations = [
        replace(
            one,
            distance=one.distance + shift,
            settings=replace(one.settings, ambient_temperature=20.0, ambient_readings=readings),
        )
        for one, shift in zip(data.stations, shifts, strict=True)
    ]
    return replace(data, stations=stations)


def errors(tmp_path: Path, seed: int) -> np.ndarray:
    """Errors of coefficient and lag, in the sigmas that the fit states."""
    start = camera(tmp_path, AmbientTemperature(COEFFICIENT, 22.0, 150.0))
    fitted = fit(Problem(recording(tmp_path, seed), scene(tmp_path)), start)
    found = [fitted.parameters[one] - true for one, true in zip(PATHS, (COEFFICIENT, LAG), strict=True)]
    return np.array(found) / [fitted.sigma[one] for one in PATHS]


def test_its_lag_is_part_of_the_uncertainty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_lag = np.abs([errors(tmp_path, seed) for seed in range(3)])
    assert with_lag.max() < 2.6
    monkeypatch.setattr(ambient_temperature, "_THERMOMETER_LAG", 1e-3)
    exact = np.abs([errors(tmp_path, seed) for seed in range(3)])
    assert exact.max() > 3.0
    assert (exact.mean(axis=0) > with_lag.mean(axis=0)).all()


def test_what_the_lag_does_is_a_finite_difference() -> None:
    """Of the readings themselves, moved by lag times their rate."""
    seconds = np.arange(0.0, 900.0, 1.0)
    rate = np.gradient(air(seconds), seconds)
    effect = AmbientTemperature(COEFFICIENT, 22.0, LAG)
    found = []
    for lag in (0.0, 1.0):
        readings = Readings()
        for t, value in zip(seconds, air(seconds) + lag * rate, strict=True):
            readings.add(round(t * 1e9), float(value))
        found.append([value_at(effect, readings, t) for t in (300.0, 620.0, 899.0)])
    zero, one = np.array(found)
    # the moved readings begin elsewhere by the first rate, which the body forgets
    start = COEFFICIENT * rate[0] * np.exp(-np.array([300.0, 620.0, 899.0]) / LAG)
    assert zero[:, 1] == pytest.approx(one[:, 0] - zero[:, 0] - start, rel=0.02)


def value_at(effect: AmbientTemperature, readings: Readings, seconds: float) -> tuple[float, float]:
    """What the effect does, and its derivative by the thermometer's lag."""
    here = Context(
        camera=load_camera(find_camera("sr3000")),
        settings=Settings(ambient_temperature=20.0, ambient_readings=readings),
        stamp=round(seconds * 1e9),
    )
    nothing = np.zeros((1, 1))
    return float(effect.term(nothing, nothing, here)), float(effect.sensor_columns(here)["lag"][0])
