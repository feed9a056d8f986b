"""Weights of robust fitting and the loss that they stand for: objectives of two points are compared by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.residuals import ROBUST_LIMIT, beyond_limit
from rim_camera_ros.fit.solver import fit

from ..calibrate.helpers import camera, record, scene
from .watched import points


def loss(z: float) -> float:
    """Huber (1964), eq. 1.6, doubled: quadratic up to the limit, then linear."""
    return z**2 if abs(z) <= ROBUST_LIMIT else 2 * ROBUST_LIMIT * abs(z) - ROBUST_LIMIT**2


@settings(derandomize=True, deadline=None)
@given(here=st.floats(0.0, 60.0), there=st.floats(-60.0, 60.0))
def test_weighted_squares_bound_the_loss_and_touch_it(here: float, there: float) -> None:
    factor = np.array([min(1.0, ROBUST_LIMIT / max(here, 1e-9))])

    def bound(z: float) -> float:
        return float(factor[0]) * z**2 + beyond_limit(factor)

    assert bound(here) == pytest.approx(loss(here), rel=1e-12)
    assert bound(there) >= loss(there) - 1e-9


def test_a_fit_whose_first_weights_were_lenient_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the offsets of another camera all are outliers: squares are small there, and the loss is not."""
    truth, board = camera(tmp_path, DistanceScale(0.03)), scene(tmp_path)
    problem = Problem(record(truth, board, poses=8, seed=4), board)
    warm = fit(problem, camera(tmp_path), iterations=3)
    seen = points(monkeypatch)
    found = fit(problem, camera(tmp_path, DistanceScale(0.025)), warm=warm, iterations=8)
    path = "effects.distance_scale.scale"
    assert found.parameters[path] == pytest.approx(0.03, abs=4 * found.sigma[path])
    assert found.converged
    squares, objectives = np.array([(one.square, one.objective) for one in seen]).T
    assert squares[1] > squares[0]
    # outliers count by their loss, not as pixels that are known worse
    assert objectives[0] - objectives[1] > 10_000
    assert np.all(np.diff(objectives) < 0.5)
