"""Smooth functions of covariates: a gradient over the array that follows the temperature of the air."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.diagnose.formula import product_form
from rim_camera_ros.diagnose.smooth import axes_of, gradient_terms, single_terms
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, explore

from ..calibrate.helpers import camera, record, scene

#: Metres per degree and column: 1.7 mm at the edge columns at 4 degrees from the mean.
SLOPE = 2.0e-5


def explored(tmp_path: Path, *, slope: float, seed: int) -> Exploration:
    """Smooth terms of a recording with slope (T - 20) (column - 21.5), by a camera file without it."""
    stated, board = camera(tmp_path), scene(tmp_path)
    half = slope * 4.0 * 21.5
    gradient = Empirical(
        ("ambient_temperature", "column"),
        ((16.0, 24.0), (0.0, 43.0)),
        NestedList(np.array([[half, -half], [-half, half]])),
    )
    data = record(camera(tmp_path, gradient), board, poses=24, seed=seed)
    forward = Forward(data, board, stated)
    forward.estimate_amplitudes()
    samples = axes_of(forward)
    further = [*single_terms(samples), *gradient_terms(samples)]
    return explore(Problem(data, board), stated, [], folds_of(data), further=further)


def above(step: Exploration) -> dict[str, float]:
    """Covariates of the terms that gain more than replicates in which nothing is missing do."""
    return {
        one.variant: float(gain)
        for one, gain, threshold in zip(step.candidates, step.gains, step.thresholds, strict=True)
        if gain > threshold
    }


def test_a_gradient_that_follows_the_temperature_is_no_tilt_of_poses(tmp_path: Path) -> None:
    step = explored(tmp_path, slope=SLOPE, seed=1)
    found = above(step)
    assert max(found, key=lambda one: found[one]) == "ambient_temperature,column"
    # its mean over the array is none: functions of one covariate show less of it
    best = max((gain for one, gain in found.items() if "," not in one), default=0.0)
    assert best < found["ambient_temperature,column"] / 2
    number = next(k for k, one in enumerate(step.candidates) if one.variant == "ambient_temperature,column")
    table = step.candidates[number].build(step.fit.camera, step.scores.values(step.spans[number]))
    term = table.effects["empirical"]
    assert isinstance(term, Empirical)
    (a, b), (c, d) = term.knots
    values = term.values.values
    fitted = (values[1, 1] - values[1, 0] - values[0, 1] + values[0, 0]) / ((b - a) * (d - c))
    assert fitted == pytest.approx(SLOPE, rel=0.15)


def test_without_one_no_term_gains(tmp_path: Path) -> None:
    """All terms together raise an alarm in 2 % of recordings: in two of four once in 400 times."""
    alarms = [above(explored(tmp_path, slope=0.0, seed=seed)) for seed in (2, 3, 4, 5)]
    assert sum(bool(one) for one in alarms) <= 1, alarms


def test_a_bilinear_table_is_a_product_but_for_what_depends_on_one_covariate() -> None:
    """3 (x - 2) (y - 20), to which functions of x alone and of y alone are added."""
    x, y = (1.0, 3.0), (10.0, 30.0)
    values = np.array([[3.0 * (a - 2.0) * (b - 20.0) + 7.0 * a - 0.3 * b for b in y] for a in x])
    assert product_form(("time", "row"), (x, y), values) == "3 (time - 2) (row - 20) [m]"
