"""Two paths in one pixel: none where there are none, and both with a sigma that holds where there are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.pipeline.several_frequencies import ResolvedFrame, SeveralCorrections

SHAPE = (24, 40)
CAMERA = """
format: rim_camera/1
device: four
sensor: {width: 40, height: 24, modulation_frequency: [80.0e6, 16.0e6, 120.0e6, 56.0e6]}
optics: {fx: 60.0, fy: 60.0, cx: 19.2, cy: 11.6}
radiometry: {gain: [500.0, 610.0, 420.0, 540.0]}
noise: {floor: 0.0, amplitude: [0.6, 2.0, 0.5, 0.8]}
measurement: {type: several_frequencies, range: [0.3, 9.0], two_paths: true}
"""
C = 299_792_458.0


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return load_camera(tmp_path / "camera.yaml")


def frame_of(
    camera: Camera, distance: np.ndarray, *, second: float, detour: np.ndarray, seed: int
) -> RawFrame:
    """Phasors of two paths with circular noise, in metres and counts: an independent generator."""
    rng, images = np.random.default_rng(seed), {}
    for i, one in enumerate(camera.channels):
        k = 4 * np.pi * one.sensor.modulation_frequency / C
        light = 4.0 * one.radiometry.gain * np.exp(1j * k * distance) * (1 + second * np.exp(1j * k * detour))
        # sigma_d = amplitude / A is A k sigma_d = k * amplitude in each direction of the complex plane
        noise = k * one.noise.amplitude * (rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE))
        light = light + noise
        images[f"distance_{i}"] = np.mod(np.angle(light) / k, 2 * np.pi / k).astype(np.float32)
        images[f"amplitude_{i}"] = np.abs(light).astype(np.float32)
    first = {kind: images.pop(f"{kind}_0") for kind in ("distance", "amplitude")}
    return RawFrame(stamp=10**9, images=images, **first)


@pytest.fixture
def distance() -> np.ndarray:
    return np.random.default_rng(6).uniform(1.0, 6.0, SHAPE)


def test_one_path_stays_one(camera: Camera, distance: np.ndarray) -> None:
    """A pixel in ten thousand is taken for two by chance."""
    frame = frame_of(camera, distance, second=0.0, detour=np.zeros(SHAPE), seed=1)
    found = SeveralCorrections(camera).correct(frame)
    assert isinstance(found, ResolvedFrame)
    assert found.two_paths is not None
    assert found.two_paths.sum() <= 3
    assert np.std((found.distance - distance) / found.sigma) == pytest.approx(1.0, abs=0.1)


def test_a_second_path_is_separated_from_the_first(camera: Camera, distance: np.ndarray) -> None:
    detour = np.random.default_rng(7).uniform(0.6, 2.0, SHAPE)
    frame = frame_of(camera, distance, second=0.3, detour=detour, seed=2)
    found = SeveralCorrections(camera).correct(frame)
    assert isinstance(found, ResolvedFrame)
    assert found.two_paths is not None
    settled = found.two_paths
    assert settled.mean() > 0.9
    error = (found.distance - distance)[settled]
    normal = error / found.sigma[settled]
    assert 1.4826 * np.median(np.abs(normal - np.median(normal))) == pytest.approx(1.0, abs=0.15)
    one = SeveralCorrections(_of_one_path(camera)).correct(frame)
    before = (one.distance - distance)[settled]
    assert np.sqrt(np.nanmedian(before**2)) > 5 * np.sqrt(np.median(error**2))


def _of_one_path(camera: Camera) -> Camera:
    return replace(camera, measurement=replace(camera.measurement, two_paths=False))
