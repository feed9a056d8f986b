"""What a candidate must gain where poses err by more than stated: by themselves, or by what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, _given_candidate, explore
from rim_camera_ros.select.null_replicates import error_size

from ..calibrate.helpers import camera, record, scene


def explored_scale(tmp_path: Path, *, scale: float, wrong: float, seed: int) -> tuple[Exploration, int]:
    told, board = camera(tmp_path), scene(tmp_path)
    truth = camera(tmp_path, DistanceScale(scale)) if scale else told
    data = record(truth, board, poses=20, seed=seed, wrong=wrong)
    facts = Facts.of(data, moves=False, surfaces=1, camera=told)
    pool = candidates(told, facts, effects=["distance_scale"])
    found = explore(Problem(data, board), told, pool, folds_of(data), seed=seed)
    return found, found.best()["distance_scale"]


def given_itself(found: Exploration, k: int) -> float:
    """The threshold of a candidate that gains a little less than it by the errors found without it."""
    names = [one.effect for one in found.candidates]
    gains = np.where(np.arange(len(names)) == k, 0.9 * found.thresholds[k], 0.0)
    thresholds = _given_candidate(
        found.scores, names, found.spans, gains, found.thresholds, replicates=200, seed=1
    )
    return float(thresholds[k])


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_poses_that_err_more_than_stated_are_no_scale(tmp_path: Path, seed: int) -> None:
    """Errors of four times their stated size: what they let a scale gain is below its threshold."""
    found, k = explored_scale(tmp_path, scale=0.0, wrong=4.0, seed=seed)
    assert error_size(found.scores.equations, found.scores.errors()) == pytest.approx(4.0, rel=0.35)
    assert found.gains[k] < found.thresholds[k]
    assert given_itself(found, k) > 0.7 * found.thresholds[k] > 10.0
    assert found.gains[k] < given_itself(found, k)


def test_a_scale_does_not_hide_behind_the_errors_of_poses_that_it_makes(tmp_path: Path) -> None:
    """8 mm/m at 0.6 to 4.5 m pass for pose errors of 5.5 times the stated 1 mm, but not beside a scale."""
    found, k = explored_scale(tmp_path, scale=0.008, wrong=1.0, seed=4)
    equations = found.scores.equations
    assert error_size(equations, found.scores.errors()) > 4.0
    assert error_size(equations, found.scores.errors(found.spans[k])) < 1.4
    assert found.thresholds[k] > 40.0
    assert given_itself(found, k) < 15.0
