"""The contract of a way of measuring, held by a shipped camera of each."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.devices.simulator import Simulator
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import INVALID, Pose, RawFrame, Settings
from rim_camera_ros.info.camera import camera_facts, camera_text
from rim_camera_ros.measurement import FrameSimulation, measurement_of
from rim_camera_ros.pipeline.simulate import Exposure
from rim_camera_ros.scene import Scene, load_scene

CAMERAS = ("pmd3ks", "azure_kinect", "kinect_v2", "epfl32", "gated")
SCENE = """
format: rim_scene/1
surfaces:
- {name: wall, type: plane, pose: truth, reflectivity: 0.6}
- {name: box, type: rectangle, size: [0.31, 0.44], reflectivity: 0.35,
   pose: {position: [0.1, -0.05, 1.3], orientation: [0, 0, 0, 1]}}
"""


@pytest.fixture(scope="module", params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> Camera:
    return load_camera(find_camera(request.param))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("scene") / "scene.yaml"
    path.write_text(SCENE)
    return load_scene(path)


def exposure(scene: Scene, camera: Camera, *, z: float = 1.9, stamp: int = 10**9) -> Exposure:
    time = camera.sensor.integration_time or 100.0
    settings = Settings(integration_time=time, uptime=5e4, ambient_temperature=20.0)
    return Exposure(stamp=stamp, settings=settings, poses=scene.poses_for({"wall": Pose((0.0, 0.0, z))}))


def simulation(camera: Camera, scene: Scene, **options: int) -> FrameSimulation:
    return measurement_of(camera).simulation(camera, scene, **options)


@pytest.fixture(scope="module")
def frame(camera: Camera, scene: Scene) -> RawFrame:
    return simulation(camera, scene, seed=4).frame(exposure(scene, camera))


def test_a_frame_has_the_images_that_are_announced(camera: Camera, frame: RawFrame) -> None:
    roles = measurement_of(camera).image_roles(camera)
    assert tuple(frame.by_role)[: len(roles)] == roles
    for role in roles:
        assert frame.by_role[role].shape == camera.shape
        assert frame.by_role[role].dtype == np.uint16
    assert frame.intrinsics == camera.intrinsics


def test_a_seed_makes_the_same_frame_again_and_another_seed_another(
    camera: Camera, scene: Scene, frame: RawFrame
) -> None:
    again, other = (simulation(camera, scene, seed=one).frame(exposure(scene, camera)) for one in (4, 5))
    for role, image in frame.by_role.items():
        assert np.array_equal(again.by_role[role], image)
        assert not np.array_equal(other.by_role[role], image)


def test_errors_are_as_large_as_sigma_says(camera: Camera, scene: Scene, frame: RawFrame) -> None:
    ideal = replace(camera, effects={}, channels=tuple(replace(one, effects={}) for one in camera.channels))
    shown = simulation(ideal, scene, seed=4)
    found = measurement_of(ideal).correction(ideal).correct(shown.frame(exposure(scene, ideal)))
    truth = shown.true_distance(exposure(scene, ideal))
    # pixels that hold one surface
    error = ((found.distance - truth) / found.sigma)[np.isfinite(found.distance)]
    assert error.size > 0.5 * truth.size
    spread = 1.4826 * np.median(np.abs(error - np.median(error)))
    assert spread == pytest.approx(1.0, abs=max(0.06, 4 / np.sqrt(error.size)))
    assert abs(np.median(error)) < max(0.15, 5 / np.sqrt(error.size))


def test_what_has_no_distance_is_flagged(camera: Camera, frame: RawFrame) -> None:
    correction = measurement_of(camera).correction(camera)
    found = correction.correct(frame)
    invalid = (found.flags & np.uint8(INVALID.value)) != 0
    for image in (found.distance, found.sigma):
        assert image.dtype == np.float32
        assert np.array_equal(np.isnan(image), invalid)
    assert np.all(found.sigma[~invalid] > 0)
    points = correction.cloud(found)
    assert np.allclose(
        np.linalg.norm(points[..., :3], axis=-1)[~invalid], found.distance[~invalid], rtol=1e-5
    )
    assert np.allclose(correction.depth(found), points[..., 2], equal_nan=True)


def test_a_frame_without_light_has_no_distance(camera: Camera, frame: RawFrame) -> None:
    zero = {one: np.zeros_like(image) for one, image in frame.images.items()}
    dark = replace(
        frame, distance=np.zeros_like(frame.distance), amplitude=np.zeros_like(frame.amplitude), images=zero
    )
    found = measurement_of(camera).correction(camera).correct(dark)
    assert np.isnan(found.distance).all()
    assert np.all(found.flags & np.uint8(INVALID.value))


def test_the_distance_alone_is_that_of_the_whole_correction(camera: Camera, frame: RawFrame) -> None:
    correction = measurement_of(camera).correction(camera)
    whole, alone = correction.correct(frame), correction.correct_distance(frame)
    both = np.isfinite(whole.distance)
    assert np.allclose(alone.distance[both], whole.distance[both], atol=1e-5)
    assert np.allclose(alone.amplitude[both], whole.amplitude[both], rtol=1e-5)


def test_a_recording_keeps_every_image(camera: Camera, frame: RawFrame, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write_raw(frame)
    with Recording(tmp_path / "bag") as bag:
        assert bag.frame_count == 1
        (read,) = bag.frames()
    assert tuple(read.by_role) == tuple(frame.by_role)
    for role, image in frame.by_role.items():
        assert np.array_equal(read.by_role[role], image)
    assert read.settings.integration_time == frame.settings.integration_time


def test_a_device_announces_the_images_of_its_frames(camera: Camera, scene: Scene, frame: RawFrame) -> None:
    fixed = replace(scene, surfaces=scene.surfaces[1:])
    device = Simulator(fixed, camera, real_time=False, start=10**9, integration_time=100.0)
    device.open()
    try:
        shown = device.next_frame()
    finally:
        device.close()
    assert shown is not None
    assert device.image_roles == tuple(shown.by_role)[: len(device.image_roles)]


def test_a_camera_file_is_read_as_it_was_written(camera: Camera, tmp_path: Path) -> None:
    save_camera(camera, tmp_path / "camera.yaml")
    read = load_camera(tmp_path / "camera.yaml")
    for one in fields(Camera):
        assert getattr(read, one.name) == getattr(camera, one.name), one.name


def test_the_parts_make_the_camera_again(camera: Camera) -> None:
    measurement = measurement_of(camera)
    parts = measurement.parts(camera)
    joined = measurement.joined(camera, tuple(one.camera for one in parts))
    assert [one.camera.sensor for one in measurement.parts(joined)] == [one.camera.sensor for one in parts]
    assert [dict(one.camera.effects) for one in measurement.parts(joined)] == [
        dict(one.camera.effects) for one in parts
    ]
    assert (joined.device, joined.optics, joined.measurement) == (
        camera.device,
        camera.optics,
        camera.measurement,
    )


def test_info_says_how_the_camera_measures(camera: Camera) -> None:
    text = camera_text(camera_facts(camera))
    assert camera.device in text
    assert "sensor" in text


@pytest.mark.parametrize("name", ["azure_kinect", "kinect_v2", "epfl64", "epfl32", "gated"])
def test_every_number_has_a_source_or_a_reason(name: str) -> None:
    """Beside it, or above its group: a bare "assumed" is none."""
    lines = find_camera(name).read_text().splitlines()
    bare = [one for one in lines if re.search(r"assumed\W*$", one)]
    assert bare == []
    section = {"sensor", "optics", "radiometry", "noise", "measurement"}
    inside = commented = False
    for line in lines:
        key = re.match(r"(\w+):", line)
        if key:
            inside = key[1] in section
            commented = "#" in line
        elif inside and re.match(r"\s+#", line):
            commented = True
        elif inside and re.search(r": .*\d", line) and "#" not in line and not commented:
            raise AssertionError(f"no source: {line}")
