"""What the Kinect v2's board shows, measured without a fit of the package; poses from its images."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.photogrammetry.from_images import poses_of_recording
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import load_scene

from .kinect_residuals import Board, Terms, boards, judged
from .kinect_step import FOLDER, frames_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.exists(), reason="../shared/recordings has no recording of the Kinect v2"),
]

#: The whole board as a rectangle: its poses are at its middle.
BOARD = """
format: rim_scene/1
surfaces:
- name: board
  type: rectangle
  size: [0.18, 0.24]
  pose: truth
  texture: {cell: [0.03, 0.03], values: [[0.08, 0.8], [0.8, 0.08]]}
"""
#: Of the whole 68; 22 is one whose mirrored pose fits nearly as well.
FRAMES = (9, 13, 17, 22, 26, 29, 33, 37, 41, 45, 59, 63)


@cache
def all_boards() -> list[Board]:
    return boards()


def test_planes_are_turned_against_their_poses_by_one_angle() -> None:
    """Whichever way the board is held: no error of poses, nor of the lens, does so."""
    tilts = np.array([one.tilt for one in all_boards() if np.isfinite(one.tilt).all()])
    distances = np.array(
        [np.nanmedian(one.distance[one.used]) for one in all_boards() if np.isfinite(one.tilt).all()]
    )
    assert len(tilts) >= 60
    assert np.median(tilts[:, 0]) == pytest.approx(0.062, abs=0.004)
    near, far = (np.median(tilts[part, 0]) for part in (distances < 1.0, distances >= 1.0))
    # an emitter beside the lens would turn near planes more, by the ratio of the distances
    assert near / far == pytest.approx(1.0, abs=0.08)


def test_depth_by_other_optics_takes_the_tilt_away_on_other_frames() -> None:
    """Fitted here by least squares to even frames; the term of the camera file then explains odd ones."""
    camera = load_camera(FOLDER / "camera.yaml")
    ray = camera.rays[..., :2] / camera.rays[..., 2:]
    gram, right = np.zeros((3, 3)), np.zeros(3)

    def white(one: Board) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        inside = one.used & one.white & (one.edge > 2.0)
        columns = one.distance[:, :, None] * np.dstack([np.ones(one.used.shape), ray])
        columns[..., 1:] /= (1 + (ray**2).sum(axis=-1))[..., None]
        return (
            inside,
            columns[inside] - columns[inside].mean(axis=0),
            one.rest[inside] - one.rest[inside].mean(),
        )

    for one in (one for one in all_boards()[::2] if np.isfinite(one.tilt).all()):
        _, columns, rest = white(one)
        keep = np.abs(rest) < 0.03
        gram += columns[keep].T @ columns[keep]
        right += columns[keep].T @ rest[keep]
    _, *turned = np.linalg.solve(gram, right)
    point = (turned[0] * camera.optics.fx, turned[1] * camera.optics.fy)
    assert point[1] == pytest.approx(28.5, abs=3)
    effect = DistanceScale(0.0, point)
    before, after = [], []
    for one in (one for one in all_boards()[1::2] if np.isfinite(one.tilt).all()):
        inside, _, rest = white(one)
        term = np.asarray(effect.term(one.distance, one.amplitude, Context(camera)))[inside]
        before.append(np.mean(rest**2))
        after.append(np.mean((rest - (term - term.mean())) ** 2))
    assert np.sqrt(np.median(before)) * 1e3 == pytest.approx(5.4, abs=0.8)
    assert np.sqrt(np.median(after)) * 1e3 < 2.2


def test_what_looks_like_a_scale_is_that_tilt() -> None:
    """Far boards were held elsewhere in the image."""
    effect, context = DistanceScale(0.0, (-5.7, 28.5)), Context(load_camera(FOLDER / "camera.yaml"))
    values = []
    for one in (one for one in all_boards() if np.isfinite(one.tilt).all()):
        bright = one.used & one.white & (one.edge > 2.0) & (one.amplitude > 3000)
        term = np.asarray(effect.term(one.distance, one.amplitude, context))
        values.append([np.median(x[bright]) for x in (one.distance, one.rest, one.rest - term)])
    distance, before, after = np.array(values).T
    (scale, offset), (rest, _) = (np.polyfit(distance, one, 1) for one in (before, after))
    assert scale == pytest.approx(-0.02, abs=0.01)
    assert offset == pytest.approx(0.035, abs=0.008)
    assert abs(rest) < 0.008
    assert np.std(after) < 0.55 * np.std(before)


def test_what_explains_other_frames_down_to_their_noise() -> None:
    raw = judged(all_boards(), Terms())
    hyperbola = judged(all_boards(), Terms(hyperbola=True, rows=True))
    everything = judged(all_boards(), Terms(rows=True, neighbours=True, stray=True))
    assert raw.chi_square == pytest.approx(7.2, abs=0.7)
    assert hyperbola.chi_square > 5.0
    assert everything.chi_square < 2.1
    assert everything.rms < 0.0035
    # rows alternate, and turn over in the middle, from where both halves are read
    steps = np.diff(everything.rows[140:280])
    signs = np.sign(steps) * (-1.0) ** np.arange(steps.size)
    assert abs(signs[:65].mean()) > 0.95
    assert signs[:65].mean() * signs[80:].mean() < 0
    assert np.median(np.abs(steps)) == pytest.approx(0.0015, abs=0.0003)


def test_poses_from_images(tmp_path: Path) -> None:
    """Against those given, which have the same optics: by what their corners' noise makes."""
    (tmp_path / "board.yaml").write_text(BOARD)
    chosen = [frame for number, frame in enumerate(frames_of(None)) if number in FRAMES]
    with RecordingWriter(tmp_path / "bag") as writer:
        for frame in chosen:
            writer.write_raw(frame)
    camera = load_camera(FOLDER / "camera.yaml")
    found = poses_of_recording(tmp_path / "bag", load_scene(tmp_path / "board.yaml"), camera)
    assert len(found.poses.stations) == len(FRAMES)
    shifts, tilts, ratios = [], [], []
    for frame in chosen:
        one = found.poses.stations[found.station[frame.stamp]]
        given = frame.truth["board"]
        turn = Rotation.from_quat(given.orientation).as_matrix()
        middle = np.array(given.position) + turn @ [0.06, 0.09, 0.0]
        normal = rotation_matrix(one.pose.orientation)[:, 2]
        shifts.append(np.linalg.norm(np.array(one.pose.position) - middle))
        tilts.append(np.cross(turn[:, 2], normal)[:2])
        ratios.append([(np.array(one.pose.position) - middle) @ normal / one.sigma_normal])
        ratios.append(tilts[-1] / one.sigma_tilt)
    assert np.median(shifts) < 0.002
    assert np.median(np.abs(tilts)) < 0.002
    assert np.abs(tilts).max() < 0.03
    # the given ones have noise of their own in addition to what is stated of these
    assert np.median(np.abs(np.concatenate(ratios))) < 1.5
