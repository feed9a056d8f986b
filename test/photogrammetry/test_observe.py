"""Targets read from recorded frames: identification, what is excluded, and the optics that come of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Optics
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.optics import project
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.photogrammetry import estimate_optics, observe
from rim_camera_ros.photogrammetry.projection import ellipse_centre_offset
from rim_camera_ros.photogrammetry.scene_field import FieldOnSurfaces
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, ScenePose, Surface, Texture

from .helpers import (
    RADIUS,
    SR3000,
    area_sampled,
    camera,
    disc,
    exposure,
    field,
    labelled_plate,
    stations,
    vector,
)

FRONTAL = Pose((0.0, 0.0, 1.5))


def recorded(poses: dict[int, Pose], *, frames: int = 4, first: int = 1) -> list[RawFrame]:
    """Frames of the labelled plate as the simulator makes them, a ray through each pixel's centre."""
    result = []
    for station, pose in poses.items():
        scene = labelled_plate(pose, field())
        simulation = Simulation(camera(), scene, seed=station)
        start = (first + station * 100) * 10**8
        for i in range(frames):
            at = start + i * 10**8
            result.append(simulation.frame(exposure(scene, stamp=at, station=station, pose_stamp=start)))
    return result


def expected_centres(pose: Pose) -> dict[str, np.ndarray]:
    rotation = rotation_matrix(pose.orientation)
    targets = field()
    there = targets.positions @ rotation.T + pose.position
    normals = np.tile(rotation[:, 2], (len(there), 1))
    image = project(SR3000, there) + ellipse_centre_offset(
        SR3000, there, normals, np.full(len(there), RADIUS)
    )
    return dict(zip(targets.targets, image, strict=True))


def test_circles_are_identified_and_stations_distinguished() -> None:
    """The camera's principal point is wrong by 3 px and its focal length by 2 %."""
    poses = dict(enumerate(list(stations(np.random.default_rng(4)).values())[:3]))
    wrong = camera(Optics(fx=204.0, fy=204.0, cx=92.5, cy=80.0))
    found = observe(recorded(poses), wrong, labelled_plate(FRONTAL, field()))
    assert {one.station for one in found.points} == {0, 1, 2}
    assert len(found.points) > 45
    for one in found.points:
        u, v = expected_centres(poses[one.station])[one.target]
        assert np.hypot(one.u - u, one.v - v) < 0.4
    # the field's frame is that of its first disc
    corner = np.array(found.field.targets["t44"].position)
    np.testing.assert_allclose(corner, [1.0, 0.88, 0.0], atol=1e-12)
    first = rotation_matrix(poses[2].orientation) @ (-0.5, -0.44, 0) + np.array(poses[2].position)
    np.testing.assert_allclose(found.poses[2].position, first, atol=1e-9)


@pytest.mark.long
def test_optics_from_a_recording(tmp_path: Path) -> None:
    """Written, read, found and adjusted; point-sampled edges give 0.05 px and the optics within 3.5 sigma."""
    bag = tmp_path / "field"
    with RecordingWriter(bag) as writer:
        for frame in recorded(stations(np.random.default_rng(7), 10), frames=2):
            writer.write_raw(frame)
    start = Optics(fx=203.0, fy=203.0, cx=88.5, cy=81.0)
    with Recording(bag) as recording:
        observations = observe(recording.frames(), camera(start), labelled_plate(FRONTAL, field()))
    optics, covariance, report = estimate_optics(observations, start=start, significance=None)
    assert len(report.station_rms) == 10
    assert report.residual_rms < 0.08
    error = (vector(optics) - vector(SR3000)) / np.sqrt(np.diag(covariance.matrix))
    assert np.abs(error).max() < 3.5
    assert covariance.sigma("optics.fx") < 0.5


@pytest.mark.slow
def test_optics_from_area_sampled_images() -> None:
    """Pixels with an extent: residuals below 0.01 px; uncorrected centres of ellipses spoil fx."""
    rng = np.random.default_rng(4)
    frames = []
    for station, pose in stations(rng, 10).items():
        scene = labelled_plate(pose, field())
        frame = area_sampled(camera(), scene, rng=rng, factor=6)
        frames.append(replace(frame, pose_stamps=dict.fromkeys(frame.truth, station)))
    start = Optics(fx=203.0, fy=203.0, cx=88.5, cy=81.0)
    observations = observe(frames, camera(start), labelled_plate(FRONTAL, field()))
    optics, covariance, report = estimate_optics(observations, start=start, significance=None)
    error = (vector(optics) - vector(SR3000)) / np.sqrt(np.diag(covariance.matrix))
    assert np.abs(error).max() < 3.5
    assert report.residual_rms < 0.01
    assert 0.7 < report.sigma_zero < 1.3
    biased, doubtful, _ = estimate_optics(
        observations, start=start, significance=None, correct_ellipses=False
    )
    assert abs(biased.fx - SR3000.fx) > 5 * doubtful.sigma("optics.fx")


def test_poses_come_from_the_recording_where_the_scene_says_truth() -> None:
    poses = dict(enumerate(list(stations(np.random.default_rng(4)).values())[:2]))
    frames = recorded(poses, frames=1)
    scene = labelled_plate(FRONTAL, field())
    moving = replace(scene, surfaces=tuple(replace(one, pose="truth") for one in scene.surfaces))
    lost = replace(frames[0], truth={}, pose_stamps={})
    found = observe([lost, *frames], camera(), moving)
    assert found.notes == ("1 stations without the poses of all targets excluded",)
    np.testing.assert_allclose(found.field.targets["t44"].position, [1.0, 0.88, 0.0], atol=1e-9)
    with pytest.raises(InputError, match="no frame has the poses of the scene's targets"):
        observe([lost], camera(), moving)


def test_hidden_saturated_and_missing_targets_are_excluded() -> None:
    (frame,) = recorded({0: FRONTAL}, frames=1)
    scene = labelled_plate(FRONTAL, field())
    seen_by_all = {one.target for one in observe([frame], camera(), scene).points}
    assert {"t21", "t22", "t23"} <= seen_by_all
    before = disc("before", (0.0, 0.0, 0.8), np.eye(3), 0.03, reflectivity=0.5)
    hidden = observe([frame], camera(), replace(scene, surfaces=(before, *scene.surfaces)))
    assert "t22" not in {one.target for one in hidden.points}
    u, v = (round(one) for one in expected_centres(FRONTAL)["t21"])
    amplitude = frame.amplitude.copy()
    amplitude[v, u] = 65535
    saturated = observe([replace(frame, amplitude=amplitude)], camera(), scene)
    assert "t21" not in {one.target for one in saturated.points}
    assert saturated.notes == ("1 targets in view saturated",)
    amplitude = frame.amplitude.copy()
    amplitude[v - 12 : v + 13, u - 12 : u + 13] = 300
    gone = observe([replace(frame, amplitude=amplitude)], camera(), scene)
    assert "t21" not in {one.target for one in gone.points}
    assert "1 targets in view not found" in gone.notes


def test_a_circle_beyond_the_gate_is_not_taken_for_another() -> None:
    (frame,) = recorded({0: FRONTAL}, frames=1)
    scene = labelled_plate(FRONTAL, field())
    shifted = replace(SR3000, cx=SR3000.cx + 4.0)
    assert len(observe([frame], camera(shifted), scene).points) > 15
    assert observe([frame], camera(shifted), scene, gate=3.0).points == ()


def test_dark_circles() -> None:
    wall = Surface(name="wall", type="plane", reflectivity=0.8, pose=ScenePose((0.0, 0.0, 1.502)))
    places = {f"d{i}": (0.2 * i - 0.4, 0.1 * (i % 2) - 0.05, 1.5) for i in range(5)}
    discs = tuple(disc(name, at, np.eye(3), 0.05, reflectivity=0.05) for name, at in places.items())
    scene = Scene(surfaces=(*discs, wall))
    frame = Simulation(camera(), scene, seed=1).frame(exposure(scene, stamp=1))
    found = {one.target: one for one in observe([frame], camera(), scene).points}
    assert set(found) == set(places)
    for name, at in places.items():
        u, v = project(SR3000, np.array(at))
        assert np.hypot(found[name].u - u, found[name].v - v) < 0.3


def checkered(pose: Pose, *, size: tuple[float, float] = (0.72, 0.5)) -> Scene:
    texture = Texture(cell=(0.08, 0.08), values=NestedList(np.array([[0.85, 0.1], [0.1, 0.85]])))
    board = Surface(
        name="board",
        type="rectangle",
        size=size,
        pose=ScenePose(pose.position, pose.orientation),
        texture=texture,
    )
    wall = Surface(name="wall", type="plane", reflectivity=0.4, pose=ScenePose((0.0, 0.0, 2.5)))
    return Scene(surfaces=(board, wall))


def test_corners_of_a_checkerboard_are_named_by_row_and_column() -> None:
    rng = np.random.default_rng(9)
    rotation = Rotation.from_euler("xyz", [20, -15, 30], degrees=True).as_matrix()
    pose = Pose((0.03, -0.02, 1.2), quaternion(rotation))
    frame = area_sampled(camera(), checkered(pose), rng=rng, factor=6)
    found = observe([frame], camera(replace(SR3000, cx=91.5)), checkered(FRONTAL))
    # 72 x 50 cm with squares of 8 cm, counted from the middle
    assert set(found.field.targets) == {f"board/{i}/{j}" for i in range(-3, 4) for j in range(-4, 5)}
    assert len(found.points) > 30
    errors = []
    for one in found.points:
        _, row, column = one.target.split("/")
        at = rotation @ np.array([0.08 * int(column), 0.08 * int(row), 0]) + pose.position
        errors.append(project(SR3000, at) - (one.u, one.v))
    assert np.sqrt(np.mean(np.square(errors))) < 0.03


def test_the_rim_of_a_board_has_no_corners() -> None:
    scene = checkered(FRONTAL, size=(0.48, 0.32))
    names = FieldOnSurfaces.from_scene(scene, {}).field.targets
    assert set(names) == {f"board/{i}/{j}" for i in (-1, 0, 1) for j in (-2, -1, 0, 1, 2)}


def test_input_that_is_no_target_field() -> None:
    (frame,) = recorded({0: FRONTAL}, frames=1)
    scene = labelled_plate(FRONTAL, field())
    walls = replace(scene, surfaces=tuple(one for one in scene.surfaces if one.type != "disc"))
    with pytest.raises(
        InputError, match=r"surfaces: the scene has no targets \(describe the target field by"
    ):
        observe([frame], camera(), walls)
    narrow = replace(camera(), sensor=replace(camera().sensor, width=100))
    with pytest.raises(InputError, match="the frames have 176 x 144 px, the camera 100 x 144"):
        observe([frame], narrow, scene)
    with pytest.raises(InputError, match="gate is -1 px"):
        observe([frame], camera(), scene, gate=-1.0)
    x, y, z = frame.truth["t44"].position
    bent = replace(frame, truth={**frame.truth, "t44": Pose((x, y, z - 0.2))})
    with pytest.raises(InputError, match=r"station 0 depart by \d+ mm from one rigid field"):
        observe([bent], camera(), scene)
