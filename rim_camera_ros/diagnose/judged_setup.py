"""Whether a recording is of the set-up that its files state, given the physics that was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.begin import Begun, Inputs
from rim_camera_ros.diagnose.compare_setups import against_physics
from rim_camera_ros.diagnose.depth import standing_elsewhere
from rim_camera_ros.diagnose.found_physics import FoundPhysics
from rim_camera_ros.diagnose.hypotheses import DEPTH, Hypothesis, best_setup, by_gain, poses_elsewhere
from rim_camera_ros.diagnose.nuisances import (
    common_pose_beyond,
    disputed_effect,
    flatness_beyond,
    poses_beyond,
    reflectivities_beyond,
)
from rim_camera_ros.diagnose.setup import Setup, check_setup, errors_of_poses
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.select.candidates import SHARE
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.moved_poses import moved_given_physics, total_gain


@dataclass(frozen=True)
class JudgedSetup:
    """The judgement of the set-up: the ``reason`` not to trust it (None: it is trusted), and bad poses.

    ``setups`` are the alternatives with their gains, ``winner`` is one that explains more than the physics.
    """

    setup: Setup
    setups: list[Hypothesis]
    winner: Hypothesis | None
    reason: str | None

    def without_bad_poses(self, dataset: Dataset) -> Dataset:
        """Return the recording without its bad poses, with a note on them."""
        kept = dataset.without({*self.setup.bad})
        return replace(kept, notes=[*kept.notes, f"{self.setup.fault}; excluded"])


def judged_setup(inputs: Inputs, begin: Begun, found: FoundPhysics, setups: list[Hypothesis]) -> JudgedSetup:
    """Judge the set-up given the physics found: poses, other set-ups, displaced surfaces, tiles."""
    camera, problem, result = inputs.camera, begin.problem, found.result
    conditional, best_fit = found.conditional, found.best_fit
    moved, form_size = result.moved, SHARE
    if not moved and found.described is None:
        disputed = disputed_effect(result)
        extra = [] if disputed is None else found.final.spans[disputed]
        may_have_moved = begin.may_have_moved(inputs)
        moved = moved_given_physics(found.final, may_have_moved, extra=extra)
        if moved and result.beside_edges is not None:
            # what an inexact form leaves beside edges looks like a tilt: it must show away from them as well
            away = moved_given_physics(result.away_from_edges(), may_have_moved)
            seen = {(pose.placement, pose.surface) for pose in away}
            moved = [pose for pose in moved if (pose.placement, pose.surface) in seen]
        form_size = SHARE * found.final.conditional.relative_size(extra)
    setup = check_setup(
        conditional,
        explained=found.explained,
        physics=found.names,
        before=found.baseline.fit,
        moved=moved,
        form_size=form_size,
    )
    setups, winner = held_against(setups, problem, camera, found=best_fit.camera)
    reason = setup.reason if winner is None else winner.reason
    something = bool(result.found) or found.rest is not None
    if reason is None and inputs.against is None and not begin.sees_second_camera and something:
        elsewhere, setups = surface_elsewhere(result, best_fit, problem, camera, setups, inputs.say)
        reason = None if elsewhere is None else elsewhere.reason
    if reason is None and found.described is None:
        reason, setups = _beyond_stated(inputs, found, conditional, setups)
    elif setup.bad and moved:
        setups = by_gain([*setups, poses_elsewhere(total_gain(moved), len(setup.bad))])
    # effects that show in repeated frames and counts may look like another set-up
    variance = found.variance
    by_itself = variance.pixels_vary_together or variance.begins or found.codes is not None
    return JudgedSetup(setup, setups, winner, None if by_itself else reason)


def held_against(
    setups: list[Hypothesis], problem: Problem, camera: Camera, *, found: Camera
) -> tuple[list[Hypothesis], Hypothesis | None]:
    """Return the set-ups compared with the camera ``found``, and the one that explains more, if any."""
    if not any(hypothesis.is_better for hypothesis in setups):
        return setups, None
    setups = against_physics(setups, problem.dataset, problem.scene, camera, found=found)
    return setups, best_setup(setups)


def surface_elsewhere(
    result: Result,
    final: Fit,
    problem: Problem,
    camera: Camera,
    setups: list[Hypothesis],
    say: Callable[[str], None],
) -> tuple[Hypothesis | None, list[Hypothesis]]:
    """Return the displaced surface that is the cause, if any, and the set-ups including all such surfaces."""
    try:
        found = standing_elsewhere(result, final, problem, camera, say=say)
    except (RimError, np.linalg.LinAlgError):
        found = []  # too few pixels see the same tile by all poses that are compared
    if not found:
        return None, setups
    surfaces = {hypothesis.surface for hypothesis in found}
    rest = [
        hypothesis
        for hypothesis in setups
        if hypothesis.hypothesis != DEPTH or hypothesis.surface not in surfaces
    ]
    return found[0] if found[0].wins else None, [*found, *rest]


def _beyond_stated(
    inputs: Inputs, found: FoundPhysics, conditional: Fit, setups: list[Hypothesis]
) -> tuple[str | None, list[Hypothesis]]:
    """Return why nuisances are beyond their stated sizes (None: they are not), and the set-ups."""
    # reflectivities must be beyond both before any physics was fitted and after
    fits = (found.baseline.fit, found.final.fit)
    of_board = [reflectivities_beyond(fitted, inputs.scene) for fitted in fits]
    if all(of_board):
        return of_board[-1], setups
    of_surface = common_pose_beyond(conditional, inputs.camera) or flatness_beyond(conditional)
    if of_surface:
        return of_surface, setups
    astray = {key: error for key, error in errors_of_poses(conditional).items() if error > BEYOND}
    reason = poses_beyond(conditional, inputs.camera, astray)
    if reason is not None:
        costs = 0.5 * sum(error**2 for error in astray.values())
        setups = by_gain([*setups, poses_elsewhere(costs, len(astray))])
    return reason, setups
