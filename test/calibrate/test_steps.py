"""Steps of an adjustment: shortened where they would go too far, the other parameters following."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.calibrate.steps import Solved, longest_steps

MATRIX = np.array([[4.0, 3.9e3, 0.1], [3.9e3, 4.0e6, 2.0], [0.1, 2.0, 9.0]])
RIGHT = np.array([1.0, 2.0e3, -3.0])


def solved(most: list[float], damping: float = 0.0) -> Solved:
    nothing: Any = None
    labels = ["weight", "sigma", "offset"]
    return Solved(nothing, labels, MATRIX, RIGHT, np.array(most), 0.0, {}, {}, damping)


def test_a_step_solves_the_equations() -> None:
    step = solved([np.inf] * 3).step
    assert step == pytest.approx(np.linalg.solve(MATRIX, RIGHT))
    changes = solved([np.inf] * 3).changes
    assert list(changes) == ["weight", "sigma", "offset"]
    assert list(changes.values()) == pytest.approx(step)


def test_the_others_follow_a_parameter_that_may_not_go_as_far() -> None:
    """The least of the quadratic on the bound: sigma would go by 0.0051."""
    free = np.linalg.solve(MATRIX, RIGHT)
    assert free[1] == pytest.approx(0.00505, rel=0.01)
    step = solved([np.inf, 0.001, np.inf]).step
    assert step[1] == 0.001
    others = [0, 2]
    right = RIGHT[others] - MATRIX[others, 1] * 0.001
    assert step[others] == pytest.approx(np.linalg.solve(MATRIX[np.ix_(others, others)], right))

    # which is elsewhere than the free step cut off, and better
    def objective(x: np.ndarray) -> float:
        return float(0.5 * x @ MATRIX @ x - RIGHT @ x)

    cut = np.array([free[0], 0.001, free[2]])
    assert objective(step) < objective(cut) - 1.0
    assert solved([np.inf, 0.01, np.inf]).step == pytest.approx(free)
    assert np.array_equal(solved([0.1, 0.001, 0.2]).step, [-0.1, 0.001, -0.2])


@pytest.mark.parametrize("damping", [1e-3, 0.03, 1.0])
def test_damping_adds_a_share_of_the_diagonal(damping: float) -> None:
    step = solved([np.inf] * 3, damping).step
    assert step == pytest.approx(np.linalg.solve(MATRIX + damping * np.diag(np.diag(MATRIX)), RIGHT))
    assert not np.any(replace(solved([np.inf] * 3, damping), damping=np.inf).step)


def test_shapes_go_by_a_quarter_of_where_they_are() -> None:
    labels = ["effects.scattering.kernels.0.sigma.0", "effects.scattering.kernels.0.weight"]
    numbers = {labels[0]: 8.0, labels[1]: 0.02}
    assert list(longest_steps(labels, {labels[0]: 4.0}, numbers)) == [3.0, np.inf]
