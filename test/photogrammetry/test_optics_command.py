"""``rim optics`` and ``--board`` on recordings of a board by a camera whose optics are known."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.camera import ArrayFile, Covariance
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.cli import main
from rim_camera_ros.commands.from_images import posed_recordings
from rim_camera_ros.photogrammetry.from_images import poses_of_recording
from rim_camera_ros.scene import load_scene

from .test_board_poses import CAMERA, make

EFFECTS = """
effects:
  mixed_pixels: {blur: 0.3, footprint: 1.0}
  distance_scale: {scale: 0.0}
  background_light: {level: 10.0, offset: 0.001}
"""
#: 1-sigma of the scale [-] and the offset [m], which have a correlation of -0.5.
OF_EFFECTS = np.array([[4e-8, -1e-7], [-1e-7, 1e-6]])
PATHS = ("effects.distance_scale.scale", "effects.background_light.offset")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight stations of a checkerboard; camera.yaml states a covariance of its effects and fx."""
    folder = tmp_path_factory.mktemp("optics")
    camera, _, _ = make(folder, ["checkerboard", "--distance", "0.5"], stations=8)
    text = CAMERA[: CAMERA.index("effects:")] + EFFECTS.lstrip()
    (folder / "stated.yaml").write_text(text)
    matrix = np.zeros((3, 3))
    matrix[:2, :2], matrix[2, 2] = OF_EFFECTS, 0.04
    covariance = Covariance((*PATHS, "optics.fx"), ArrayFile("stated_covariance.npy", matrix))
    save_camera(replace(load_camera(folder / "stated.yaml"), covariance=covariance), folder / "stated.yaml")
    assert camera.optics == load_camera(folder / "stated.yaml").optics
    return folder


def test_the_covariance_that_was_found_is_written(recorded: Path, tmp_path: Path) -> None:
    words = ["optics", str(recorded / "bag"), "--scene", str(recorded / "board.yaml")]
    words += ["--camera", str(recorded / "stated.yaml"), "--estimate", "fx,cx,cy", "--quiet"]
    words += ["--out", str(tmp_path / "info.yaml"), "--camera-out", str(tmp_path / "new.yaml")]
    assert main(words) == 0
    stated, new = load_camera(recorded / "stated.yaml"), load_camera(tmp_path / "new.yaml")
    assert new.covariance is not None
    assert set(new.covariance.parameters) == {*PATHS, "optics.fx", "optics.fy", "optics.cx", "optics.cy"}
    at = [new.covariance.parameters.index(one) for one in PATHS]
    np.testing.assert_allclose(new.covariance.matrix.values[np.ix_(at, at)], OF_EFFECTS, rtol=1e-12)
    assert new.effects == stated.effects
    found, true = new.optics, stated.optics
    for name, least, most in (("fx", 0.005, 0.5), ("fy", 0.005, 0.5), ("cx", 0.005, 0.5), ("cy", 0.005, 0.5)):
        i = new.covariance.parameters.index(f"optics.{name}")
        sigma = float(np.sqrt(new.covariance.matrix.values[i, i]))
        assert least < sigma < most
        assert abs(getattr(found, name) - getattr(true, name)) < 3.5 * sigma
    # it is what poses are given their covariance by
    scene = load_scene(recorded / "board.yaml")
    poses = poses_of_recording(recorded / "bag", scene, new)
    assert poses.covariance.sigma("optics.cx") == pytest.approx(
        np.sqrt(new.covariance.matrix.values[i - 1, i - 1])
    )
    assert not [one for one in poses.notes if "states no covariance" in one]


@pytest.mark.parametrize(("focal", "size"), [(0.01, 0.002), (0.0, 0.004), (0.0, 0.0)])
def test_what_is_declared_of_optics_and_board_is_what_poses_have_in_common(
    recorded: Path, focal: float, size: float
) -> None:
    """All distances to a board are off by the same share: that of the focal length, and that of its size."""
    given = argparse.Namespace(quiet=True, focal_sigma=focal, centre_sigma=0.0, board_sigma=size)
    camera, board = load_camera(recorded / "camera.yaml"), load_scene(recorded / "board.yaml")
    with posed_recordings(given, (recorded / "bag",), board, camera, Topics()) as posed:
        with Recording(posed.recordings[0]) as bag:
            poses = [frame.truth["board"] for frame in bag.frames()]
        names = [surface.name for surface in posed.scene.surfaces]
    assert names == [surface.name for surface in board.surfaces]
    sigmas = []
    for pose in poses:
        sight = np.array(pose.position) / np.linalg.norm(pose.position)
        assert pose.covariance is not None
        covariance = np.reshape(pose.covariance, (6, 6))[:3, :3]
        sigmas.append(np.sqrt(sight @ covariance @ sight) / np.linalg.norm(pose.position))
    together = float(np.hypot(focal, size))
    # what each image leaves of its own is 0.05 mm of 500
    assert np.median(sigmas) == pytest.approx(together, rel=0.06, abs=3e-4)
    share = posed.scene.surfaces[0].pose_common
    if together:
        assert 0.97 < share <= 1.0
    else:
        assert share == 0.0


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_what_is_declared_of_poses_from_images_needs_a_board(
    command: str, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [command, str(recorded / "bag"), "--camera", str(recorded / "camera.yaml")]
    words += ["--scene", str(recorded / "board.yaml"), "--out", str(recorded / "never.yaml")]
    assert main([*words, "--board-sigma", "1e-4"]) == 2
    said = capsys.readouterr().err
    assert "--board-sigma: poses are those of the recording (it belongs to --board; errors of" in said
    assert not (recorded / "never.yaml").exists()
