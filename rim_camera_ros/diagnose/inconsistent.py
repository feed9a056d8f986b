"""Diagnoses of another set-up: where one wins, the files as given are compared without a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.accuracy import accuracy
from rim_camera_ros.diagnose.hypotheses import AS_GIVEN, LEAST_GAIN, Hypothesis
from rim_camera_ros.diagnose.nuisances import offset_beyond
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.diagnose.setup import check_setup, few_of
from rim_camera_ros.diagnose.variance import Variance
from rim_camera_ros.diagnose.where import of_residuals
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.moved_poses import moved_given_physics


def with_setups(diagnosis: Diagnosis, setups: list[Hypothesis]) -> Diagnosis:
    """Return the diagnosis with the set-ups, the best first; a reason against the set-up names the best one.

    Where the set-up is trusted the files as given come first: no other set-up gained enough.
    """
    reason = diagnosis.reason
    if reason is None:
        setups = sorted(setups, key=lambda hypothesis: hypothesis.hypothesis != AS_GIVEN)
    if diagnosis.verdict == "consistent" and setups:
        # offsets of the pixels absorbed it
        said = offset_beyond(setups[0].value, diagnosis.nuisances)
        diagnosis = replace(diagnosis, notes=[*diagnosis.notes, *([] if said is None else [said])])
    best = setups[0] if setups else None
    if (
        reason is not None
        and best is not None
        and best.is_better
        and not reason.startswith(f"{best.hypothesis}:")
        and not best.is_of_poses
    ):
        reason = f"{reason}; of the set-ups tried this fits best: {best.sentence}"
    return replace(diagnosis, setups=setups, reason=reason)


def without_search(
    setups: Sequence[Hypothesis], problem: Problem, camera: Camera, variance: Variance, seed: int
) -> Diagnosis:
    """Return the diagnosis of a recording to which nothing can be fitted.

    Where the files as given describe not a single usable pixel, there is no fit to compare set-ups with: the
    one that gains most wins, however much its gain scatters over the poses.

    Raises `InputError` where none gains enough either.
    """
    try:
        return hopeless(problem, camera, variance, seed)
    except InputError:
        leader = next(iter(setups), None)
        if leader is None or leader.gain <= LEAST_GAIN:
            raise
        return of_another_setup(leader, problem, camera, variance, seed)


def of_another_setup(
    other: Hypothesis, problem: Problem, camera: Camera, variance: Variance, seed: int
) -> Diagnosis:
    """Return the diagnosis of a recording of another set-up, compared with the files as they are given.

    Where these describe not a single pixel, it is compared with the other set-up.
    """
    try:
        return hopeless(problem, camera, variance, seed, reason=other.reason)
    except InputError:
        assert other.change is not None
        dataset, scene, changed = other.change(problem.dataset, problem.scene, camera)
        there = replace(problem, dataset=dataset, scene=scene)
        return replace(hopeless(there, changed, variance, seed, reason=other.reason), camera=camera)


def hopeless(
    problem: Problem, camera: Camera, variance: Variance, seed: int, *, reason: str | None = None
) -> Diagnosis:
    """Return the diagnosis of a recording for which no parameters can be found: it is of another set-up.

    Raises `InputError` where not a single pixel can be compared.
    """
    frozen = replace(problem, effects=(), gain=False, robust=False)
    folds = folds_of(problem.dataset)
    step = explore(frozen, camera, [], folds, replicates=0, iterations=0, seed=seed)
    moved = moved_given_physics(step, few_of(problem.dataset))
    setup = check_setup(step.fit, moved=moved)
    reason = (
        reason
        or setup.reason
        or (
            "no parameters of the camera bring recording and scene together: another scene, a board swapped "
            "or turned, or poses of another recording"
        )
    )
    likelihood = step.scores.log_likelihood()
    result = Result(camera, [], [step], likelihood, likelihood, frozen, folds)
    return Diagnosis(
        verdict="inconsistent_setup",
        missing=[],
        adjusted=[],
        ranking=[],
        indistinguishable=[],
        where=of_residuals(step.fit),
        accuracy=accuracy(camera, camera, result),
        variance=variance,
        camera=camera,
        baseline=step,
        final=step,
        found=[],
        next_recording=None,
        reason=reason,
        notes=list(problem.dataset.notes),
    )
