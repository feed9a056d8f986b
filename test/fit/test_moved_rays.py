"""Rays that move: likelihoods of geometries are compared at the same pixels with the same errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit

from ..calibrate.helpers import camera, record, scene


def test_a_camera_constant_is_fitted_over_the_edges_of_tiles(tmp_path: Path) -> None:
    """2 % too long: edges of tiles move by up to half a pixel, and patches of pixels with them."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=14, seed=8)
    wrong = replace(truth, optics=replace(truth.optics, fx=truth.optics.fx * 1.02, fy=truth.optics.fy * 1.02))
    forward = Forward(data, board, wrong)
    patches = forward.patches_seen()
    problem = Problem(
        data, board, geometry=("camera_constant",), masks=forward.pixels_used(), patches=patches
    )
    begun = fit(problem, wrong, iterations=0)
    found = fit(problem, wrong, iterations=12)
    assert found.converged
    assert found.camera.optics.fx == pytest.approx(truth.optics.fx, abs=4 * found.sigma["optics.fx"])
    assert found.camera.optics.fy == pytest.approx(truth.optics.fy, abs=4 * found.sigma["optics.fy"])
    assert found.sigma["optics.fx"] < 0.004 * truth.optics.fx
    # the weight of all amplitudes is that of their patches, wherever edges are said to be
    assert found.rows == begun.rows
    moved = Forward(data, board, truth)
    assert any((moved.patches_seen()[key] != patches[key]).any() for key in patches)
    moved.patches = patches
    shares = [one.amplitude_share for one in moved.predictions(slopes=False)]
    assert all(
        (share == 1 / patches[(one.recording, one.placed)]).all()
        for share, one in zip(shares, data.stations, strict=True)
    )
