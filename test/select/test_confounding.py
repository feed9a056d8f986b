"""Drifts given other effects: what follows time, and what merely fits poses that something else moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Candidate, Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select import confounding
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.confounding import follows_time, quiet_pixels
from rim_camera_ros.select.evidence import Scores, folds_of

from ..calibrate.helpers import camera, record, scene

DRIFT = WarmUpDrift(terms=(Exponential(0.009, 400.0),))


def setting(tmp_path: Path, *effects: Effect, wrong: float = 1.0, poses: int = 24, seed: int = 3) -> Any:
    """A recording by a camera with some effects, and what a search knows of it."""
    board = scene(tmp_path)
    data = record(camera(tmp_path, *effects), board, poses=poses, wrong=wrong, seed=seed)
    facts = Facts.of(data, moves=False, surfaces=1, camera=camera(tmp_path))
    pool = candidates(camera(tmp_path), facts, effects=["warm_up_drift"])
    return data, Problem(data, board), pool, folds_of(data)


def fitted_with_drift(tmp_path: Path, problem: Problem, size: float = 0.005) -> Fit:
    return fit(problem, camera(tmp_path, WarmUpDrift(terms=(Exponential(size, 300.0),))))


def test_a_drift_follows_time(tmp_path: Path) -> None:
    _, problem, pool, folds = setting(tmp_path, DRIFT)
    assert follows_time(fitted_with_drift(tmp_path, problem), "warm_up_drift", pool, folds, problem)


@pytest.mark.long
def test_errors_of_poses_do_not(tmp_path: Path) -> None:
    """Poses wrong by five sigmas: a fitted drift explains some of it, as any order would."""
    found = []
    for seed in range(6):
        _, problem, pool, folds = setting(tmp_path, wrong=5.0, seed=seed)
        fitted = fitted_with_drift(tmp_path, problem)
        found.append(follows_time(fitted, "warm_up_drift", pool, folds, problem))
    assert not any(found)


def test_a_drift_that_leaves_poses_as_wrong_as_they_were_is_none(tmp_path: Path) -> None:
    """In the true order it says more than by chance, but far less than what moves the poses."""
    _, problem, pool, folds = setting(tmp_path, DRIFT, wrong=12.0)
    fitted = fitted_with_drift(tmp_path, problem)
    assert not follows_time(fitted, "warm_up_drift", pool, folds, problem)


def test_few_poses_cannot_tell(tmp_path: Path) -> None:
    _, problem, pool, folds = setting(tmp_path, poses=6)
    fitted = fitted_with_drift(tmp_path, problem)
    assert follows_time(fitted, "warm_up_drift", pool, folds, problem)
    empty: list[Candidate] = []
    assert follows_time(fitted, "warm_up_drift", empty, folds, problem)


@pytest.mark.long
def test_where_a_cyclic_error_does_not_act_a_drift_still_shows(tmp_path: Path) -> None:
    """The form fitted lacks a harmonic, which moves poses, but not where the other one is zero, too."""
    cyclic = CyclicError((Harmonic(4, 0.02, 0.7), Harmonic(8, 0.006, 1.4)))
    one_harmonic = CyclicError((Harmonic(4, 0.02, 0.7),))
    for drift, follows in ((DRIFT, True), (WarmUpDrift(terms=(Exponential(1e-5, 400.0),)), False)):
        _, problem, pool, folds = setting(tmp_path, cyclic, drift, poses=36)
        model = camera(tmp_path, one_harmonic, WarmUpDrift(terms=(Exponential(0.004, 300.0),)))
        fitted = fit(problem, model)
        masks = quiet_pixels(fitted, ["cyclic_error"])
        assert masks is not None
        kept = sum(int(distance.sum()) for distance, _ in masks)
        used = sum(int(one.used.sum()) for one in fitted.forward.predictions(slopes=False))
        assert 0.05 < kept / used < 0.5
        quiet = replace(problem, masks=masks)
        assert (follows_time(fitted, "warm_up_drift", pool, folds, quiet) is True) is follows
        in_all = confounding.follows_time_in_quiet_pixels(
            fitted,
            "warm_up_drift",
            problem,
            folds,
            found=["cyclic_error"],
            drifts=pool,
            curves=[],
            variants=[],
            seed=1,
        )
        assert in_all is follows


@pytest.mark.parametrize(("size", "follows"), [(0.009, True), (1e-5, False)])
def test_where_quiet_pixels_know_too_little_all_pixels_are_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: float, follows: bool
) -> None:
    """As those of one integration time, where that of the others has another offset: here of two poses."""
    drift = WarmUpDrift(terms=(Exponential(size, 400.0),))
    _, problem, pool, folds = setting(tmp_path, drift)
    fitted = fitted_with_drift(tmp_path, problem)
    masks = [
        (one.used & (k in (11, 19)), one.amplitude_used & (k in (11, 19)))
        for k, one in enumerate(fitted.forward.predictions(slopes=False))
    ]
    few = replace(problem, masks=masks)
    assert follows_time(fitted, "warm_up_drift", pool, folds, few) is None
    monkeypatch.setattr(confounding, "quiet_pixels", lambda fitted, names: masks)
    asked = confounding.follows_time_in_quiet_pixels(
        fitted, "warm_up_drift", problem, folds, found=[], drifts=pool, curves=[], variants=[], seed=1
    )
    assert asked is follows


def test_equations_after_the_base_is_eliminated(tmp_path: Path) -> None:
    """Against the inverse of the whole matrix, whose block is the inverse of the Schur complement."""
    _, problem, pool, folds = setting(tmp_path, DRIFT)
    block = pool[-1].block
    fitted = fit(
        problem, camera(tmp_path, CyclicError((Harmonic(4, 0.001, 0.7),))), fold_of=folds, further=[block]
    )
    count = len(fitted.parameters)
    extra = list(range(count, count + len(block.regressors)))
    scores = Scores(fitted.equations, range(count))
    gram, right = scores.conditional_on_base(extra)
    every = [*range(count), *extra]
    covariance = scores.covariance(np.array(every))[count:, count:]
    priors = np.array([one.prior for one in block.regressors])
    assert np.linalg.inv(covariance) == pytest.approx(gram + np.diag(priors**-2.0), rel=1e-6)
    values = scores.values(extra)
    solution = covariance @ right
    assert solution == pytest.approx([values[one.label] for one in block.regressors], rel=1e-6)
