"""Errors of poses are judged conditional on an effect about which poses disagree: it may be to blame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.diagnose.nuisances import common_pose_beyond, conditional_on_physics, poses_beyond
from rim_camera_ros.diagnose.setup import check_poses, few_of
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.select.candidates import candidates, form_blocks
from rim_camera_ros.select.compare import NOT_IN_ALL_POSES, ONCE_FITTED, Refused
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, explore, explored, further_equations
from rim_camera_ros.select.moved_poses import moved_given_physics

from ..calibrate.helpers import camera, record, scene


def moved(data: Dataset, poses: tuple[int, ...], metres: float) -> Dataset:
    """Some poses of the board are recorded nearer to the camera than it stood."""
    stations = []
    for one in data.stations:
        x, y, z = one.truth["board"].position
        nearer = Pose((x, y, z - metres), one.truth["board"].orientation)
        stations.append(replace(one, truth={"board": nearer}) if one.pose in poses else one)
    return replace(data, stations=stations)


@pytest.mark.parametrize(
    ("scale", "poses", "why", "alone", "conditional"),
    [
        (
            0.006,
            (),
            NOT_IN_ALL_POSES,
            True,
            False,
        ),  # 4 to 27 mm from 0.6 to 4.5 m, of which the poses are free
        (0.006, (), ONCE_FITTED, True, True),  # fitted, it gained nothing: it takes up no errors
        (0.0, (2, 9, 17), NOT_IN_ALL_POSES, True, True),  # no scale moves three poses of 24
        (0.0, (), NOT_IN_ALL_POSES, False, False),
    ],
)
def test_poses_are_to_blame_for_what_no_disputed_effect_takes_up(
    tmp_path: Path, scale: float, poses: tuple[int, ...], why: str, alone: bool, conditional: bool
) -> None:
    board, stated = scene(tmp_path), camera(tmp_path)
    truth = camera(tmp_path, DistanceScale(scale)) if scale else stated
    data = moved(record(truth, board, poses=24, seed=9), poses, 0.03)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    pool = candidates(stated, facts, effects=["distance_scale"])
    problem = Problem(data, board)
    step = explore(problem, stated, pool, folds_of(data), replicates=0)
    refused = [Refused("distance_scale", 60.0, 20.0, why)]
    result: Any = SimpleNamespace(explorations=[step], refused=refused, problem=problem)
    assert (poses_beyond(step.fit, stated, {}) is not None) is alone
    said = poses_beyond(conditional_on_physics(result), stated, {(0, 9): 12.0})
    assert (said is not None) is conditional
    if said is not None:
        assert "times what is stated, most of all 9: these stand elsewhere" in said
    result.refused = []
    assert conditional_on_physics(result) is step.fit
    assert np.isfinite([*step.fit.nuisances.values()]).all()


STRANGE = EmitterOffset((0.25, -0.15, 0.06))


def with_strange_emitter(
    folder: Path, emitter: EmitterOffset, *, growth: float, poses: tuple[int, ...]
) -> tuple[Exploration, Any]:
    """The fit of an emitter whose effect grows with distance [1/m], and a search that ended there.

    The board of some ``poses`` stood 30 mm nearer.
    """
    board, stated = scene(folder), camera(folder)
    without, with_emitter = (
        record(one, board, poses=24, seed=9) for one in (stated, camera(folder, emitter))
    )
    stations = []
    for one, other in zip(without.stations, with_emitter.stations, strict=True):
        change = (other.distance - one.distance) * (1.0 + growth * (one.distance - 2.5))
        stations.append(replace(other, distance=one.distance + change))
    data = moved(replace(without, stations=stations), poses, 0.03)
    folds, problem = folds_of(data), Problem(data, board)
    fitted = fit(problem, camera(folder, emitter))
    forms = form_blocks(fitted, ["emitter_offset"], [])
    step = explored(further_equations(fitted, forms, folds, problem), [], forms=forms, replicates=0)
    return step, SimpleNamespace(explorations=[step], refused=[], problem=problem)


@pytest.mark.parametrize(("poses", "conditional"), [((), False), ((2, 9, 17), True)])
def test_poses_are_not_to_blame_for_what_the_form_of_an_effect_leaves(
    tmp_path: Path, poses: tuple[int, ...], conditional: bool
) -> None:
    """It tilts poses otherwise; moved poses are no form of it."""
    emitter = EmitterOffset((0.25, -0.15, 0.06))
    step, result = with_strange_emitter(tmp_path, emitter, growth=0.3, poses=poses)
    assert poses_beyond(step.fit, camera(tmp_path), {}) is not None
    assert (poses_beyond(conditional_on_physics(result), camera(tmp_path), {}) is not None) is conditional


@pytest.mark.parametrize(("poses", "conditional"), [((), False), (tuple(range(24)), True)])
def test_a_surface_is_not_to_blame_for_what_the_form_of_an_effect_leaves(
    tmp_path: Path, poses: tuple[int, ...], conditional: bool
) -> None:
    """It shifts all poses alike; a board that stands 30 mm nearer in all of them is no form of it."""
    emitter = EmitterOffset((0.1, -0.06, 0.02))
    step, result = with_strange_emitter(tmp_path, emitter, growth=0.4, poses=poses)
    assert common_pose_beyond(step.fit, camera(tmp_path)) is not None
    assert (common_pose_beyond(conditional_on_physics(result), camera(tmp_path)) is not None) is conditional


def test_what_the_form_of_an_effect_leaves_makes_no_pose_stand_out(tmp_path: Path) -> None:
    """Residuals and errors conditional on changes of the form, against the fit without them."""
    step, result = with_strange_emitter(tmp_path, STRANGE, growth=0.15, poses=())
    alone, conditional = check_poses(step.fit), check_poses(conditional_on_physics(result))
    assert max(one.chi_square for one in conditional) < max(one.chi_square for one in alone) - 0.3


def test_moved_poses_stand_out_given_the_form_of_an_effect(tmp_path: Path) -> None:
    _, result = with_strange_emitter(tmp_path, STRANGE, growth=0.15, poses=(2, 9, 17))
    may = few_of(result.problem.dataset)
    assert may.most == 3
    moved = moved_given_physics(result.explorations[-1], may)
    assert {2, 17} <= {pose for _, pose in (one.placement for one in moved)} <= {2, 9, 17}
    _, none = with_strange_emitter(tmp_path, STRANGE, growth=0.15, poses=())
    assert moved_given_physics(none.explorations[-1], may) == []
