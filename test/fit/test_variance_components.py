"""Poses that disagree, pixels with few looks, hyperbola against curve: who may rule a curve in amplitude."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.calibrate.acceptance import beyond_form
from rim_camera_ros.calibrate.solution import Solution
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixel_elimination import PATTERN_PRIOR
from rim_camera_ros.fit.pixels import usable_pixels
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.variance_components import (
    FIRST_SIZE,
    SIZES,
    first_pattern_prior,
    likely_pattern_prior,
    pose_chi_squares,
    pose_variance_factors,
    pose_variance_note,
)
from rim_camera_ros.parameters import ArrayFile, NestedList
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore

from ..calibrate.helpers import camera, record, scene

TIMES = (16.0, 60.0, 100.0)
BAD = (3, 10, 19)


def hyperbola(a: float) -> AmplitudeOffset:
    return AmplitudeOffset(MappingProxyType({t: Hyperbola(a, 1.5) for t in TIMES}))


def shone_upon(dataset: Dataset, *, poses: tuple[int, ...], light: float) -> Dataset:
    """Distances with ``light`` [m counts] / A more in some poses, as a weak second path adds."""
    stations = [
        replace(one, distance=one.distance + light / np.maximum(one.amplitude, 1.0))
        if one.pose in poses
        else one
        for one in dataset.stations
    ]
    return replace(dataset, stations=stations)


def strength(camera_: Camera) -> float:
    found = camera_.effects["amplitude_offset"]
    assert isinstance(found, AmplitudeOffset)
    return float(np.mean([one.a for one in found.hyperbola.values()]))


def test_a_few_poses_in_foreign_light_do_not_rule_the_hyperbola(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, hyperbola(21.0)), scene(tmp_path)
    dataset = shone_upon(record(truth, board), poses=BAD, light=15.0)
    plain = fit(Problem(dataset, board), truth)
    factors = pose_variance_factors(Problem(dataset, board), plain)
    assert factors is not None
    assert set(sorted(factors, key=lambda key: -factors[key])[:3]) == {(0, pose) for pose in BAD}
    others = [factor for (_, pose), factor in factors.items() if pose not in BAD]
    assert np.median(others) < 1.6
    assert min(factors[0, pose] for pose in BAD) > 5.0
    weighted = fit(Problem(dataset, board, variance_factors=factors), truth)
    assert abs(strength(weighted.camera) - 21.0) < 0.4 * abs(strength(plain.camera) - 21.0)
    assert "pose 3 (" in pose_variance_note(factors)
    # with these factors the poses agree as well as all others
    again = pose_chi_squares(weighted)
    assert max(again[0, pose] for pose in BAD) < 2.0


def test_poses_that_agree_weigh_the_same(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, hyperbola(21.0)), scene(tmp_path)
    dataset = record(truth, board)
    found = fit(Problem(dataset, board), truth)
    chi_squares = pose_chi_squares(found)
    assert len(chi_squares) == 24
    assert np.median(list(chi_squares.values())) == pytest.approx(1.0, abs=0.35)
    assert pose_variance_factors(Problem(dataset, board), found) is None


def windows(dataset: Dataset, *, height: int, width: int) -> Dataset:
    """The dataset with only a window of each station measured, somewhere else in each."""
    rng = np.random.default_rng(8)
    stations = []
    for one in dataset.stations:
        v, u = rng.integers(0, 36 - height + 1), rng.integers(0, 44 - width + 1)
        seen = np.zeros(one.count.shape, bool)
        seen[v : v + height, u : u + width] = True
        stations.append(replace(one, count=np.where(seen, one.count, 0)))
    return replace(dataset, stations=stations)


@pytest.mark.parametrize(("spread", "within"), [(0.004, (0.002, 0.008)), (0.0, (SIZES[0], 0.001))])
def test_the_size_of_the_pattern_where_pixels_have_few_looks(
    tmp_path: Path, spread: float, within: tuple[float, float]
) -> None:
    plain, board = camera(tmp_path, hyperbola(21.0)), scene(tmp_path)
    values = spread * np.random.default_rng(4).standard_normal((36, 44))
    pattern = FixedPatternOffset(ArrayFile("pattern.npy", values.astype(np.float32)))
    truth = with_effects(plain, {**plain.effects, "fixed_pattern_offset": pattern})
    dataset = windows(record(truth, board, poses=30), height=12, width=13)
    masks, _ = usable_pixels(Forward(dataset, board, plain))
    assert first_pattern_prior(masks) == FIRST_SIZE
    found = fit(Problem(dataset, board, masks=masks, pattern_prior=FIRST_SIZE), plain)
    assert within[0] <= likely_pattern_prior(found) <= within[1]


def test_small_offsets_of_pixels_leave_their_common_field_free(tmp_path: Path) -> None:
    """38 mm that all pixels share, and 21 mm from row to row, are neither a scale nor errors of poses."""
    plain, board = camera(tmp_path, hyperbola(21.0)), scene(tmp_path)
    rows = np.linspace(-1, 1, 36)[:, None] * np.ones((36, 44))
    field = (0.038 + 0.021 * rows).astype(np.float32)
    truth = with_effects(
        plain, {**plain.effects, "fixed_pattern_offset": FixedPatternOffset(ArrayFile("pattern.npy", field))}
    )
    dataset = record(truth, board, poses=30)
    problem = Problem(dataset, board, pattern_prior=FIRST_SIZE)
    folds = folds_of(dataset)
    step = explore(problem, plain, [], folds, replicates=0)
    poses = [v for name, v in step.fit.nuisances.items() if ".pose." in name and name.endswith("offset")]
    assert np.std(poses) < 0.006
    solution = Solution(step.fit, step.scores, folds, plain)
    for leave_out in (None, 0):
        found = solution.camera(leave_out).effects["fixed_pattern_offset"]
        assert isinstance(found, FixedPatternOffset)
        difference = found.map.values - field
        assert abs(np.mean(difference[6:-6, 6:-6])) < 0.006
        assert np.std(difference[6:-6, 6:-6]) < 0.003


def test_pixels_with_many_looks_tell_their_own_offset() -> None:
    everything = [(np.ones((4, 7), bool), np.ones((4, 7), bool))] * 6
    assert first_pattern_prior(everything) == PATTERN_PRIOR
    assert first_pattern_prior(everything[:3]) == FIRST_SIZE


def solved(dataset: Dataset, given: Camera, tmp_path: Path) -> tuple[Problem, Solution]:
    problem = Problem(dataset, scene(tmp_path))
    folds = folds_of(dataset)
    step = explore(problem, given, [], folds, replicates=0)
    return problem, Solution(step.fit, step.scores, folds, given)


def test_a_curve_that_turns_negative_is_distinguished_from_a_hyperbola(tmp_path: Path) -> None:
    given = camera(tmp_path, hyperbola(9.0))
    curve = Empirical(
        ("amplitude",),
        ((6.0, 14.0, 30.0, 70.0, 160.0),),
        NestedList(np.array([0.03, 0.004, -0.009, -0.006, 0.002])),
    )
    other = with_effects(given, {"empirical": curve})
    dataset = record(other, scene(tmp_path), poses=36)
    said = beyond_form(*solved(dataset, given, tmp_path))
    assert said is not None
    assert said.startswith(
        "a smooth curve in amplitude fits held-out poses better than the form of amplitude_offset"
    )
    assert "empirical:amplitude" in said
    assert beyond_form(*solved(record(given, scene(tmp_path)), given, tmp_path)) is None
