"""Poses of boards from simulated recordings, against the poses that were simulated."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.photogrammetry.board_detection import find_board
from rim_camera_ros.photogrammetry.board_stations import BoardStations
from rim_camera_ros.photogrammetry.from_images import ImagePoses, Known, poses_of_recording, write_poses
from rim_camera_ros.photogrammetry.texture_targets import targets_of
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene, load_scene

CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 200, height: 150, pixel_pitch: [30.0e-6, 30.0e-6], modulation_frequency: 20.0e6}
optics: {fx: 201.0, fy: 199.0, cx: 101.3, cy: 73.6, d: [-0.12, 0.08, 0.001, -0.0007, 0.0]}
radiometry: {gain: 600.0}
noise: {floor: 0.002, shot: 0.0, amplitude: 6.0}
effects: {mixed_pixels: {blur: 0.3, footprint: 1.0}}
"""
needs_aruco = pytest.mark.skipif(not hasattr(cv2, "aruco"), reason="this OpenCV has no cv2.aruco")
EXACT = Known(focal_sigma=0.0, centre_sigma=0.0, board_sigma=0.0)
FRAMES = 2


def make(folder: Path, words: list[str], *, stations: int) -> tuple[Camera, Scene, Path]:
    """A camera, a board of ``rim board`` and its recording by ``rim simulate``."""
    (folder / "camera.yaml").write_text(CAMERA)
    assert main(["board", *words, "--out", str(folder / "board"), "--quiet"]) == 0
    head, schedule = (folder / "board.yaml").read_text().split("schedule:")
    lines = [one.replace("frames: 5", f"frames: {FRAMES}") for one in schedule.splitlines()[1:]]
    text = "\n".join([f"{head}schedule:", *lines[:stations], ""])
    (folder / "board.yaml").write_text(text)
    words = ["simulate", str(folder / "board.yaml"), "--camera", str(folder / "camera.yaml"), "--quiet"]
    assert main([*words, "--out", str(folder / "bag")]) == 0
    return load_camera(folder / "camera.yaml"), load_scene(folder / "board.yaml"), folder / "bag"


def errors(found: ImagePoses, bag: Path) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 6) of the poses, x y z [m] and rotations [rad], and their covariances (n, 6, 6)."""
    with Recording(bag) as recording:
        truth = {frame.stamp: frame.truth["board"] for frame in recording.frames()}
    wrong, covariance = [], []
    for number, one in found.poses.stations.items():
        true = truth[found.first[number]]
        turn = rotation_matrix(one.pose.orientation) @ rotation_matrix(true.orientation).T
        small = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        wrong.append([*(np.array(one.pose.position) - true.position), *small])
        covariance.append(one.own + one.common)
    return np.array(wrong), np.array(covariance)


def normalised(wrong: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared errors over their covariance, per degree of freedom (n,)."""
    return np.array([d @ np.linalg.solve(c, d) / 6 for d, c in zip(wrong, covariance, strict=True)])


@pytest.fixture(scope="module")
def checkerboard(tmp_path_factory: pytest.TempPathFactory) -> tuple[Camera, Scene, Path]:
    folder = tmp_path_factory.mktemp("checkerboard")
    return make(folder, ["checkerboard", "--square", "0.03", "--distance", "0.55"], stations=8)


def test_a_checkerboard(checkerboard: tuple[Camera, Scene, Path], tmp_path: Path) -> None:
    camera, scene, bag = checkerboard
    found = poses_of_recording(bag, scene, camera, known=EXACT)
    assert len(found.poses.stations) == 8
    assert found.placed_frames == found.frames == 8 * FRAMES
    wrong, covariance = errors(found, bag)
    assert np.median(np.linalg.norm(wrong[:, :3], axis=1)) < 2e-4
    assert np.median(np.linalg.norm(wrong[:, 3:], axis=1)) < 2e-3
    # chi-square of 48: 0.6 to 1.5 with 99.9 %, times what jagged edges of the simulation leave
    assert 0.3 < np.mean(normalised(wrong, covariance)) < 2.5
    write_poses(bag, found, tmp_path / "posed")
    with Recording(tmp_path / "posed") as recording:
        frames = list(recording.frames())
    assert len(frames) == 8 * FRAMES
    for frame in frames:
        number = found.station[frame.stamp]
        pose = frame.truth["board"]
        np.testing.assert_allclose(pose.covariance, found.poses.stations[number].pose.covariance, rtol=1e-12)
        assert frame.pose_stamps["board"] == found.first[number]


def test_a_board_in_the_hand_has_a_station_wherever_it_rests(
    checkerboard: tuple[Camera, Scene, Path],
) -> None:
    """Nobody tells poses: the images alone say that the board moved."""
    camera, scene, bag = checkerboard
    stations = BoardStations(scene.surfaces[0], camera)
    with Recording(bag) as recording:
        frames = [replace(one, truth={}, pose_stamps={}) for one in recording.frames()]
    assert len(list(stations.frames(iter(frames)))) == 8 * FRAMES
    assert list(stations.station.values()) == [k for k in range(8) for _ in range(FRAMES)]


PLAIN = """
format: rim_scene/1
surfaces:
- name: board
  type: rectangle
  pose: truth
  size: SIZE
  texture: {cell: [0.03, 0.03], values: [[0.85, 0.06], [0.06, 0.85]]}
- name: wall
  type: plane
  pose: {position: [0.0, 0.0, 1.6]}
  reflectivity: 0.4
schedule:
- {frames: 1, rate: 10.0, integration_time: 16.0, poses: {board: {position: [0.02, -0.03, 0.5]}}}
- frames: 1
  rate: 10.0
  integration_time: 16.0
  poses: {board: {position: [-0.03, 0.02, 0.6], orientation: [0.1, 0.05, 0.0, 0.99373]}}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("true", "stated", "opposite", "said"),
    [
        (
            "[0.24, 0.18]",
            "[0.18, 0.24]",
            False,
            "(with size: [0.24, 0.18], or with bright and dark tiles exc",
        ),
        (
            "[0.24, 0.18]",
            "[0.24, 0.18]",
            True,
            "or with bright and dark tiles exchanged, it is found in 2 of 2",
        ),
        (
            "[0.21, 0.15]",
            "[0.21, 0.15]",
            True,
            "or with bright and dark tiles exchanged, it is found in 2 of 2",
        ),
        (
            "[0.24, 0.18]",
            "[0.27, 0.21]",
            False,
            "(with size: [0.24, 0.18], which counts tiles and not corners",
        ),
        ("[0.24, 0.18]", "[0.45, 0.33]", False, "the scene file must describe it as it is"),
    ],
)
def test_a_board_that_is_described_wrongly_is_looked_for_as_it_may_be(
    tmp_path: Path, true: str, stated: str, opposite: bool, said: str
) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "board.yaml").write_text(PLAIN.replace("SIZE", true))
    words = ["simulate", str(tmp_path / "board.yaml"), "--camera", str(tmp_path / "camera.yaml"), "--quiet"]
    assert main([*words, "--out", str(tmp_path / "bag")]) == 0
    wrong = PLAIN.replace("SIZE", stated)
    if opposite:
        wrong = wrong.replace("[[0.85, 0.06], [0.06, 0.85]]", "[[0.06, 0.85], [0.85, 0.06]]")
    (tmp_path / "wrong.yaml").write_text(wrong)
    camera, scene = load_camera(tmp_path / "camera.yaml"), load_scene(tmp_path / "wrong.yaml")
    with pytest.raises(InputError, match="the board 'board' was found in none of 2 frames") as error:
        poses_of_recording(tmp_path / "bag", scene, camera, known=EXACT)
    assert said in str(error.value)
    right = poses_of_recording(tmp_path / "bag", load_scene(tmp_path / "board.yaml"), camera, known=EXACT)
    assert right.placed_frames == 2


@needs_aruco
@pytest.mark.parametrize("kind", ["checkerboard", "charuco", "apriltag", "circles"])
@pytest.mark.parametrize("share", [0.55, 0.97])
def test_a_board_is_found_as_far_away_as_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, share: float
) -> None:
    """The stated distance is for 200 px of focal length; this camera's is 200 px (the mean of fx and fy)."""
    assert main(["board", kind, "--out", str(tmp_path / "board")]) == 0
    said = re.search(
        r"found up to about ([\d.]+) m away with a focal length of 200 px", capsys.readouterr().out
    )
    assert said is not None
    (tmp_path / "camera.yaml").write_text(CAMERA)
    camera, scene = load_camera(tmp_path / "camera.yaml"), load_scene(tmp_path / "board.yaml")
    surface = scene.surfaces[0]
    targets = targets_of(surface)
    assert targets is not None
    position = (0.02, -0.01, share * float(said[1]))
    orientation = (0.1, 0.08, 0.0, float(np.sqrt(1 - 0.1**2 - 0.08**2)))
    exposure = Exposure(0, Settings(integration_time=10.0), {surface.name: Pose(position, orientation)})
    frame = Simulation(camera, scene, seed=3).frame(exposure)
    found = find_board(frame.amplitude.astype(np.float32), surface, targets, camera.optics)
    assert found is not None
    np.testing.assert_allclose(found.pose.position, position, atol=0.04 * position[2])


@pytest.mark.parametrize(
    ("kind", "position", "orientation"),
    [
        # a detector finds one marker of twelve at first
        pytest.param(
            "apriltag", (-0.0114, -0.0004, 0.5305), (0.22133, 0.21772, 0.1129, 0.94386), marks=needs_aruco
        ),
        # blobs that are not the circles
        ("circles", (0.0402, 0.0524, 0.55), (0, 0.21644, 0, 0.9763)),
    ],
)
def test_the_look_that_shows_the_board_best_is_taken(
    tmp_path: Path,
    kind: str,
    position: tuple[float, float, float],
    orientation: tuple[float, float, float, float],
) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    words = ["--columns", "4", "--rows", "3", "--square", "0.045"] if kind == "apriltag" else []
    assert main(["board", kind, *words, "--out", str(tmp_path / "board"), "--quiet"]) == 0
    scene = load_scene(tmp_path / "board.yaml")
    camera, surface = load_camera(tmp_path / "camera.yaml"), scene.surfaces[0]
    simulation = Simulation(camera, scene, seed=3)
    exposure = Exposure(0, Settings(integration_time=10.0), {surface.name: Pose(position, orientation)})
    frame = simulation.frame(exposure)
    targets = targets_of(surface)
    assert targets is not None
    found = find_board(frame.amplitude.astype(np.float32), surface, targets, camera.optics)
    assert found is not None
    np.testing.assert_allclose(found.pose.position, position, atol=0.006)
    turn = rotation_matrix(found.pose.orientation).T @ rotation_matrix(orientation)
    assert np.arccos((np.trace(turn) - 1) / 2) < 0.03
