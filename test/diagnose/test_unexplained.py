"""What is said where neither an effect nor a smooth function describes what does not fit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from rim_camera_ros.diagnose.described import unexplained
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit

from ..calibrate.helpers import camera, record, scene


def with_hands(data: Dataset) -> Dataset:
    """The dataset with something 90 mm nearer in 30 of 1,584 pixels of each pose, elsewhere in each."""
    rng = np.random.default_rng(12)
    stations = []
    for one in data.stations:
        row, column = (int(rng.integers(0, size - 6)) for size in one.distance.shape)
        distance = one.distance.copy()
        distance[row : row + 5, column : column + 6] -= 0.09
        stations.append(replace(one, distance=distance))
    return replace(data, stations=stations)


def test_few_values_that_hold_the_misfit_are_reported(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    plain = record(given, board, poses=16, frames=4, seed=3)
    hidden = fit(Problem(with_hands(plain), board), given)
    sentence = unexplained(hidden, 3.1)[0].sentence
    found = re.search(r"; (\S+)% of the values, beyond (\S+) sigma, hold (\d+)% of it, as a hand", sentence)
    assert found is not None, sentence
    values = sum(int(one.used.sum()) for one in hidden.forward.predictions(slopes=False))
    # noise exceeds it, one value in all, in 2 % of recordings
    assert float(found[2]) == pytest.approx(norm.isf(0.01 / values), abs=0.051)
    assert float(found[1]) == pytest.approx(100 * 30 / 1584, rel=0.5)
    assert int(found[3]) > 80


def test_a_wrong_noise_model_is_no_hand(tmp_path: Path) -> None:
    """Values of twice the noise are rarely that far off."""
    given, board = camera(tmp_path), scene(tmp_path)
    noisy = replace(given, noise=replace(given.noise, floor=2 * given.noise.floor))
    data = record(noisy, board, poses=16, frames=4, seed=3)
    sentence = unexplained(fit(Problem(data, board), given), 2.5)[0].sentence
    assert "scatter by 1.58 times" in sentence
    assert "of the values" not in sentence
