"""An effect of another package: simulated, searched, fitted, corrected, reported like the others."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros import effects
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.effects import ComplexEffect, DistanceTerm, Effect
from rim_camera_ros.effects.base import Dependency
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.frame import Settings
from rim_camera_ros.parameters import quantity
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.reports.curves import effect_panels
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene


@dataclass(frozen=True)
class BrightDelay(DistanceTerm):
    """+ strength * sqrt(A): bright pixels are read late. No built-in effect has this form."""

    name = "bright_delay"
    title = "bright pixels are read late"
    observable = "patches of different reflectivity side by side on one plane"
    refuted_by = "bright and dark patches at the same distance"
    drawn_over = ("amplitude",)

    strength: float = quantity("m/counts^0.5", "of the square root", typical=1e-4)

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"amplitude"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return self.strength * np.sqrt(np.maximum(amplitude, 0.0))

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        return {"strength": (np.sqrt(np.maximum(signal.amplitude, 0.0)), 0.0)}

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(0.0), {"strength": 3e-4})]

    def sentence(self) -> str:
        return f"bright delay: {1e3 * self.strength * 100:.1f} mm at 10,000 counts"

    @classmethod
    def example(cls, camera: Camera) -> BrightDelay:
        return cls(2e-4)


@dataclass(frozen=True)
class LightLeak(ComplexEffect):
    """S + leak: light that reaches every pixel by a way inside the camera of no length."""

    name = "light_leak"
    title = "light that reaches every pixel inside the camera"
    observable = "dark targets at several distances"
    refuted_by = "a dark target at the same distance as a bright one"

    leak: float = quantity("counts", "in phase with the emitter", minimum=0.0, typical=10.0)

    def apply(self, phasor: Image, context: Context) -> Image:
        return phasor + self.leak

    def invert(self, phasor: Image, context: Context) -> Image:
        return phasor - self.leak

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        return {"leak": np.ones_like(phasor)}

    def sentence(self) -> str:
        return f"light leak: {self.leak:.3g} counts reach every pixel inside the camera"

    @classmethod
    def example(cls, camera: Camera) -> LightLeak:
        return cls(12.0)


@dataclass(frozen=True)
class _EntryPoint:
    name: str
    kind: type[Effect]

    def load(self) -> type[Effect]:
        return self.kind


@pytest.fixture
def _installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def entry_points(*, group: str) -> list[_EntryPoint]:
        assert group == "rim_camera_ros.effects"
        return [_EntryPoint(one.name, one) for one in (BrightDelay, LightLeak)]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(effects, "entry_points", entry_points)
    effects.registry.cache_clear()
    yield
    effects.registry.cache_clear()


@pytest.mark.usefixtures("_installed")
def test_an_effect_of_another_package_is_found_and_fitted(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    truth = camera(tmp_path, BrightDelay(2.3e-4))
    data = record(truth, board)
    problem = Problem(data, board)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    rivals = ["amplitude_offset", "cyclic_error", "distance_scale", "incidence_angle", BrightDelay.name]
    result = search(problem, stated, facts, effects=rivals)
    assert [one.effect for one in result.found] == [BrightDelay.name]
    fitted = result.camera.effects[BrightDelay.name]
    assert isinstance(fitted, BrightDelay)
    sigma = result.explorations[-1].fit.sigma[f"effects.{BrightDelay.name}.strength"]
    assert abs(fitted.strength - 2.3e-4) < 3.5 * sigma
    assert sigma < 2e-5
    # among the ranks of a first exploration as every other effect, and not found where it is not
    assert BrightDelay.name in result.explorations[0].best()
    nothing = search(Problem(record(stated, board, seed=3), board), stated, facts, effects=rivals)
    assert nothing.found == []


@pytest.mark.usefixtures("_installed")
def test_an_effect_of_another_package_is_corrected_and_kept_in_files(tmp_path: Path) -> None:
    truth = replace(camera(tmp_path, BrightDelay(2.3e-4)), minimum_amplitude=0.0)
    board = scene(tmp_path)
    path = tmp_path / "with_delay.yaml"
    save_camera(truth, path)
    assert load_camera(path).effects[BrightDelay.name] == BrightDelay(2.3e-4)
    pose = record(truth, board, poses=1, frames=1, wrong=0.0).stations[0].truth
    simulation = Simulation(truth, board, noise=False, quantised=False)
    exposure = Exposure(0, Settings(integration_time=60.0), pose)
    frame, true = simulation.frame(exposure), simulation.true_distance(exposure)
    assert np.nanmax(frame.distance - true) == pytest.approx(
        2.3e-4 * np.sqrt(frame.amplitude.max()), rel=1e-6
    )
    for exact in (True, False):
        found = Correction(truth, exact=exact).correct(frame)
        np.testing.assert_allclose(found.distance, true, atol=1e-6 if exact else 5e-5)
        without = Correction(truth, without=[BrightDelay.name], exact=exact).correct(frame)
        assert np.nanmedian(without.distance - true) > 0.002


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize("exact", [True, False])
def test_light_that_another_package_adds_is_taken_off_before_the_stray_light(
    tmp_path: Path, exact: bool
) -> None:
    """It acts after the built-in effects on the light, so that it is undone before them."""
    stray = Scattering((Kernel(0.03, (2.3, 3.1)),))
    truth = replace(camera(tmp_path, stray, LightLeak(9.0)), minimum_amplitude=0.0)
    board = scene(tmp_path)
    pose = record(truth, board, poses=1, frames=1, wrong=0.0).stations[0].truth
    simulation = Simulation(truth, board, noise=False, quantised=False)
    exposure = Exposure(0, Settings(integration_time=60.0), pose)
    frame, true = simulation.frame(exposure), simulation.true_distance(exposure)
    found = Correction(truth, exact=exact).correct(frame).distance
    np.testing.assert_allclose(found, true, atol=1e-6 if exact else 1e-4)
    without = Correction(truth, without=[LightLeak.name], exact=exact).correct(frame).distance
    assert np.abs(without - true).max() > 0.02


@pytest.mark.usefixtures("_installed")
def test_an_effect_of_another_package_is_drawn_with_its_uncertainty(tmp_path: Path) -> None:
    own = camera(tmp_path, BrightDelay(2.3e-4))
    path = f"effects.{BrightDelay.name}.strength"
    (panel,) = effect_panels(own, [path], np.array([[1e-10]]))
    (curve,) = panel.curves
    assert panel.title == BrightDelay.title
    np.testing.assert_allclose(curve.y, 0.23 * np.sqrt(curve.x), rtol=1e-9)
    assert curve.sigma is not None
    np.testing.assert_allclose(curve.sigma, 0.01 * np.sqrt(curve.x), rtol=1e-4)
