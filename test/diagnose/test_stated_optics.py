"""Optics that a camera file knows with a covariance: a nuisance within it, named far beyond it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Covariance
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.parameters import ArrayFile

from ..calibrate.helpers import camera, record, scene


@pytest.mark.long
@pytest.mark.parametrize(("factor", "named"), [(1.002, []), (1.06, ["camera_constant"])])
def test_a_camera_constant_beside_its_stated_sigma(tmp_path: Path, factor: float, named: list[str]) -> None:
    """Of 0.3 %: wrong by 0.2 % nothing is missing, by 6 % it is named whatever the file states."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=20, seed=3)
    optics = replace(truth.optics, fx=truth.optics.fx * factor, fy=truth.optics.fy * factor)
    sigma = 0.003 * truth.optics.fx
    # one scale of both, as calibrations of lenses know them
    matrix = sigma**2 * np.array([[1.0, 0.98], [0.98, 1.0]])
    stated = Covariance(("optics.fx", "optics.fy"), ArrayFile("covariance.npy", matrix))
    result = diagnose(data, board, replace(truth, optics=optics, covariance=stated))
    assert [one.effect for one in result.missing] == named
    assert result.verdict == ("missing_physics" if named else "consistent")
    if not named:
        assert not any("times the sigma of its covariance" in note for note in result.notes)
