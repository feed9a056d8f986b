"""Large sensors: parameters from every k-th pixel, offsets from all, and what needs all pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.calibrate.large_sensor import LargeSensor
from rim_camera_ros.calibrate.run import Calibration, Request, calibrate
from rim_camera_ros.camera import Camera, Validity
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit import decimation, variance_components
from rim_camera_ros.fit.decimation import decimation_for
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixels import BESIDE
from rim_camera_ros.geometry import beside_edges, see
from rim_camera_ros.parameters import ArrayFile

from .bags import frames, write
from .helpers import camera, record, scene


def given(folder: Path, *, cyclic: float, a: float) -> Camera:
    return camera(
        folder,
        CyclicError((Harmonic(4, cyclic, 0.9),)),
        AmplitudeOffset(MappingProxyType({t: Hyperbola(a, 1.2) for t in (16.0, 60.0, 100.0)})),
    )


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the test's 44 x 36 pixels many, of which every second one in both directions is looked at."""
    monkeypatch.setattr(decimation, "MANY_PIXELS", 500)


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize(
    ("words", "step"),
    [
        (("cyclic_error", "amplitude_offset"), 2),
        (("empirical:amplitude:distance",), 2),
        (("empirical:amplitude:row",), 1),
        (("cyclic_error", "scattering"), 1),
        (("fixed_pattern_offset",), 1),
        (("lens_distortion",), 1),
    ],
)
def test_which_effects_need_all_pixels(tmp_path: Path, words: tuple[str, ...], step: int) -> None:
    assert decimation_for(given(tmp_path, cyclic=0.01, a=9.0), words) == step


@pytest.mark.usefixtures("many")
def test_effects_of_the_file_that_act_on_neighbours_need_all_pixels(tmp_path: Path) -> None:
    own = given(tmp_path, cyclic=0.01, a=9.0)
    own = with_effects(own, {**own.effects, "scattering": Scattering((Kernel(0.02, (5.0, 7.0)),))})
    assert decimation_for(own, ("cyclic_error",)) == 1


def test_small_sensors_are_fitted_whole(tmp_path: Path) -> None:
    assert decimation_for(given(tmp_path, cyclic=0.01, a=9.0), ("cyclic_error",)) == 1


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("few_looks", [False, True])
def test_a_calibration_by_every_second_pixel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, few_looks: bool
) -> None:
    """Also where pixels have so few looks that the size of their offsets is estimated."""
    if few_looks:
        monkeypatch.setattr(variance_components, "FEW_LOOKS", 1000.0)
    true = given(tmp_path, cyclic=0.013, a=22.0)
    v, u = np.mgrid[:36, :44]
    pattern = 0.004 * np.sin(u / 9.0) + 0.003 * (v / 36)
    pattern += 0.002 * np.random.default_rng(6).standard_normal((36, 44))
    effect = FixedPatternOffset(ArrayFile("pattern.npy", pattern.astype(np.float32)))
    true = with_effects(true, {**true.effects, "fixed_pattern_offset": effect})
    bag = write(tmp_path / "bag", frames(true, scene(tmp_path), seed=3))
    start = given(tmp_path, cyclic=0.009, a=15.0)
    asked = ("cyclic_error", "amplitude_offset")
    found: Calibration = calibrate(Request((bag,), start, scene(tmp_path), effects=asked), integral=False)
    assert any("fitted to one of 2 x 2 pixels" in note for note in found.notes)
    path = "effects.cyclic_error.harmonics.0.amplitude"
    harmonic = found.camera.effects["cyclic_error"].harmonics[0]
    assert harmonic.amplitude == pytest.approx(0.013, abs=4 * found.sigma[path])
    # the offsets are those of all pixels
    assert found.camera.shape == (36, 44)
    rest = found.camera.effects["fixed_pattern_offset"].map.values - pattern
    rest = rest - np.median(rest)
    assert np.sqrt(np.median(rest**2)) / 0.6745 < 0.0015
    assert found.pattern_variance.shape == (36, 44)
    region = found.camera.validity.region
    assert region is not None
    assert region[2] > 30
    assert region[3] > 25


@pytest.mark.long
@pytest.mark.usefixtures("many")
def test_a_search_is_by_every_second_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 512 x 424 pixels it did not end in twelve minutes; stray light that it finds is stated for all."""
    monkeypatch.setattr(decimation, "_COARSE_PIXELS", 500)
    start = given(tmp_path, cyclic=0.009, a=15.0)
    true = given(tmp_path, cyclic=0.013, a=15.0)
    true = with_effects(true, {**true.effects, "scattering": Scattering((Kernel(0.08, (6.0, 6.0)),))})
    bag = write(tmp_path / "bag", frames(true, scene(tmp_path), seed=3))
    found = calibrate(Request((bag,), start, scene(tmp_path)), integral=False)
    assert any("fitted to one of 2 x 2 pixels" in note for note in found.notes)
    assert found.camera.shape == (36, 44)
    assert found.found == ["scattering"]
    path = "effects.cyclic_error.harmonics.0.amplitude"
    harmonic = found.camera.effects["cyclic_error"].harmonics[0]  # type: ignore[attr-defined]
    assert harmonic.amplitude == pytest.approx(0.013, abs=4 * found.sigma[path])
    kernels = found.camera.effects["scattering"].kernels  # type: ignore[attr-defined]
    # in addition there may be a wide one of less than a hundredth
    strongest = max(kernels, key=lambda one: one.weight)
    assert strongest.weight == pytest.approx(0.08, rel=0.1)
    # on the grid that was fitted it is 3 px wide
    assert strongest.sigma == pytest.approx((6.0, 6.0), rel=0.1)


def test_what_is_stated_for_the_coarser_grid_is_restated(tmp_path: Path) -> None:
    own, board = given(tmp_path, cyclic=0.01, a=9.0), scene(tmp_path)
    dataset = record(own, board, poses=2, frames=1)
    large = LargeSensor(own, dataset, board, 3)
    small, few = large.coarse
    assert small.shape == (12, 15)
    assert few.stations[1].distance[2, 4] == dataset.stations[1].distance[7, 13]
    paths = ["effects.cyclic_error.gradient.1", "effects.cyclic_error.harmonics.0.amplitude"]
    matrix = large.covariance(paths, np.array([[9.0, 6.0], [6.0, 5.0]]))
    np.testing.assert_allclose(matrix, [[1.0, 2.0], [2.0, 5.0]])
    paths = ["effects.scattering.kernels.0.sigma.1", "effects.scattering.kernels.0.weight"]
    wider = large.covariance([*paths, "effects.mixed_pixels.blur"], np.diag([4.0, 0.5, 0.01]))
    np.testing.assert_allclose(np.diag(wider), [36.0, 0.5, 0.09])
    # pixel 7 stands for 6 to 8; the last one that is looked at for the rim as well
    assert own.shape == (36, 44)
    assert large.validity(Validity(region=(2.0, 1.0, 9.0, 5.0))).region == (6.0, 3.0, 29.0, 17.0)
    assert large.validity(Validity(region=(0.0, 0.0, 14.0, 11.0))).region == (0.0, 0.0, 43.0, 35.0)


def test_edges_are_those_of_the_full_grid(tmp_path: Path) -> None:
    own, board = given(tmp_path, cyclic=0.01, a=9.0), scene(tmp_path)
    dataset = record(own, board, poses=20, frames=1)
    nearest = min(dataset.stations, key=lambda one: one.truth["board"].position[2])
    large = LargeSensor(own, replace(dataset, stations=[nearest]), board, 3)
    small, few = large.coarse
    prediction = next(Forward(few, board, small).predictions(slopes=False))
    geometry = see(board, board.poses_for(nearest.truth), own.rays)
    for margin in (2, 4):
        beside = large.beside_edges(prediction, margin)
        np.testing.assert_array_equal(beside, beside_edges(geometry, margin)[1::3, 1::3])
    # on the coarser grid itself the margin would be three times as wide
    assert large.beside_edges(prediction).sum() < beside_edges(prediction.view.geometry, BESIDE).sum()
