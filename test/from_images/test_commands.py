"""Commands that find the poses of a board in images: what they write, read back, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from rim_camera_ros.bags import Recording
from rim_camera_ros.calibrate.provenance import checksum
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.rotations import rotation_matrix
from test.from_images.conftest import FRAMES, ROOT, STATIONS, OwnBoard, commands_of
from test.helpers_cli import nothing_left, run


def test_poses(own_board: OwnBoard, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each pose errs as its covariance states, of which most is the focal length's 0.2 %."""
    folder, out = own_board.folder, tmp_path / "posed"
    words = ["poses", folder / "bag", "--scene", folder / "board.yaml", "--camera", folder / "camera.yaml"]
    status, said, notes = run(capsys, *words, "--out", out)
    assert status == 0, notes
    assert f"'board' at {STATIONS} stations, in 24 of 24 frames; 12 targets each" in said
    assert "focal length known to 0.2 % and principal point to 0.5 px are taken" in notes
    with Recording(out) as bag:
        frames = list(bag.frames())
    with Recording(folder / "bag") as bag:
        assert [one.distance.tobytes() for one in bag.frames()] == [one.distance.tobytes() for one in frames]
    assert len(frames) == STATIONS * FRAMES
    estimated = {one.pose_stamps["board"]: one.truth["board"] for one in frames}
    assert [*estimated] == [*own_board.poses]
    squares = []
    for stamp, true in own_board.poses.items():
        found = estimated[stamp]
        turn = rotation_matrix(found.orientation) @ rotation_matrix(true.orientation).T
        small = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        error = np.array([*(np.array(found.position) - true.position), *small])
        assert np.linalg.norm(error[:3]) < 0.004 * true.position[2]
        assert found.covariance is not None
        squares.append(error @ np.linalg.solve(np.array(found.covariance).reshape(6, 6), error) / 6)
    # the optics that are held are exact here
    assert np.mean(squares) < 1.5


def test_optics(own_board: OwnBoard, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a focal length that is 3 % off; both files hold what is printed."""
    folder = own_board.folder
    start = (
        (folder / "camera.yaml")
        .read_text()
        .replace("fx: 113.0", "fx: 116.4")
        .replace("fy: 112.0", "fy: 115.4")
    )
    (tmp_path / "start.yaml").write_text(start)
    outputs = ["--out", tmp_path / "info.yaml", "--camera-out", tmp_path / "camera.yaml"]
    words = ["optics", folder / "bag", "--scene", folder / "board.yaml", "--camera", tmp_path / "start.yaml"]
    status, said, notes = run(capsys, *words, "--estimate", "fx,fy,cx,cy", *outputs)
    assert status == 0, notes
    rows = {row.split()[0]: row.split()[1:] for row in said.splitlines() if "+-" in row}
    info = yaml.safe_load((tmp_path / "info.yaml").read_text())
    matrix = dict(
        zip(("fx", "cx", "fy", "cy"), np.array(info["camera_matrix"]["data"])[[0, 2, 4, 5]], strict=True)
    )
    optics, true = load_camera(tmp_path / "camera.yaml").optics, own_board.truth.optics
    for name in ("fx", "fy", "cx", "cy"):
        value, sigma = float(rows[name][0]), float(rows[name][2])
        assert getattr(optics, name) == pytest.approx(value, rel=1e-6)
        assert matrix[name] == pytest.approx(value, rel=1e-6)
        assert abs(value - getattr(true, name)) < 3.5 * sigma < 3.0
    assert info["distortion_coefficients"]["data"] == [-0.12, 0.08, 0.001, -0.0007, 0.0]
    assert (info["image_width"], info["image_height"]) == (112, 84)


@pytest.mark.long
def test_calibrate(own_board: OwnBoard, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The cyclic error that the camera has; the file names the recording that was given, with its sum."""
    folder, out = own_board.folder, tmp_path / "mine.yaml"
    words = [
        "calibrate",
        folder / "bag",
        "--board",
        folder / "board.yaml",
        "--camera",
        folder / "camera.yaml",
    ]
    status, said, notes = run(capsys, *words, "--effects", "cyclic_error", "--out", out)
    assert status == 0, notes
    assert "'board' at 8 stations, in 24 of 24 frames" in said
    # the focal length's 0.2 % and the board's 0.05 %
    assert "pose_scale_sigma: 0.0021 of the scene file" in notes
    mine = load_camera(out)
    cyclic = mine.effects["cyclic_error"]
    assert isinstance(cyclic, CyclicError)
    (fourth,) = [one for one in cyclic.harmonics if one.order == 4]
    assert fourth.amplitude == pytest.approx(0.04, abs=0.004)
    assert fourth.phase == pytest.approx(0.6, abs=0.2)
    (source,) = mine.provenance["recordings"]
    digest = checksum(folder / "bag")
    assert source == {"path": str(folder / "bag"), "sha256": digest, "frames": 24, "poses": 8}
    report = (tmp_path / "mine.report.html").read_text()
    assert digest in report
    assert "rim_poses" not in report + out.read_text() + notes


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (
            "poses --scene wall --out posed",
            "surfaces: the scene has no board with pose: truth (a rectangle with",
        ),
        (
            "optics --scene board.yaml --out o.yaml --estimate fx,k4",
            "--estimate: no parameter 'k4' of the optics",
        ),
        ("optics --scene board.yaml --out o.txt", "o.txt: such a file ends in .yaml (give o.txt.yaml)"),
        (
            "calibrate --board board.yaml --scene wall --out c.yaml",
            "--scene: --board is the scene (give one of",
        ),
        (
            "calibrate --board wall --out c.yaml",
            "surfaces: the scene has no board with pose: truth (a rectangle",
        ),
        (
            "diagnose --scene board.yaml --out d",
            "bag: scene with pose: truth: holds no pose of board (--board board.yaml in the place of --scene "
            "finds them in the images; or record /ground_truth/board/pose,",
        ),
        (
            "calibrate --scene board.yaml --out c.yaml",
            "bag: /ground_truth/board/pose: the scene takes the pose of 'board' from the recording, which "
            "holds poses of: none (--board board.yaml in the place of --scene finds them in the images; or ",
        ),
    ],
)
def test_bad_input(
    own_board: OwnBoard,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
    match: str,
) -> None:
    monkeypatch.chdir(own_board.folder)
    command, *rest = words.split()
    with nothing_left(own_board.folder):
        status, said, error = run(capsys, command, "bag", "--camera", "camera.yaml", *rest, "--quiet")
    assert (status, said) == (2, "")
    assert error.startswith(f"rim: {match}")
    assert error.count("\n") == 1


def test_a_scene_without_a_board_is_not_sent_to_the_images(
    own_board: OwnBoard, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing could be found of a plane of one grey."""
    scene = tmp_path / "plain.yaml"
    scene.write_text("format: rim_scene/1\nsurfaces:\n- {name: plate, type: plane, pose: truth}\n")
    words = ["--camera", own_board.folder / "camera.yaml", "--scene", scene, "--out", tmp_path / "d"]
    status, _, error = run(capsys, "diagnose", own_board.folder / "bag", *words)
    assert status == 2
    assert "holds no pose of plate (record /ground_truth/plate/pose, state the pose" in error


def test_what_a_killed_run_left_is_removed_by_the_next(
    own_board: OwnBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that no process holds, as SIGKILL leaves it; and a run that fails leaves none."""
    left = tmp_path / ".rim_poses.rim-abcd1234" / "0"
    left.mkdir(parents=True)
    (left / "0.mcap").write_bytes(b"a recording")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = own_board.folder
    words = ["--camera", folder / "camera.yaml", "--board", folder / "board.yaml", "--quiet"]
    words += ["--without-poses", "99"]
    status, _, error = run(capsys, "diagnose", folder / "bag", *words, "--out", folder / "d")
    assert status == 2
    expected = "--without-poses: there is no pose 99 (the recording's are numbered 0 to 7)"
    assert error == f"rim: {folder / 'bag'}: {expected}\n"
    assert list(tmp_path.iterdir()) == []


def test_both_pages_show_the_same_commands(own_board: OwnBoard) -> None:
    assert [one[0] for one in own_board.commands] == ["import", "camera", "diagnose"]
    assert commands_of((ROOT / "docs" / "drivers.md").read_text()) == own_board.commands


@pytest.mark.long
def test_from_a_femto_and_a_printed_board_to_what_the_file_lacks(
    own_board: OwnBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """README's last command: the cyclic error, and pixels of some extent, of which the file knows nothing."""
    mine = load_camera(own_board.folder / "camera.yaml")
    # 2 mm, 6 m counts, and 1 mm along z rounded; 600 on a board whose squares reflect 0.455 in the mean
    assert mine.noise.sigma_distance(np.array([10_000.0]))[0] == pytest.approx(0.0021, rel=0.1)
    assert mine.radiometry.gain == pytest.approx(600.0, rel=0.5)
    for name in ("bag", "camera.yaml", "board.yaml"):
        (tmp_path / name).symlink_to(own_board.folder / name)
    monkeypatch.chdir(tmp_path)
    status, _, notes = run(capsys, *own_board.commands[-1])
    assert status == 0, notes
    report = json.loads((tmp_path / "diagnosis" / "report.json").read_text())
    assert report["verdict"] == "missing_physics"
    missing = {one["effect"]: one["parameters"] for one in report["missing"]}
    assert set(missing) == {"cyclic_error", "mixed_pixels"}
    (found,) = missing["cyclic_error"]["harmonics"]
    assert found["order"] == 4
    assert found["amplitude"] == pytest.approx(0.04, abs=0.004)
    page = (tmp_path / "diagnosis" / "report.html").read_text()
    assert "cyclic error" in page
    assert "rim_poses" not in page + json.dumps(report) + notes
