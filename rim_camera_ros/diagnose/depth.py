"""Surfaces that stand nearer or farther than their poses state, compared with physics by the same likelihood.

An error that all poses of a surface share moves its distances by an amount that depends on rays and normals
alone. Offsets of pixels absorb most of it, and a table of unknown physics the rest. So such an error is
scored like a candidate, conditional on the same nuisance parameters and by the same held-out poses, and
fitted then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import DEPTH, Hypothesis, by_gain, share_explained
from rim_camera_ros.diagnose.setup_trials import moved, normal_of, to_poses
from rim_camera_ros.effects.candidate import Block, Column, Regressor
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pose_columns import PoseColumn, by_shift
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.frame import Pose
from rim_camera_ros.select.compare import Result, paired_error
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.exploration import Exploration, explore, further_equations
from rim_camera_ros.select.subsample import dominated

Array = NDArray[Any]

#: 1-sigma of the prior of a depth [m]: as good as free.
_SIGMA = 0.5
#: Iterations of the fits that are compared.
_ITERATIONS = 8
_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class _Direction:
    """A direction in which a surface may be displaced: its ``normal`` in each pose, or the optical axis."""

    surface: str
    normal: bool

    @property
    def label(self) -> str:
        return f"depth.{self.surface}.{'normal' if self.normal else 'axis'}"

    def at(self, pose: Pose) -> Array:
        """Return the unit vector (3,) away from the camera at a pose."""
        return normal_of(pose) if self.normal else _AXIS

    def column(self, number: int, prediction: Prediction) -> Column:
        """Return the derivatives of the readings (H, W) by the depth of the surface ``number``."""
        view = prediction.view
        mine = view.geometry.surface == number
        if not mine.any():
            nothing = np.zeros(mine.shape)
            return nothing, nothing
        change = by_shift(
            self.at(view.poses[self.surface]), view.geometry, mine, prediction.context.camera.rays
        )
        return prediction.pose_change(PoseColumn(self.label, _SIGMA, *change))


def depths(baseline: Exploration, problem: Problem, folds: Mapping[tuple[int, int], int]) -> list[Hypothesis]:
    """Return for each surface with recorded poses the gain of its displacement over the files [nats].

    The gain is conditional on what is fitted in the ``baseline``, linear in the depth, and that of the better
    of two directions; the best surface is first.
    """
    choices = [
        (number, _Direction(surface.name, normal))
        for number, surface in enumerate(problem.scene.surfaces)
        if surface.pose == "truth"
        for normal in (True, False)
    ]
    if not choices:
        return []
    blocks = [
        Block(
            (Regressor(direction.label, "pose", _SIGMA),),
            lambda prediction, number=number, one=direction: [one.column(number, prediction)],  # type: ignore[misc]
        )
        for number, direction in choices
    ]
    fitted = further_equations(baseline.fit, blocks, folds, problem)
    count = len(fitted.parameters)
    scores = Scores(fitted.equations, range(count), held=fitted.at_bounds)
    without = scores.log_likelihoods() if scores.trained else []
    best: dict[str, Hypothesis] = {}
    for k, (_, direction) in enumerate(choices):
        own = [count + k]
        gain = float(scores.gain(own))
        error = paired_error(scores.log_likelihoods(own), without) if scores.trained else np.inf
        metres = scores.values(own)[direction.label]
        found = Hypothesis(
            DEPTH,
            direction.surface,
            gain,
            error,
            1e3 * metres,
            share_explained(gain, baseline.unexplained),
            to_poses(direction.surface, partial(_shifted, direction, metres)),
            against_physics=True,
        )
        if direction.surface not in best or gain > best[direction.surface].gain:
            best[direction.surface] = found
    return by_gain(best.values())


def standing_elsewhere(
    result: Result, final: Fit, problem: Problem, camera: Camera, *, say: Callable[[str], None]
) -> list[Hypothesis]:
    """Return displaced surfaces by the gain of that over the files with the physics found.

    Only displacements that are better than that physics in all folds of poses are returned. ``final`` is the
    fit with that physics; ``problem`` and ``camera`` are those as given. Surfaces whose linear gain is enough
    are moved in the recording, and the files as given are fitted to it. The pixels are those that see the
    same tile by all poses that are compared: the others depend on edges, not on depths. The depth is one
    number for all poses; its remainder within the stated errors is fitted without the held-out poses.
    """
    baseline = result.explorations[0]
    masks = baseline.fit.forward.pixels_used()
    # known terms begin at their fitted values; their priors stay about the values of the file
    alone = replace(problem, origin=camera, masks=masks, patches=baseline.fit.forward.patches_seen())
    leading = [depth for depth in depths(baseline, alone, result.folds) if depth.is_better]
    if not leading:
        return []
    say("surfaces that stand elsewhere")
    moved: list[Dataset] = []
    for hypothesis in leading:
        assert hypothesis.change is not None
        moved.append(hypothesis.change(problem.dataset, problem.scene, camera)[0])
        seen = Forward(moved[-1], problem.scene, camera).pixels_used()
        masks = [(a & c, b & d) for (a, b), (c, d) in zip(masks, seen, strict=True)]
    given = explore(
        replace(result.problem, masks=masks, patches=alone.patches),
        final.camera,
        [],
        result.folds,
        views=final.forward.views,
        warm=final,
        replicates=0,
        iterations=_ITERATIONS,
    )
    before, unexplained = given.scores.log_likelihoods(), given.unexplained
    found = []
    for hypothesis, dataset in zip(leading, moved, strict=True):
        there = replace(alone, dataset=dataset, masks=masks)
        fitted = explore(
            there,
            baseline.fit.camera,
            [],
            result.folds,
            warm=baseline.fit,
            replicates=0,
            iterations=_ITERATIONS,
        )
        after = fitted.scores.log_likelihoods()
        if "given" not in dominated({"given": before, "moved": after}):
            continue
        gain = sum(after) - sum(before)
        found.append(
            replace(
                hypothesis,
                gain=gain,
                standard_error=paired_error(after, before),
                share=share_explained(gain, unexplained),
            )
        )
    return by_gain(found)


def _shifted(direction: _Direction, metres: float, pose: Pose) -> Pose:
    return moved(pose, metres * direction.at(pose))
