"""The watch on a camera's noise: silent while it matches its file, at rest and in motion, else not."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.simulator import Simulator
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.noise import sigma_amplitude
from rim_camera_ros.pipeline.consistency import NoiseWatch
from rim_camera_ros.scene import CameraMotion, load_scene

CAMERA = load_camera(find_camera("sr3000"))


def watched(scene: str, *, file: Any = CAMERA, true: Any = None, speed: float = 0.0) -> NoiseWatch:
    """Return the watch with ``file`` after twelve frames of the ``true`` camera."""
    description = load_scene(find_scene(scene))
    if speed:
        motion = CameraMotion(linear=(0.1 * speed, 0.0, 0.5 * speed), angular=(0.0, 0.5 * speed, 0.0))
        description = replace(description, camera_motion=motion)
    simulator = Simulator(description, true or file, seed=4, real_time=False, repeat=True)
    simulator.open()
    watch = NoiseWatch(file)
    for _ in range(12):
        frame = simulator.next_frame()
        assert frame is not None
        watch.take(frame)
    return watch


@pytest.mark.parametrize(
    ("scene", "camera"),
    [
        ("room", "sr3000"),
        ("wall", "sr3000"),
        ("corner", "sr3000"),
        ("room", "sr2"),
        ("room", "pmd3ks"),
    ],
)
def test_a_camera_that_matches_its_file(scene: str, camera: str) -> None:
    verdict = watched(scene, file=load_camera(find_camera(camera))).verdict
    assert verdict is not None
    assert verdict.matches
    # one distance of 5,000 to 25,000 pixels: the median is good to about one percent
    assert verdict.ratio == pytest.approx(1.0, abs=0.03)
    assert verdict.dark == pytest.approx(1.0, abs=0.06)
    assert verdict.bright == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("speed", [0.02, 0.1, 1.0])
def test_a_camera_that_moves_is_not_taken_for_a_noisy_one(speed: float) -> None:
    verdict = watched("room", speed=speed).verdict
    assert verdict is None or verdict.matches


@pytest.mark.parametrize("factor", [0.6, 1.5, 3.0])
def test_another_noise_is_found_with_its_factor(factor: float) -> None:
    noise = CAMERA.noise
    louder = replace(
        CAMERA, noise=replace(noise, floor=factor * noise.floor, amplitude=factor * noise.amplitude)
    )
    verdict = watched("room", true=louder).verdict
    assert verdict is not None
    assert not verdict.matches
    assert verdict.ratio == pytest.approx(factor, rel=0.05)


def test_noise_of_bright_pixels_alone_is_found() -> None:
    floor = replace(CAMERA, noise=replace(CAMERA.noise, floor=6 * CAMERA.noise.floor))
    verdict = watched("room", true=floor).verdict
    assert verdict is not None
    assert not verdict.matches
    assert verdict.bright > 1.25 * verdict.dark


def test_what_cannot_be_compared_is_not() -> None:
    simulator = Simulator(load_scene(find_scene("wall")), CAMERA, real_time=False, repeat=True)
    simulator.open()
    first, second = simulator.next_frame(), simulator.next_frame()
    assert first is not None
    assert second is not None
    watch = NoiseWatch(CAMERA)
    assert not watch.take(first)
    assert watch.take(second)
    assert not watch.take(first)  # stamps that go back
    assert not watch.take(replace(second, stamp=second.stamp + 2 * 10**9))  # frames between them are missing
    other = replace(second.settings, integration_time=60.0)
    assert not watch.take(replace(second, stamp=second.stamp + 2 * 10**9 + 1, settings=other))
    assert not watch.take(replace(second, distance=np.zeros((2, 2), np.uint16)))
    assert watch.verdict is None  # one comparison is no verdict


def test_pixels_without_light_warn_nobody() -> None:
    """A board in the dark: most pixels read an amplitude of 0, whose noise is not known."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        verdict = watched("board_by_hand_experiment").verdict
    assert verdict is None or verdict.matches


def test_noise_of_an_amplitude_is_circular_and_unknown_without_light() -> None:
    sigma = CAMERA.noise.sigma_distance(np.array([0.0, 400.0]))
    found = sigma_amplitude(sigma, np.array([0.0, 400.0]), ambiguity=7.5)
    assert np.isnan(found[0])
    # a turn of the phase is 2 pi sigma_d / R
    assert found[1] == pytest.approx(2 * np.pi / 7.5 * 400.0 * np.hypot(0.0045, 28.0 / 400.0), rel=1e-6)
