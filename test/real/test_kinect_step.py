"""The measure of black-to-white steps: raw numbers of the recording, and classes of made-up squares."""

from __future__ import annotations

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera

from .kinect_step import FOLDER, classes, frames_of, steps, table


@pytest.mark.skipif(not FOLDER.is_dir(), reason="the real recordings are not beside this checkout")
def test_steps_as_measured_on_every_second_pose() -> None:
    found = classes(*steps(load_camera(FOLDER / "camera.yaml"), frames_of("odd")))
    judged = [(one.low, one.squares, round(one.median * 1e3, 1)) for one in found if one.squares >= 100]
    assert [one[:2] for one in judged] == [(800, 121), (1000, 149), (1200, 196), (1500, 140), (2000, 131)]
    assert [one[2] for one in judged] == pytest.approx([9.4, 4.4, 3.8, 0.1, -1.5], abs=0.15)


def test_classes_of_squares() -> None:
    amplitude = np.r_[np.full(120, 900.0), np.full(30, 1100.0)]
    step = np.r_[np.full(60, 0.001), np.full(60, 0.0014), np.full(30, -0.004)]
    first, second = classes(amplitude, step, np.r_[np.arange(120) // 60, np.full(30, 2)])
    assert (first.low, first.high, first.squares, first.poses) == (800, 1000, 120, 2)
    assert first.median == pytest.approx(0.0012)
    # squares of one pose are drawn together: one of two poses, or both
    assert first.sigma == pytest.approx(0.0002 / np.sqrt(2), rel=0.2)
    assert (second.median, second.sigma) == pytest.approx((-0.004, 0.0))
    lines = table([first, second]).splitlines()
    assert lines[1].endswith("met")
    assert "MISSED" not in lines[2]  # too few squares to be judged
