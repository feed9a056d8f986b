"""Light by way of what is not in the scene: a phasor that is another in each pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.scene import load_scene

from .helpers import SCENE, camera, record, scene

SIZE = 4.0
PERIOD = 7.49481145


def lit(data: Dataset, phasors: np.ndarray) -> Dataset:
    """The stations with a phasor [counts] each added to all of their pixels."""
    stations = []
    for one, phasor in zip(data.stations, phasors, strict=True):
        seen = one.amplitude > 0
        image = one.amplitude * np.exp(2j * np.pi * one.distance / PERIOD) + phasor
        distance = np.mod(np.angle(image), 2 * np.pi) * PERIOD / (2 * np.pi)
        stations.append(
            replace(
                one,
                distance=np.where(seen, distance, one.distance),
                amplitude=np.where(seen, np.abs(image), one.amplitude),
            )
        )
    return replace(data, stations=stations)


def test_its_stated_size_explains_it(tmp_path: Path) -> None:
    known, board = camera(tmp_path), scene(tmp_path)
    rng = np.random.default_rng(7)
    plain = record(known, board, poses=16, seed=3)
    phasors = SIZE * (rng.standard_normal((16, 2)) @ np.array([1, 1j]))
    data = lit(plain, phasors)
    null = fit(Problem(plain, board), known)
    without = fit(Problem(data, board), known)
    stated = fit(Problem(data, board, stray_light=SIZE), known)
    # two values less a pose
    assert stated.chi_square / stated.rows == pytest.approx(null.chi_square / null.rows, rel=0.02)
    assert without.chi_square > 1.5 * null.chi_square
    found = []
    for one in data.stations:
        real, imaginary = (
            stated.nuisances[f"{one.recording}.{one.pose}.light.{part}.{one.stamp}"]
            for part in ("real", "imaginary")
        )
        found.append(real + 1j * imaginary)
    assert np.std(np.array(found) - phasors) < 0.25 * np.std(phasors)


def test_an_offset_by_amplitude_stays_apart(tmp_path: Path) -> None:
    """Light of poses has no sign that all of them share."""
    board, true = scene(tmp_path), 1.9
    own = AmplitudeOffset({t: Hyperbola(true, 0.0) for t in (16.0, 60.0, 100.0)})
    rng = np.random.default_rng(8)
    phasors = SIZE * (rng.standard_normal((16, 2)) @ np.array([1, 1j]))
    data = lit(record(camera(tmp_path, own), board, poses=16, seed=3), phasors)
    start = camera(tmp_path, AmplitudeOffset({t: Hyperbola(1.0, 0.0) for t in (16.0, 60.0, 100.0)}))
    found = fit(Problem(data, board, stray_light=SIZE), start)
    for t in (16, 60, 100):
        path = f"effects.amplitude_offset.hyperbola.{t}.a"
        assert abs(found.parameters[path] - true) < 3.5 * found.sigma[path]


def test_it_is_no_negative_number(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE + "stray_light: 12.5\n")
    assert load_scene(tmp_path / "scene.yaml").stray_light == 12.5
    (tmp_path / "scene.yaml").write_text(SCENE + "stray_light: -1.0\n")
    with pytest.raises(InputError, match="stray_light"):
        load_scene(tmp_path / "scene.yaml")
