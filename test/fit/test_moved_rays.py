"""Rays that move: likelihoods of geometries are compared at the same pixels with the same errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
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
    assert found.rows == pytest.approx(begun.rows, rel=1e-3)
    moved, as_begun = Forward(data, board, truth), Forward(data, board, truth)
    assert any((moved.patches_seen()[key] != patches[key]).any() for key in patches)
    as_begun.patches = patches
    for own, held in zip(moved.predictions(slopes=False), as_begun.predictions(slopes=False), strict=True):
        # noise + error^2 x pixels that share it
        both = np.stack([own.amplitude_noise**2, held.amplitude_noise**2])
        error = np.stack([own.amplitude_sigma**2, held.amplitude_sigma**2]) - both
        counts = patches[(own.station.recording, own.station.placed)]
        shared = own.view.geometry.hit & (error[0] > 0)
        ratio = (error[1] / np.where(shared, error[0], 1.0))[shared]
        assert ratio == pytest.approx((counts / moved.views.alike(own.view))[shared], rel=1e-6)
