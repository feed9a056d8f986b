"""A board that stands elsewhere than its poses say: found given the offsets of all pixels."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.diagnose.depth import depths, standing_elsewhere
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.diagnose.setup_trials import moved, normal_of
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.frame import Pose
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene


def displaced(data: Dataset, shift: tuple[float, float, float]) -> Dataset:
    """The dataset whose poses of all surfaces are moved by a vector [m]."""
    stations = [
        replace(one, truth={name: moved(pose, np.array(shift)) for name, pose in one.truth.items()})
        for one in data.stations
    ]
    return replace(data, stations=stations)


def cyclic(given: Camera) -> Camera:
    """The camera with a cyclic error of 12 mm that its file lacks."""
    effect = CyclicError(harmonics=(Harmonic(4, 0.012, 0.7),))
    return with_effects(given, {effect.name: effect})


def test_the_normal_of_a_pose_points_away_from_the_camera() -> None:
    turned = Pose((0.2, -0.1, 2.0), (0.0, 0.99875, 0.05, 0.0))  # nearly upside down
    normal = normal_of(turned)
    assert normal[2] > 0.98
    assert np.abs(normal) == pytest.approx(np.abs(rotation_matrix(turned.orientation)[:, 2]))
    assert moved(turned, 0.3 * normal).position[2] == pytest.approx(2.0 + 0.3 * normal[2])


@pytest.mark.long
def test_a_depth_is_measured_given_offsets_of_pixels(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    data = displaced(record(given, board, poses=16, seed=5), (0.0, 0.0, -0.045))
    result = diagnose(data, board, given)
    assert result.verdict == "inconsistent_setup"
    assert (result.setups[0].hypothesis, result.setups[0].surface) == ("depth", "board")
    assert result.setups[0].value == pytest.approx(45.0, abs=2.5)  # away from the camera [mm]
    assert re.match(r"depth: board 4\d mm farther away than its poses say explains", str(result.reason))
    nearer = replace(result.setups[0], value=-50.4)
    assert nearer.sentence == "board 50 mm nearer than its poses say"
    assert result.missing == []


def test_physics_that_is_missing_is_no_depth(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    data = record(cyclic(given), board, poses=16, seed=5)
    problem = Problem(data, board)
    facts = Facts.of(data, moves=False, surfaces=1, camera=given)
    result = search(problem, given, facts)
    assert [one.effect for one in result.found] == ["cyclic_error"]
    leading = depths(result.explorations[0], result.problem, result.folds)
    assert [one.surface for one in leading] == ["board"]
    assert leading[0].gain < result.found[0].gain
    assert standing_elsewhere(result, result.fit, problem, given, say=lambda text: None) == []


def test_a_file_states_its_known_terms_of_a_surface_elsewhere_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fits begin at what the files as given make of a sinusoid; priors stay about the file's."""
    stated = CyclicError((Harmonic(4, 0.008, 0.7),))
    given, board = camera(tmp_path, stated), scene(tmp_path)
    data = displaced(record(cyclic(given), board, poses=16, seed=5), (0.0, 0.0, -0.045))
    problem = Problem(data, board)
    facts = Facts.of(data, moves=False, surfaces=1, camera=given)
    result = search(problem, given, facts, most=0)
    calls: list[tuple[Problem, Camera]] = []

    def explored(problem: Problem, start: Camera, *rest: Any, **options: Any) -> Exploration:
        calls.append((problem, start))
        return explore(problem, start, *rest, **options)

    monkeypatch.setattr("rim_camera_ros.diagnose.depth.explore", explored)
    standing_elsewhere(result, result.fit, problem, given, say=lambda text: None)
    assert len(calls) == 2
    assert all(problem.origin is given for problem, _ in calls)
    start = calls[1][1].effects["cyclic_error"]
    assert start == result.fit.camera.effects["cyclic_error"]
    assert start != stated
