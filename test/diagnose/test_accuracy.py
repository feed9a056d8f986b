"""What a report says of held-out poses: they must not have had a say in what they are compared with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import added
from rim_camera_ros.diagnose.accuracy import Accuracy, accuracy
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.noise import Noise
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import load_scene
from rim_camera_ros.select.search import search

from ..calibrate.floor import UNKNOWN, floor_camera, floor_scene, write_floor
from ..calibrate.helpers import camera, record, scene


def of_table(folder: Path, offsets: np.ndarray, *, knots: int) -> tuple[Accuracy, Accuracy]:
    """What a table over time makes of offsets [m] of the poses: estimated without each fifth, with all."""
    board = scene(folder)
    known = replace(camera(folder), noise=Noise(floor=0.003, shot=0.0, amplitude=0.0))
    data = record(known, board, poses=len(offsets), frames=3, seed=5, wrong=0.0)
    moved = [replace(one, distance=one.distance + d) for one, d in zip(data.stations, offsets, strict=True)]
    # poses that are stated accurately leave an offset to the table
    sure = replace(board, surfaces=(replace(board.surfaces[0], pose_sigma=(1e-4, 5e-4)),))
    problem = Problem(replace(data, stations=moved), sure)
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=known)
    result = search(problem, known, facts, effects=["distance_scale"], most=0)
    times = [one.time for one in moved]
    at = tuple(np.linspace(min(times), max(times), knots).tolist())
    start = added(known, Empirical(("time",), (at,), NestedList(np.zeros(knots))))
    fitted = fit(replace(result.problem, effects=("empirical",)), start, warm=result.fit, iterations=3)
    return accuracy(known, fitted.camera, result, fitted), accuracy(known, fitted.camera, result)


def beyond_noise(found: Accuracy, rms: float) -> float:
    return float(np.sqrt(rms**2 - found.noise_floor**2))


def test_a_table_of_chance_does_not_help_the_poses_that_made_it(tmp_path: Path) -> None:
    chance = np.random.default_rng(7).normal(0, 0.01, 24)
    others, all_poses = of_table(tmp_path, chance, knots=12)
    assert beyond_noise(all_poses, all_poses.rms_after) < 0.7 * beyond_noise(all_poses, all_poses.rms_before)
    assert others.rms_after > others.rms_before
    assert not others.table_of_all


def test_a_table_of_a_drift_helps_the_poses_that_it_has_not_seen(tmp_path: Path) -> None:
    drift = 0.01 * np.sin(np.arange(24) / 5.0)
    others, all_poses = of_table(tmp_path, drift, knots=8)
    assert beyond_noise(others, others.rms_after) < 0.4 * beyond_noise(others, others.rms_before)
    assert all_poses.rms_after <= others.rms_after
    # amplitudes of a simulation are better than the percent to which any amplitude is predicted
    assert 0.8 < others.chi2_after < 1.1


def test_a_table_of_too_many_values_is_of_all_poses_and_says_so(tmp_path: Path) -> None:
    found, _ = of_table(tmp_path, 0.01 * np.sin(np.arange(24) / 5.0), knots=160)
    assert found.table_of_all
    assert any(
        "was fitted to all poses, also to those that it is compared with" in one for one in found.notes()
    )


def test_without_a_table_nothing_is_said_of_one() -> None:
    assert Accuracy(0.01, 0.005, 0.004, 2.0, 1.0, held_out=True).notes() == []


@pytest.mark.parametrize("sigma", [(0.005, 0.003), (0.03, 0.02)])
def test_poses_that_are_alike_do_not_trade_with_the_pattern(
    tmp_path: Path, sigma: tuple[float, float]
) -> None:
    """No effect is missing: what remains of held-out poses is the noise, however badly poses are known."""
    known = floor_camera(tmp_path, scale=4)
    write_floor(tmp_path / "bag", known, tmp_path, poses=14, seed=3, wrong=0.004)
    board = load_scene(floor_scene(tmp_path, UNKNOWN, sigma=sigma))
    data = reduce_recording(tmp_path / "bag", known, scene=board)
    facts = Facts.of(data, moves=False, surfaces=1, camera=known)
    result = search(Problem(data, board), known, facts, effects=["distance_scale"], most=0)
    found = accuracy(known, known, result)
    # the offset of a pixel is known from a dozen looks
    assert found.rms_before == pytest.approx(found.noise_floor * np.sqrt(1 + 1 / 11), rel=0.06)
