"""The beginning of a diagnosis: its inputs, the evidence of repeated frames and covariates, the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.added_light import light_candidate
from rim_camera_ros.diagnose.compare_setups import compare_setups
from rim_camera_ros.diagnose.hypotheses import Files, Hypothesis, leaving_nothing
from rim_camera_ros.diagnose.setup import few_of
from rim_camera_ros.diagnose.smooth import axes_of, gradient_terms, single_terms
from rim_camera_ros.diagnose.under_setup import left_by_chance
from rim_camera_ros.diagnose.variance import Variance, examine_variance
from rim_camera_ros.effects import without_poses
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.decimation import decimated_camera, decimated_dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.shifts import shifts_between
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.foreign_values import MOST_ROUNDS, ForeignValues
from rim_camera_ros.select.moved_poses import NONE_MOVED, MayHaveMoved
from rim_camera_ros.select.search import MOST_EFFECTS, search
from rim_camera_ros.select.trials import Workers, silent

Array = NDArray[Any]
#: 1-sigma of light that all pixels share, as a share of the median amplitude, once it was detected.
_COMMON_LIGHT = 0.1
_ONE_POSE = (
    "only one pose: effects that depend on distance, amplitude or angle cannot be distinguished from an "
    "offset of each pixel, so none is named, and nothing is held out; record 20 poses or more at different "
    "distances"
)
#: Poses below which names have little evidence.
_FEW_POSES = 6
_OF_FEW_POSES = (
    "only {} poses: there is little evidence for or against names, and for the residuals of held-out poses; "
    "record 20 or more at different distances"
)


@dataclass(frozen=True)
class Inputs:
    """The inputs of a diagnosis.

    ``against`` is a recording of the simulation. ``spare`` is how many poses may still be excluded (None: not
    decided), ``setups`` are those that were compared already, ``correlated_error`` [m] is the 1-sigma of
    errors that neighbours share, ``pixel_gains`` that of the gains of pixels (relative; None: as the camera
    file states). ``foreign`` are the values that were excluded as they do not see the scene,
    round by round.
    """

    dataset: Dataset
    scene: Scene
    camera: Camera
    against: Dataset | None = None
    seed: int = 0
    threads: int = 1
    workers: Workers = map
    say: Callable[[str], None] = silent
    spare: int | None = None
    setups: list[Hypothesis] | None = None
    correlated_error: float = 0.0
    pixel_gains: float | None = None
    foreign: tuple[ForeignValues, ...] = ()

    def decimated(self, step: int) -> Inputs:
        """Return the inputs with every ``step``-th pixel along rows and columns."""
        if step == 1:
            return self
        return replace(
            self,
            dataset=decimated_dataset(self.dataset, step),
            camera=decimated_camera(self.camera, step),
            against=None if self.against is None else decimated_dataset(self.against, step),
        )


@dataclass(frozen=True)
class Begun:
    """What is known before the search for physics.

    ``dataset`` has the notes, ``variance`` is the evidence of repeated frames, ``problem`` that of all fits.
    """

    dataset: Dataset
    facts: Facts
    variance: Variance
    problem: Problem
    forward: Forward
    seed: int

    @property
    def sees_second_camera(self) -> bool:
        """Whether there is light of a second camera: many effects can imitate its pattern and phase."""
        return self.variance.pixels_vary_together

    @cached_property
    def samples(self) -> dict[str, Array]:
        """Samples of the covariates, by name."""
        return axes_of(self.forward, seed=self.seed)

    @property
    def one_pose(self) -> bool:
        """Whether nothing can be held out."""
        return self.dataset.poses < 2

    def may_have_moved(self, inputs: Inputs) -> MayHaveMoved:
        """Return in how many poses surfaces may be displaced.

        In none where another simulation is compared, which has the same poses; with the light of a second
        camera, which can look like anything; or where first frames differ, which are in the means of poses.
        """
        return few_of(self.dataset) if self._poses_alone_differ(inputs) else NONE_MOVED

    def may_hold_foreign(self, inputs: Inputs) -> bool:
        """Return whether values that do not see the scene are looked for; as `may_have_moved`."""
        return len(inputs.foreign) < MOST_ROUNDS and self._poses_alone_differ(inputs)

    def _poses_alone_differ(self, inputs: Inputs) -> bool:
        return not (self.sees_second_camera or self.variance.begins or inputs.against is not None)


def setups_of(inputs: Inputs) -> list[Hypothesis]:
    """Return the set-ups that were compared, the best first."""
    if inputs.setups is not None:
        return inputs.setups
    files = (inputs.dataset, inputs.scene, inputs.camera)

    def left(files: Files) -> float | None:
        inputs.say("as if the set-up were another")
        return left_by_chance(files, seed=inputs.seed, threads=inputs.threads)

    return leaving_nothing([] if inputs.against is not None else compare_setups(*files), files, left)


def begun(inputs: Inputs) -> Begun:
    """Return the evidence of repeated frames and covariates, and the problem of all fits."""
    dataset, scene, camera = inputs.dataset, inputs.scene, inputs.camera
    facts = Facts.of(dataset, moves=scene.camera_motion.moves, surfaces=len(scene.surfaces), camera=camera)
    shifts = None
    if inputs.against is not None:
        shifts = shifts_between(dataset, inputs.against, scene, camera)
    inputs.say("looking at the covariates")
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    variance = examine_variance(forward)
    light = _COMMON_LIGHT * facts.amplitude if variance.pixels_vary_together else 0.0
    problem = Problem(
        dataset,
        scene,
        shifts=shifts,
        stray_light=max(light, scene.stray_light),
        correlated_error=inputs.correlated_error,
        pixel_gains=inputs.pixel_gains,
        threads=inputs.threads,
    )
    if dataset.poses < _FEW_POSES:
        note = _ONE_POSE if dataset.poses < 2 else _OF_FEW_POSES.format(dataset.poses)
        dataset = replace(dataset, notes=[*dataset.notes, note])
    return Begun(dataset, facts, variance, problem, forward, inputs.seed)


def searched(inputs: Inputs, begin: Begun) -> Result | None:
    """Return the result of a search for missing physics; None where nothing can be fitted."""
    smooth = [] if begin.one_pose else [*single_terms(begin.samples), *gradient_terms(begin.samples)]
    nothing = begin.sees_second_camera or (begin.one_pose and len(begin.dataset.stations) < 2)
    try:
        return search(
            begin.problem,
            inputs.camera,
            begin.facts,
            effects=without_poses() if begin.one_pose else None,
            most=0 if nothing else MOST_EFFECTS,
            further=smooth,
            image=None if nothing or not smooth else light_candidate(inputs.camera),
            may_have_moved=begin.may_have_moved(inputs),
            may_hold_foreign=begin.may_hold_foreign(inputs),
            seed=inputs.seed,
            views=begin.forward.views,
            workers=inputs.workers,
            progress=inputs.say,
        )
    except (RimError, np.linalg.LinAlgError):
        return None
