"""To what the distances of an effect are known, given offsets of pixels, which its parameters trade with."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.diagnose.intervals import Uncertainty, distances_known_to, intervals_of, uncertainty_of
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore

from ..calibrate.helpers import camera, record, scene

TRUE = {16.0: 0.011, 60.0: -0.004, 100.0: 0.002}


@pytest.mark.long
def test_differences_of_settings_are_known_far_better_than_the_offset_of_each(tmp_path: Path) -> None:
    board = scene(tmp_path)
    truth = camera(tmp_path, IntegrationTimeOffset(MappingProxyType(TRUE)))
    z = []
    for seed in range(6):
        data = record(truth, board, poses=18, frames=2, seed=seed)
        problem = Problem(data, board)
        step = explore(problem, truth, [], folds_of(data), replicates=0)
        uncertainty = uncertainty_of(step, problem, seed=1)
        (known,) = distances_known_to(step.fit, problem, uncertainty, ["integration_time_offset"]).values()
        assert distances_known_to(step.fit, problem, uncertainty, ["multipath"]) == {}
        offsets = {t: f"effects.integration_time_offset.offset.{t:g}" for t in TRUE}
        intervals = intervals_of(step.fit, uncertainty)
        widths = [intervals[path][2] - intervals[path][1] for path in offsets.values()]
        assert min(widths) > 20 * known
        # each pixel sees a third of the poses with each setting
        error = np.array([step.fit.parameters[offsets[t]] - TRUE[t] for t in TRUE])
        z.append(float(np.std(error)) / known)
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.long
def test_the_sentence_says_it(tmp_path: Path) -> None:
    board, stated = scene(tmp_path), camera(tmp_path)
    truth = camera(tmp_path, IntegrationTimeOffset(MappingProxyType(TRUE)))
    found = diagnose(record(truth, board, poses=18, seed=3), board, stated)
    (one,) = found.missing
    said = re.search(
        r"\(99 % of them less\), known to ([\d.]+) mm \(1 sigma\) apart from offsets of the pixels",
        one.sentence,
    )
    assert said is not None
    assert 0.05 < float(said[1]) < 2.0
    assert one.distance_sigma == pytest.approx(1e-3 * float(said[1]), rel=0.1)


def test_quadratic_forms_of_all_that_is_known_of_parameters() -> None:
    """sqrt(trace(F C)), of the largest covariance; jackknives only where they are far larger."""
    draws = np.array([[4.0, 1.5], [1.5, 9.0]])
    posterior = np.array([[6.0, -2.0], [-2.0, 5.0]])
    jackknife = np.array([[30.0, 0.0], [0.0, 10.0]])
    known = Uncertainty(draws, posterior, ((jackknife, 2.0),))
    assert known.of_each() == pytest.approx(np.sqrt([30.0, 9.0]))
    assert known.sigma(np.array([[1.0, -1.0], [-1.0, 1.0]])) == pytest.approx(np.sqrt(15.0))
    assert replace(known, jackknives=()).of_each() == pytest.approx(np.sqrt([6.0, 9.0]))
    assert known.sigma(np.zeros((2, 2))) == 0.0
