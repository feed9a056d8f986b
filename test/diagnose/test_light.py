"""Amplitudes that no effect of the vocabulary describes: surfaces unlike Lambert's, ripples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.forward import Forward
from rim_camera_ros.calibrate.light_curves import DIFFUSE, GLOSS, RIPPLES, SURFACES, LightCurves
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.scene import Geometry, Scene

from ..calibrate.helpers import camera, record, scene

KNOWN = (EmissionPattern((-1.3, 0.7)), CyclicError((Harmonic(4, 0.011, 0.7),)))


def lit(data: Dataset, board: Scene, truth: Camera, factor: object) -> Dataset:
    """The recording with amplitudes times a factor of geometry."""
    views = [one.view.geometry for one in Forward(data, board, truth).predictions(slopes=False)]
    stations = [
        replace(one, amplitude=one.amplitude * np.nan_to_num(factor(geometry), nan=1.0))  # type: ignore[operator]
        for one, geometry in zip(data.stations, views, strict=True)
    ]
    return replace(data, stations=stations)


def oren_nayar(geometry: Geometry, roughness: float = 0.35) -> np.ndarray:
    """Oren & Nayar (1994), their qualitative model with light and view together, over normal incidence."""
    square = roughness**2
    a, b = 1 - 0.5 * square / (square + 0.33), 0.45 * square / (square + 0.09)
    return np.asarray(1 + b / a * np.sin(geometry.incidence) * np.tan(geometry.incidence))


def test_derivatives_of_the_curves(tmp_path: Path) -> None:
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=1, frames=1, seed=3)
    geometry = next(iter(Forward(data, board, truth).predictions(slopes=False))).view.geometry
    rng = np.random.default_rng(4)
    values = {label: float(rng.uniform(-0.05, 0.05)) for label in (*RIPPLES, *SURFACES)}
    curves = LightCurves(values)
    for labels in (RIPPLES, SURFACES):
        for label, column in zip(labels, curves.columns(geometry, 7.5, labels), strict=True):
            step = 1e-6
            up = LightCurves({**values, label: values[label] + step}).factor(geometry, 7.5)
            down = LightCurves({**values, label: values[label] - step}).factor(geometry, 7.5)
            numeric = (np.log(up) - np.log(down)) / (2 * step)
            hit = geometry.hit
            assert column[hit] == pytest.approx(numeric[hit], abs=1e-6), label


def test_ripples_of_the_amplitude_are_no_missing_physics(tmp_path: Path) -> None:
    """Harmonics that bend the distance by 11 mm let the amplitude ripple by 2 pi 0.011 / 7.5 = 0.9 %."""
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)

    def ripple(geometry: Geometry) -> np.ndarray:
        return np.asarray(1 + 0.0092 * np.cos(4 * 2 * np.pi * geometry.distance / 7.4948 + 0.7))

    result = diagnose(lit(record(truth, board, seed=31), board, truth, ripple), board, truth)
    assert result.verdict == "consistent"
    curves = result.final.fit.forward.light_curves
    assert curves is not None
    assert curves.ripple() == pytest.approx(0.0092, abs=0.002)


def test_rough_surfaces_are_named_with_their_curve(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    data = lit(record(truth, board, seed=32), board, truth, oren_nayar)
    result = diagnose(data, board, truth)
    # the distances' noise, which stayed as it was, is that of less light than there is now
    assert result.missing[0].effect == "radiometry"
    assert {one.effect for one in result.missing} <= {"radiometry", "noise"}
    found = result.missing[0].parameters
    angle = np.radians(30.0)
    b_over_a = (0.45 * 0.35**2 / (0.35**2 + 0.09)) / (1 - 0.5 * 0.35**2 / (0.35**2 + 0.33))
    expected = b_over_a * np.sin(angle) * np.tan(angle)
    # relative to normal incidence; for the reference colour both curves add
    diffuse = found["diffuse.30"] + found["gloss.30"] - found["gloss.0"]
    assert diffuse == pytest.approx(expected, abs=0.02)
    assert set(found) == {label.removeprefix("radiometry.") for label in (*DIFFUSE, *GLOSS)}
    assert result.accuracy.chi2_after < 0.9 * result.accuracy.chi2_before
    assert result.accuracy.chi2_after == pytest.approx(1.0, abs=0.05)
    assert "reflect" in result.missing[0].sentence
