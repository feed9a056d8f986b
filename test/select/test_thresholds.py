"""What a candidate must gain where poses err by more than stated: by themselves, or by what is missing."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, _gain, _given_candidate, explore
from rim_camera_ros.select.null_replicates import error_size
from rim_camera_ros.select.thresholds import (
    ALARM_RATE,
    least_threshold,
    rate_of_each,
    thresholds_at,
)

from ..calibrate.helpers import camera, record, scene


def gains_of_fits(replicates: int, widths: list[int], shared: float, seed: int) -> np.ndarray:
    """Gains (C, R) of fits of Gaussian noise, which correlates from candidate to candidate, as held out."""
    rng = np.random.default_rng(seed)
    common = rng.standard_normal((max(widths), replicates))
    result = []
    for width in widths:
        own = rng.standard_normal((width, replicates))
        z = np.sqrt(shared) * common[:width] + np.sqrt(1 - shared) * own
        result.append(0.5 * np.sum(z**2, axis=0) - 0.5 * width)
    return np.array(result)


@pytest.mark.parametrize("shared", [0.0, 0.5, 0.95])
@pytest.mark.parametrize("scale", [1.0, 6.0])
def test_all_candidates_together_raise_as_many_alarms_as_stated(shared: float, scale: float) -> None:
    """Thresholds from 200 replicates, alarms in 20,000 others; errors of poses widen all gains."""
    widths = [1] * 9 + [2] * 4 + [5] * 3
    alarms = []
    for seed in range(12):
        drawn = scale * gains_of_fits(200, widths, shared, seed)
        thresholds = thresholds_at(rate_of_each(drawn, widths), drawn, widths)
        others = scale * gains_of_fits(20_000, widths, shared, 100 + seed)
        alarms.append(np.mean(np.any(others > thresholds[:, None], axis=0)))
    assert np.mean(alarms) == pytest.approx(ALARM_RATE, rel=0.5)


def test_the_same_candidate_many_times_is_one_test() -> None:
    one = gains_of_fits(4000, [1], 0.0, 3)
    assert rate_of_each(np.repeat(one, 30, axis=0), [1] * 30) == pytest.approx(ALARM_RATE, rel=0.1)
    twelve = rate_of_each(gains_of_fits(4000, [1] * 12, 0.0, 3), [1] * 12)
    assert twelve == pytest.approx(1 - 0.98 ** (1 / 12), rel=0.1)


def test_thresholds_are_quantiles_of_chi_square() -> None:
    """Of one parameter at 1 in 1,000: 10.828 / 2 (tables of chi-square), less what held-out poses cost."""
    assert least_threshold(0.001) == pytest.approx(5.414, abs=0.001)
    drawn = gains_of_fits(100_000, [3], 0.0, 8)
    assert thresholds_at(0.001, drawn, [3])[0] == pytest.approx(16.266 / 2 - 1.5, rel=0.02)


def test_gains_without_a_spread_have_the_threshold_of_one_parameter() -> None:
    """A bound or a prior leaves a candidate nothing to gain by chance, nor by 100 replicates to tell so."""
    still = np.zeros((2, 100))
    assert thresholds_at(0.0012, still, [1, 4]) == pytest.approx(least_threshold(0.0012))


def explored_scale(tmp_path: Path, *, scale: float, wrong: float, seed: int) -> tuple[Exploration, int]:
    stated, board = camera(tmp_path), scene(tmp_path)
    truth = camera(tmp_path, DistanceScale(scale)) if scale else stated
    data = record(truth, board, poses=20, seed=seed, wrong=wrong)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    pool = candidates(stated, facts, effects=["distance_scale"])
    found = explore(Problem(data, board), stated, pool, folds_of(data), seed=seed)
    return found, found.best()["distance_scale"]


def given_itself(found: Exploration, k: int) -> float:
    """The threshold of a candidate that gains a little less than it by the errors found without it."""
    names = [one.effect for one in found.candidates]
    gains = np.where(np.arange(len(names)) == k, 0.9 * found.thresholds[k], 0.0)
    thresholds = _given_candidate(
        found.scores, names, found.spans, gains, found.thresholds, rate=0.02, replicates=200, seed=1
    )
    return float(thresholds[k])


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_poses_that_err_more_than_stated_are_no_scale(tmp_path: Path, seed: int) -> None:
    """Errors of four times their stated size: what they let a scale gain is below its threshold."""
    found, k = explored_scale(tmp_path, scale=0.0, wrong=4.0, seed=seed)
    assert error_size(found.scores.equations, found.scores.errors()) == pytest.approx(4.0, rel=0.35)
    assert found.gains[k] < found.thresholds[k]
    assert found.thresholds[k] > 10.0
    assert given_itself(found, k) > 0.7 * found.thresholds[k]
    assert found.gains[k] < given_itself(found, k)


def test_a_scale_does_not_hide_behind_the_errors_of_poses_that_it_makes(tmp_path: Path) -> None:
    """8 mm/m at 0.6 to 4.5 m pass for pose errors of 5.5 times the stated 1 mm, but not given a scale."""
    found, k = explored_scale(tmp_path, scale=0.008, wrong=1.0, seed=4)
    equations = found.scores.equations
    assert error_size(equations, found.scores.errors()) > 4.0
    assert error_size(equations, found.scores.errors(found.spans[k])) < 1.4
    assert found.thresholds[k] > 30.0
    assert given_itself(found, k) < 15.0


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.4, 9.0), (-2.9, 6.5), (-3.1, 0.0)],
    ids=["possible", "negative by chance", "negative by more"],
)
def test_a_share_of_light_that_chance_makes_negative_gains_nothing(share: float, expected: float) -> None:
    """Its sigma is 1; without it the other parameter of the candidate gains 6.5 nats."""
    labels = ["effects.x.share", "effects.x.width"]
    scores: Any = SimpleNamespace(
        regressors=[SimpleNamespace(label=one) for one in labels],
        gain=lambda span: {(0, 1): 9.0, (1,): 6.5}[tuple(span)],
        values=lambda span: {labels[0]: share, labels[1]: -7.0},
        columns=lambda span: np.array([*span]),
        covariance=lambda columns: np.diag([1.0, 4.0]),
    )
    candidate: Any = SimpleNamespace(positive=(labels[0],))
    assert _gain(scores, candidate, [0, 1]) == expected
