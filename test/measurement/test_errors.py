"""Errors of every way of measuring: none without noise, and with it as large as sigma says."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.measurement import TYPES, measurement_of
from rim_camera_ros.scene import Scene, ScenePose, Surface

#: A camera of every way of measuring, and the distance of a wall [m] that it measures well.
CAMERAS = {"pmd3ks": 2.1, "azure_kinect": 2.1, "epfl32": 1.3, "gated": 1.7}
START = 5_000_000_000


def small(name: str) -> Camera:
    """Return the middle of a shipped camera, without what departs from pixel to pixel or with time."""
    camera = with_effects(load_camera(find_camera(name)), {})
    width, height = 20, 14
    sensor = replace(camera.sensor, width=width, height=height)
    optics = replace(camera.optics, cx=9.5, cy=6.5)
    return replace(camera, sensor=sensor, optics=optics, covariance=None)


def wall(distance: float, reflectivity: float = 0.8) -> Scene:
    pose = ScenePose((0.0, 0.0, distance), (0.0, 0.0871557, 0.0, 0.9961947))  # 10 degrees
    return Scene((Surface(name="wall", type="plane", pose=pose, reflectivity=reflectivity),))


def frames(camera: Camera, scene: Scene, count: int, **options: object) -> list[RawFrame]:
    simulation = measurement_of(camera).simulation(camera, scene, **options)  # type: ignore[arg-type]
    return [simulation.frame(one) for one in islice(Timeline(scene, camera, start=START), count)]


def truth(camera: Camera, scene: Scene) -> np.ndarray:
    simulation = measurement_of(camera).simulation(camera, scene)
    exposure = next(iter(Timeline(scene, camera, start=START)))
    return simulation.true_distance(exposure)


def test_every_way_has_a_camera_here() -> None:
    ways = {measurement_of(load_camera(find_camera(name))).type for name in CAMERAS}
    assert ways == {*TYPES, "one_frequency"}


@pytest.fixture(params=CAMERAS, ids=str)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_without_noise_the_distance_is_the_true_one(name: str) -> None:
    camera, scene = small(name), wall(CAMERAS[name])
    (frame,) = frames(camera, scene, 1, noise=False, quantised=False)
    corrected = measurement_of(camera).correction(camera).correct(frame)
    assert np.abs(corrected.distance - truth(camera, scene)).max() < 0.0003


def test_sigma_is_the_scatter_of_the_frames(name: str) -> None:
    camera, scene = small(name), wall(CAMERAS[name])
    correction = measurement_of(camera).correction(camera)
    corrected = [correction.correct(one) for one in frames(camera, scene, 40, seed=5)]
    distance = np.array([one.distance for one in corrected])
    scatter = np.sqrt(np.mean(distance.var(axis=0, ddof=1)))
    stated = np.sqrt(np.mean([one.sigma**2 for one in corrected]))
    # 40 frames of 280 pixels: a standard deviation to 0.7 %
    assert scatter == pytest.approx(stated, rel=0.04)
    bias = distance.mean(axis=0) - truth(camera, scene)
    assert abs(bias.mean()) < 4 * scatter / np.sqrt(distance.size)


def test_what_a_device_does_not_deliver_is_not_missed(name: str) -> None:
    """Samples are for who asks: without them distances are as good, but for each frame's own sigma."""
    camera, scene = small(name), wall(CAMERAS[name])
    (frame,) = frames(camera, scene, 1, seed=7)
    correction = measurement_of(camera).correction(camera)
    alone = {role: one for role, one in frame.images.items() if role not in measurement_of(camera).samples}
    whole, bare = correction.correct(frame), correction.correct(replace(frame, images=alone))
    assert np.allclose(whole.distance, bare.distance, atol=2 * camera.sensor.lsb)
    assert np.sqrt(np.mean(bare.sigma**2)) == pytest.approx(np.sqrt(np.mean(whole.sigma**2)), rel=0.15)
