"""Real input, read and corrected: the numbers published with the recordings come out again.

The same numbers are recomputed from what the nodes publish in test/ros/test_real_playback.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.frame import Flag
from rim_camera_ros.pipeline.correct import Correction

from .analysis import BLACK_STEPS, black_squares, wall_residual

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"

pytestmark = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the real recordings are not beside this checkout (../shared/recordings)"
)


def check_black_squares(amplitude: np.ndarray, step: np.ndarray) -> None:
    """Hold the steps of black squares against the published curve, class by class."""
    assert len(amplitude) > 1300
    for low, high, published in BLACK_STEPS:
        of_class = step[(amplitude >= low) & (amplitude < high)]
        # few squares are as dark as 600-800 counts, and they scatter by 10 mm
        tolerance = 2.0 if len(of_class) >= 100 else 5.0
        assert len(of_class) >= 50, (low, high)
        assert np.median(of_class) * 1e3 == pytest.approx(published, abs=tolerance), (low, high)


def check_wall(result: dict[str, float]) -> None:
    """Hold the wall's residual against the published -23..+18 mm, pattern 4.6 mm, noise 0.9 mm."""
    assert result["share"] > 0.25
    assert result["low"] * 1e3 == pytest.approx(-23, abs=4)
    assert result["high"] * 1e3 == pytest.approx(18, abs=4)
    assert result["pattern"] * 1e3 == pytest.approx(4.6, abs=0.6)
    assert result["noise"] * 1e3 == pytest.approx(0.9, abs=0.5)


@pytest.mark.long
def test_kinect_black_squares() -> None:
    correction = Correction(load_camera(RECORDINGS / "kinect2_checkerboard" / "camera.yaml"))
    frames = []
    with Recording(RECORDINGS / "kinect2_checkerboard" / "recording") as bag:
        for frame in bag.frames():
            pose = frame.truth["board"]
            frames.append(
                (
                    correction.cloud(correction.correct(frame)),
                    np.array(pose.position),
                    np.array(pose.orientation),
                )
            )
    assert len(frames) == 68
    check_black_squares(*black_squares(frames))


def test_kinect_offset_and_scale_against_the_board() -> None:
    """Measured minus computed distance is +35 mm at -2 % of the distance."""
    from scipy.spatial.transform import Rotation

    camera = load_camera(RECORDINGS / "kinect2_checkerboard" / "camera.yaml")
    correction = Correction(camera)
    computed, measured = [], []
    with Recording(RECORDINGS / "kinect2_checkerboard" / "recording") as bag:
        for frame in bag.frames():
            pose = frame.truth["board"]
            corrected = correction.correct(frame)
            normal = Rotation.from_quat(pose.orientation).as_matrix()[:, 2]
            with np.errstate(invalid="ignore", divide="ignore"):
                expected = (np.array(pose.position) @ normal) / (camera.rays @ normal)
            bright = (corrected.amplitude > 3000) & np.isfinite(corrected.distance)
            bright &= np.abs(corrected.distance - expected) < 0.1
            if bright.sum() > 200:
                computed.append(np.median(expected[bright]))
                measured.append(np.median((corrected.distance - expected)[bright]))
    scale, offset = np.polyfit(computed, measured, 1)
    assert len(computed) > 40
    assert offset * 1e3 == pytest.approx(35, abs=8)
    assert scale * 100 == pytest.approx(-2.0, abs=0.8)


def test_o3d303_wall_and_mixed_pixels() -> None:
    correction = Correction(load_camera(RECORDINGS / "o3d303_wall" / "camera.yaml"))
    with Recording(RECORDINGS / "o3d303_wall" / "recording") as bag:
        corrected = [correction.correct(frame) for frame in bag.frames()]
    assert len(corrected) == 3
    check_wall(wall_residual([correction.cloud(one) for one in corrected]))
    for one in corrected:
        mixed = (one.flags & np.uint8(Flag.MIXED_PIXEL.value)) > 0
        edge = mixed[35:120, 46:54].sum()
        assert 35 <= edge <= 95  # the box's left edge; 46 published for one edge
        assert mixed[60:110, 60:100].sum() == 0  # the box's face
        assert mixed[10:80, 135:170].sum() <= 3  # the wall
