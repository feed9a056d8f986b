"""Surfaces that stand elsewhere than is said: the evidence for it. Nulls first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import reduce_folds
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select import moved_poses as module
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.evidence import Scores, folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.moved_poses import (
    FREEDOM,
    MayHaveMoved,
    MovedPose,
    moved_before_physics,
    moved_given_physics,
    moved_poses,
)

from ..calibrate.helpers import camera, record, scene, with_wrong_pose


def fitted_to(data: Dataset, tmp_path: Path) -> tuple[Fit, Scores]:
    found = fit(Problem(data, scene(tmp_path)), camera(tmp_path))
    return found, Scores(found.equations, range(len(found.parameters)))


@pytest.mark.parametrize("seed", [3, 4])
def test_poses_within_their_errors_stand_where_they_are_said_to(tmp_path: Path, seed: int) -> None:
    _, scores = fitted_to(record(camera(tmp_path), scene(tmp_path), poses=16, seed=seed), tmp_path)
    assert moved_poses(scores, least_gain=5.0, most=16) == []


def test_those_that_do_not_are_found_with_what_they_are_off_by(tmp_path: Path) -> None:
    data = record(camera(tmp_path), scene(tmp_path), poses=16, seed=3)
    for number, by in ((4, 0.05), (6, -0.03)):
        data = with_wrong_pose(data, number, by)
    _, scores = fitted_to(data, tmp_path)
    first, second = moved_poses(scores, least_gain=20.0, most=16)
    assert [pose.placement for pose in (first, second)] == [(0, 4), (0, 6)]
    assert first.gain > second.gain > 20.0
    for pose, by in ((first, 0.05), (second, -0.03)):
        board = data.stations[pose.placement[1]].truth["board"]
        x, y = board.orientation[:2]
        along = by * (1 - 2 * (x**2 + y**2))
        assert pose.surface == "board"
        assert dict(pose.errors)["offset"] == pytest.approx(-along, abs=0.002)
        assert pose.sigmas == pytest.approx(abs(along) / 0.001, rel=0.2)
    assert "nearer along its normal" in first.sentence
    assert "farther along its normal" in second.sentence
    # no more than may have moved
    assert [pose.placement for pose in moved_poses(scores, least_gain=20.0, most=1)] == [(0, 4)]


def test_the_gain_is_the_ratio_of_marginal_likelihoods(tmp_path: Path) -> None:
    """Against the determinants of the equations reduced anew with wider errors of that pose."""
    data = with_wrong_pose(record(camera(tmp_path), scene(tmp_path), poses=12, seed=5), 7, 0.012)
    found, scores = fitted_to(data, tmp_path)

    def evidence(factor: float) -> float:
        folds = [
            replace(
                fold,
                nuisances=[
                    (name, prior * factor if name.startswith("0.7.pose.") else prior, at)
                    for name, prior, at in fold.nuisances
                ],
            )
            for fold in found.equations.folds
        ]
        reduced = reduce_folds(folds, priors_of(found.equations.regressors), found.equations.pixels)
        matrix = reduced.gram + np.diag(found.priors**-2)
        right = reduced.right - scores.away / found.priors**2
        square = float(reduced.square) - float(right @ np.linalg.solve(matrix, right))
        return float(-0.5 * square - reduced.log_norm - 0.5 * np.linalg.slogdet(matrix)[1])

    (pose,) = moved_poses(scores, least_gain=5.0, most=12)
    assert pose.placement == (0, 7)
    assert pose.gain == pytest.approx(evidence(FREEDOM) - evidence(1.0), rel=1e-4)


def test_poses_that_are_all_alike_are_no_error(tmp_path: Path) -> None:
    """Offsets of pixels take on all that errors of the only pose do, however large they may be."""
    one = record(camera(tmp_path), scene(tmp_path), poses=1, seed=3).stations[0]
    alike = [replace(one, pose=k, placement=k, stamp=one.stamp + k, time=float(k)) for k in range(6)]
    board = scene(tmp_path)
    loose = replace(board.surfaces[0], pose_sigma=(100.0, 30.0), pose_common=1.0)
    data = Dataset(alike, ["simulated"], [], 6)
    found = fit(Problem(data, replace(board, surfaces=(loose,))), camera(tmp_path))
    scores = Scores(found.equations, range(len(found.parameters)))
    assert moved_poses(scores, least_gain=5.0, most=6) == []


POSES = [MovedPose((0, k), "board", gain, (("offset", 0.03),), 30.0) for k, gain in ((3, 60.0), (8, 45.0))]


@pytest.mark.parametrize(
    ("gains", "pair", "expected"),
    [
        ([2.0, 80.0], None, POSES),  # 105 of 80 + 20 nats
        ([2.0, 90.0], None, []),
        ([2.0, 80.0], (90.0, (0, 1)), []),  # two effects together explain as much
        ([], None, POSES),
    ],
)
def test_poses_come_first_where_they_explain_more_than_physics(
    monkeypatch: pytest.MonkeyPatch, gains: list[float], pair: Any, expected: list[MovedPose]
) -> None:
    monkeypatch.setattr(module, "moved_poses", lambda *_, **__: POSES)
    step: Any = SimpleNamespace(conditional=None, gains=np.array(gains), best_pair=lambda: pair)
    assert moved_before_physics(step, MayHaveMoved(2, 20.0)) == expected


@pytest.mark.parametrize(("most", "expected"), [(1, []), (2, POSES)])
def test_what_many_poses_show_given_physics_is_physics(
    monkeypatch: pytest.MonkeyPatch, most: int, expected: list[MovedPose]
) -> None:
    monkeypatch.setattr(module, "moved_poses", lambda *_, most, **__: POSES[:most])
    step: Any = SimpleNamespace(conditional=None)
    assert moved_given_physics(step, MayHaveMoved(most, 20.0)) == expected


def test_a_tilt_by_pixels_beside_edges_alone_is_none(tmp_path: Path) -> None:
    """Beside edges, an inexact form of what acts there leaves residuals that look like a tilt of one pose."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=16, seed=3)
    forward = Forward(data, board, truth)
    forward.estimate_amplitudes()
    clean, edges = forward.pixels_used(), forward.pixels_near_edges()
    side = np.where(np.arange(44) < 20, 0.06, -0.06)
    stations = []
    for one, (away, _), (near, _) in zip(data.stations, clean, edges, strict=True):
        by = np.where(near & ~away & (one.pose == 6), side, 0.0)
        stations.append(replace(one, distance=one.distance + by))
    data = replace(data, stations=stations)
    problem, folds = Problem(data, board), folds_of(data)
    steps = [explore(replace(problem, masks=masks), truth, [], folds) for masks in (clean, edges)]
    result = Result(truth, [], steps, 0.0, 0.0, replace(problem, masks=edges), folds, beside_edges=1)
    seen = moved_poses(steps[1].conditional, least_gain=20.0, most=3)
    assert [pose.placement for pose in seen] == [(0, 6)]
    assert moved_poses(result.away_from_edges().conditional, least_gain=20.0, most=3) == []
    kept = result.without_edges(steps[1].fit).forward.masks
    assert kept is not None
    for (used, lit), (away, shown) in zip(kept, clean, strict=True):
        assert np.array_equal(used, away)
        assert np.array_equal(lit, shown)
    # of a search without such pixels, both are those of its end
    plain = replace(result, beside_edges=None)
    assert plain.away_from_edges() is steps[1]
    assert plain.without_edges(steps[1].fit) is steps[1].fit
