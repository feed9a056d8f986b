"""A weak lobe and the gain of a camera: what shows at normal incidence alone belongs to either."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.effects.light_curves import LOBE_DIFFUSE
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.geometry import see

from ..calibrate.helpers import camera, record, scene

GAIN = "radiometry.gain"


def test_a_lobe_about_normal_incidence_is_no_other_gain(tmp_path: Path) -> None:
    """A tenth more light within 9 degrees of the normal.

    Without a height of the lobe there the gain takes it: 9 % off.
    """
    own, board = camera(tmp_path), scene(tmp_path)
    straight = record(own, board, poses=12, frames=2, seed=11)
    stations = []
    for one in straight.stations:
        angle = see(board, board.poses_for(one.truth), own.rays).incidence
        lobe = 1.0 + 0.1 * np.exp(-((np.nan_to_num(angle) / np.radians(9.0)) ** 2))
        stations.append(replace(one, amplitude=one.amplitude * lobe))
    dataset = replace(straight, stations=stations)
    fitted = fit(Problem(dataset, board, gain=True, imperfections=True), own)
    off = fitted.parameters[GAIN] / own.radiometry.gain - 1.0
    sigma = fitted.sigma[GAIN] / own.radiometry.gain
    assert 0.02 < sigma < 0.05
    assert abs(off) < 0.03
    assert fitted.parameters[LOBE_DIFFUSE[0]] > 0.02
