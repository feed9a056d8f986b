"""The compiled kernels against numpy, which computes the same; a build without a compiler."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import Flag, RawFrame, Settings
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.mixed import LEAST_SHARE, LEAST_SIGMAS, LEAST_STEP, mixed_pixels
from rim_camera_ros.pipeline.normals import IncidenceEstimator
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import load_scene

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = Settings(integration_time=100.0, uptime=200.0, ambient_temperature=24.0)
NAME = "rim_camera_ros/pipeline"


def build(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Build the kernels from this source tree into a folder, as an installation does."""
    command = [sys.executable, "setup.py", "-q", "build_ext", "--build-lib", str(folder)]
    return subprocess.run(
        [*command, "--build-temp", str(folder / "objects")],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The kernels, compiled from this source tree."""
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("build")
    done = build(folder)
    assert done.returncode == 0, done.stderr
    library, problem = kernels.load(folder / NAME)
    assert library is not None, f"{problem}\n{done.stderr}"
    assert problem == ""
    return library


def test_without_a_compiler_there_are_no_kernels_and_no_error(tmp_path: Path) -> None:
    done = build(tmp_path, CC="/no/such/compiler")
    assert done.returncode == 0, done.stderr
    assert "/no/such/compiler" in done.stderr
    library, problem = kernels.load(tmp_path / NAME)
    assert library is None
    assert re.fullmatch(
        rf"none were built in {re.escape(str(tmp_path / NAME))} \(sudo apt install build-essential, .*\)",
        problem,
    )


def test_a_library_that_is_none_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / f"_kernels{kernels.EXTENSION_SUFFIXES[0]}"
    path.write_bytes(b"of another machine")
    library, problem = kernels.load(tmp_path)
    assert library is None
    assert re.fullmatch(rf"{re.escape(str(path))}: .* \(build the package again\)", problem)


def test_whether_they_are_used_is_said_in_words(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    library, problem = kernels.load(tmp_path)
    monkeypatch.setattr(kernels, "LIBRARY", library)
    monkeypatch.setattr(kernels, "PROBLEM", problem)
    assert kernels.in_words() == f"compiled kernels are not used: {problem}"
    monkeypatch.setattr(kernels, "LIBRARY", object())
    assert kernels.in_words() == "compiled kernels are used"


def of_size(camera: Camera, width: int, height: int) -> Camera:
    """A camera without what belongs to its own sensor: another size, distances beyond its period."""
    names = ("cyclic_error", "amplitude_offset", "incidence_angle", "distance_scale")
    effects = {name: camera.effects[name] for name in names if name in camera.effects}
    sensor = replace(camera.sensor, width=width, height=height, distance_lsb=0.0005)
    return with_effects(replace(camera, sensor=sensor, covariance=None), effects)


CAMERAS = {
    "every effect": lambda: load_camera(find_camera("sr3000_every_effect")),
    "sr3000": lambda: load_camera(find_camera("sr3000")),
    "another size, no wrapping": lambda: of_size(load_camera(find_camera("sr3000_every_effect")), 61, 47),
    "smaller than a wide window": lambda: of_size(load_camera(find_camera("sr3000")), 12, 9),
}


def room(camera: Camera) -> tuple[Simulation, Exposure]:
    """The furnished room, without what takes long to simulate."""
    effects = {name: one for name, one in camera.effects.items() if name not in ("multipath", "motion")}
    scene = load_scene(find_scene("room"))
    exposure = Exposure(stamp=10**18, settings=SETTINGS, poses=scene.fixed_poses())
    return Simulation(with_effects(camera, effects), scene, seed=5), exposure


def frame_of(camera: Camera) -> RawFrame:
    """A frame with pixels that measured nothing, too little or too much."""
    simulation, exposure = room(camera)
    frame = simulation.frame(exposure)
    rng = np.random.default_rng(8)
    distance, amplitude = frame.distance.copy(), frame.amplitude.copy()
    distance[rng.uniform(size=camera.shape) < 0.01] = 0
    amplitude[rng.uniform(size=camera.shape) < 0.01] = 65535
    amplitude[rng.uniform(size=camera.shape) < 0.01] = 3
    return replace(frame, distance=distance, amplitude=amplitude)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_correction_is_the_same(compiled: Any, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    camera = CAMERAS[name]()
    frame = frame_of(camera)

    def corrected(library: Any) -> Any:
        monkeypatch.setattr(kernels, "LIBRARY", library)
        return Correction(camera).correct(frame)

    plain, fast = corrected(None), corrected(compiled)
    lit = np.isfinite(plain.distance)
    assert lit.mean() > 0.1
    np.testing.assert_array_equal(plain.flags, fast.flags)
    np.testing.assert_array_equal(lit, np.isfinite(fast.distance))
    apart = np.abs(plain.distance - fast.distance)[lit]
    # single precision in another order: 6e-8 of a cosine are 0.3 mrad where a plane is seen perpendicularly;
    # a window whose noise is at a limit may change sides
    assert np.quantile(apart, 0.999) < 5e-5
    assert apart.max() < 2e-3
    np.testing.assert_allclose(fast.amplitude, plain.amplitude, rtol=2e-4)
    sigma = np.abs(fast.sigma / plain.sigma - 1)[lit]
    assert np.quantile(sigma, 0.999) < 1e-3


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_the_angles_are_the_same(compiled: Any, monkeypatch: pytest.MonkeyPatch, sigma: float) -> None:
    camera = load_camera(find_camera("sr3000"))
    rng = np.random.default_rng(4)
    simulation, exposure = room(camera)
    distance = simulation.true_distance(exposure) + sigma * rng.standard_normal(camera.shape)
    distance[rng.uniform(size=camera.shape) < 0.01] = np.nan
    distance = distance.astype(np.float32)
    for noise in (sigma, np.full(camera.shape, sigma, np.float32)):
        monkeypatch.setattr(kernels, "LIBRARY", None)
        plain = IncidenceEstimator(camera.rays).cosine(distance, noise)
        monkeypatch.setattr(kernels, "LIBRARY", compiled)
        fast = IncidenceEstimator(camera.rays).cosine(distance, noise)
        known = np.isfinite(plain)
        assert known.mean() > 0.5
        assert (known == np.isfinite(fast)).mean() > 0.9995
        both = known & np.isfinite(fast)
        assert np.quantile(np.abs(plain - fast)[both], 0.999) < 1e-4


@pytest.mark.parametrize("size", [(40, 51), (7, 9), (5, 30), (30, 4)])
def test_mixed_pixels_are_the_same(
    compiled: Any, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    rng = np.random.default_rng(size[0])
    steps = np.repeat(np.repeat(rng.uniform(1, 4, (6, 8)), 7, axis=0), 7, axis=1)[: size[0], : size[1]]
    distance = np.asarray(steps + 0.01 * rng.standard_normal(steps.shape), np.float32)
    distance[rng.uniform(size=size) < 0.15] = 2.2
    distance[rng.uniform(size=size) < 0.05] = np.nan
    sigma = rng.uniform(0.001, 0.06, size).astype(np.float32)
    expected = mixed_pixels(distance, sigma) & np.isfinite(distance)
    monkeypatch.setattr(kernels, "LIBRARY", compiled)
    flags = np.full(size, Flag.OUTSIDE_CALIBRATION.value, np.uint8)
    kernels.judge(
        distance,
        sigma,
        flags,
        amplitude=np.ones(size, np.float32),
        gain=None,
        slope=None,
        cosine=None,
        always=None,
        minimum=0.0,
        spread=0.0,
        limits=(0.0, 9.0),
        mixed=(LEAST_STEP, LEAST_SIGMAS, LEAST_SHARE),
        everywhere=0,
    )
    assert (flags & Flag.OUTSIDE_CALIBRATION.value).all()
    np.testing.assert_array_equal((flags & Flag.NO_MEASUREMENT.value) > 0, np.isnan(distance))
    np.testing.assert_array_equal((flags & Flag.MIXED_PIXEL.value) > 0, expected)
    assert expected.any() or size != (40, 51)
