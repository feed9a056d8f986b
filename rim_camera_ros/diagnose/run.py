"""The diagnosis: from a recording with its camera and scene files to a verdict and its evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.begin import Begun, Inputs, begun, searched, setups_of
from rim_camera_ros.diagnose.found_physics import FoundPhysics, physics_of
from rim_camera_ros.diagnose.full_grid import on_full_grid
from rim_camera_ros.diagnose.hypotheses import Hypothesis, best_setup
from rim_camera_ros.diagnose.inconsistent import (
    hopeless,
    of_another_setup,
    with_setups,
    without_search,
)
from rim_camera_ros.diagnose.judged_setup import (
    JudgedSetup,
    held_against,
    judged_setup,
    surface_elsewhere,
)
from rim_camera_ros.diagnose.noise_verdict import only_background, only_rectified_noise
from rim_camera_ros.diagnose.nuisances import nuisances_of, optics_beyond
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.diagnose.setup import VERY_FEW
from rim_camera_ros.diagnose.variance import moving
from rim_camera_ros.diagnose.verdict import Findings, verdict_of
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset, with_stated_errors
from rim_camera_ros.fit.decimation import correlated_decimation, decimation_of
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.variance_components import likely_correlated_error
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.at_rest import at_rest, note_on_smoothing
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.foreign_values import ForeignValues, exclusion_notes, foreign_values
from rim_camera_ros.select.pixel_gains import UNKNOWN_GAINS, GainSpread, spread_of_gains
from rim_camera_ros.select.trials import Workers, silent

_SATURATED_ELSEWHERE = (
    "pixels are saturated: what that does to their rows and columns is looked for on sensors of up to "
    "60,000 pixels only"
)


def diagnose(
    dataset: Dataset,
    scene: Scene,
    camera: Camera,
    *,
    against: Dataset | None = None,
    seed: int = 0,
    threads: int = 1,
    workers: Workers = map,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Compare a recording with its simulation by the camera and scene files.

    ``against`` is a recording of the simulation, with the same stations, to compare with instead. Of a large
    sensor every k-th pixel is used. The result is the same with any number of ``threads``, and wherever
    ``workers`` fit candidates.

    Raises `InputError` where no pixel can be compared.
    """
    say = progress if progress is not None else silent
    if against is None:
        dataset = at_rest(dataset)
    smoothed = note_on_smoothing(dataset)
    if smoothed is not None:
        dataset = replace(dataset, notes=[*dataset.notes, smoothed])
    scene = with_stated_errors(scene, dataset)
    step = decimation_of(camera)
    saturates = any(station.saturated.any() for station in dataset.stations)
    inputs = Inputs(dataset, scene, camera, against, seed, threads, workers, say).decimated(step)
    # the images of a large sensor, if the caller keeps none either
    del dataset, against
    result = _diagnosed(inputs)
    if step == 1:
        return result
    if saturates:
        result.notes.append(_SATURATED_ELSEWHERE)
    return on_full_grid(result, camera, step)


def _diagnosed(inputs: Inputs) -> Diagnosis:
    """Compare set-ups, search for physics, judge the set-up given that physics, and state the verdict."""
    camera, seed = inputs.camera, inputs.seed
    setups = tried = setups_of(inputs)
    begin = begun(inputs)
    problem, variance = begin.problem, begin.variance
    if variance.moves and inputs.against is None:
        plain = Problem(inputs.dataset, inputs.scene, threads=inputs.threads)
        return with_setups(hopeless(plain, camera, variance, seed, reason=moving(variance)), setups)
    other = best_setup(setups)
    if other is not None:
        return with_setups(of_another_setup(other, problem, camera, variance, seed), setups)
    result = searched(inputs, begin)
    if result is None:
        return with_setups(without_search(setups, problem, camera, variance, seed), setups)
    if result.foreign is not None:
        result.forget()
        return _without_foreign(inputs, result.foreign, problem.dataset, setups)
    found = _physics_or_none(inputs, begin, result) if result.by_image else None
    # missing physics moves the optics, too: they are compared with the file given the physics found
    beyond = None
    if not result.moved and camera.covariance is not None:
        beyond = optics_beyond(result.explorations[-1].fit if found is None else found.best_fit)
    if beyond is not None:
        return _without_stated_optics(inputs, begin, result, setups, beyond)
    found = _physics_or_none(inputs, begin, result) if found is None else found
    if found is None:
        return with_setups(hopeless(problem, camera, variance, seed), setups)
    judged = judged_setup(inputs, begin, found, setups)
    again = _once_more(inputs, begin, found, judged, tried)
    if again is not None:
        return again
    if judged.winner is not None and judged.reason == judged.winner.reason:
        # the fit with the files as given describes no camera
        result.forget()
        other = judged.winner
        return with_setups(of_another_setup(other, problem, camera, found.variance, seed), judged.setups)
    return _said(inputs, begin, found, judged)


def _physics_or_none(inputs: Inputs, begin: Begun, result: Result) -> FoundPhysics | None:
    """Return the physics found; None where unknown physics cannot be described."""
    try:
        return physics_of(inputs, begin, result)
    except (RimError, np.linalg.LinAlgError):
        return None


def _without_stated_optics(
    inputs: Inputs, begin: Begun, result: Result, setups: list[Hypothesis], beyond: str
) -> Diagnosis:
    """Return the diagnosis of another set-up, or with free optics: they are ``beyond`` their covariance."""
    camera, problem = inputs.camera, begin.problem
    assert camera.covariance is not None
    fitted = result.explorations[-1].fit
    # another board than the stated one moves the optics by hundreds of sigmas
    setups, other = held_against(setups, problem, camera, found=fitted.camera)
    if other is None and inputs.against is None and not begin.sees_second_camera:
        # so does a displaced surface, if it explains most; otherwise free optics may reveal physics
        surface, further = surface_elsewhere(result, fitted, problem, camera, setups, inputs.say)
        if surface is not None and surface.wins:
            other, setups = surface, further
    result.forget()
    if other is not None:
        return with_setups(of_another_setup(other, problem, camera, begin.variance, inputs.seed), setups)
    inputs.say("once more without the stated covariance of the optics")
    free = replace(camera, covariance=camera.covariance.without(["optics."]))
    noted = replace(begin.dataset, notes=[*begin.dataset.notes, beyond])
    return _diagnosed(replace(inputs, dataset=noted, camera=free, setups=setups))


def _once_more(
    inputs: Inputs, begin: Begun, found: FoundPhysics, judged: JudgedSetup, tried: list[Hypothesis]
) -> Diagnosis | None:
    """Return the diagnosis without what does not agree, with errors or with gains that neighbours share.

    None where neither is needed.
    """
    if inputs.against is not None:
        return None
    dataset, bad = found.dataset, len(judged.setup.bad)
    spare = max(1, int(VERY_FEW * dataset.poses)) if inputs.spare is None else inputs.spare
    if judged.reason is not None and 0 < bad <= spare:
        inputs.say("once more without what does not agree")
        found.result.forget()
        kept = judged.without_bad_poses(begin.problem.dataset)
        return _diagnosed(replace(inputs, dataset=kept, setups=None, spare=spare - bad))
    if judged.reason is None and begin.may_hold_foreign(inputs):
        # given the physics that was found, others are seen; beside edges, what its inexact form leaves
        foreign = foreign_values(found.result.without_edges(found.best_fit))
        if foreign is not None:
            found.result.forget()
            return _without_foreign(inputs, foreign, begin.problem.dataset, tried)
    explains = found.is_modelled and not begin.sees_second_camera
    if not inputs.correlated_error and judged.winner is None and (judged.reason is not None or explains):
        size = likely_correlated_error(begin.problem, found.best_fit)
        if size is not None:
            found.result.forget()
            shared = replace(inputs, dataset=dataset, spare=spare, setups=tried, correlated_error=size)
            return _with_correlated_error(shared)
    may_share = bool(found.result.found) and not begin.sees_second_camera
    gains = spread_of_gains(found.result.fit) if may_share else None
    if gains is None or not gains.are_unknown:
        return None
    found.result.forget()
    return _with_free_gains(inputs, gains, begin.problem.dataset, tried)


def _with_correlated_error(inputs: Inputs) -> Diagnosis:
    """Return the diagnosis with errors that neighbours share, on a coarser grid.

    Thousands of pixels with correlated errors, taken as independent, would be evidence for effects and
    functions, and would move poses, by far more than they determine.
    """
    inputs.say("once more with errors that neighbours share")
    coarse = correlated_decimation(inputs.camera)
    again = _diagnosed(inputs.decimated(coarse))
    return again if coarse == 1 else on_full_grid(again, inputs.camera, coarse)


def _without_foreign(
    inputs: Inputs, foreign: ForeignValues, dataset: Dataset, setups: list[Hypothesis]
) -> Diagnosis:
    """Return the diagnosis without values that do not see the scene."""
    inputs.say("once more without values that do not see the scene")
    every = (*inputs.foreign, foreign)
    before = exclusion_notes(inputs.foreign)
    notes = [*(note for note in dataset.notes if note not in before), *exclusion_notes(every)]
    kept = replace(foreign.excluded_from(dataset), notes=notes)
    return _diagnosed(replace(inputs, dataset=kept, setups=setups, foreign=every))


def _with_free_gains(
    inputs: Inputs, gains: GainSpread, dataset: Dataset, setups: list[Hypothesis]
) -> Diagnosis:
    """Return the diagnosis with gains of pixels that are not assumed to be small."""
    inputs.say("once more with unknown gains of pixels")
    noted = replace(dataset, notes=[*dataset.notes, gains.note_of_shared()])
    return _diagnosed(replace(inputs, dataset=noted, setups=setups, pixel_gains=UNKNOWN_GAINS))


def _said(inputs: Inputs, begin: Begun, found: FoundPhysics, judged: JudgedSetup) -> Diagnosis:
    """Return the verdict on the physics and the set-up."""
    camera, result, described = inputs.camera, found.result, found.described
    by_background = only_background(result, found.rest, found.variance, camera)
    if by_background or only_rectified_noise(result, found.variance):
        described, result = None, result.withdrawn()
    inputs.say("held-out poses before and after")
    gains = spread_of_gains(result.fit)
    findings = Findings(
        camera=camera,
        dataset=found.dataset,
        result=result,
        described=described,
        rest=found.rest,
        variance=found.variance,
        codes=found.codes,
        reason=judged.reason,
        shifted=by_background,
        left_over=judged.setup.chi_square,
        gains=gains,
        seed=inputs.seed,
    )
    diagnosis = verdict_of(findings, inputs.say)
    if diagnosis.accuracy.hopeless:
        diagnosis = hopeless(begin.problem, camera, found.variance, inputs.seed)
    diagnosis = replace(diagnosis, nuisances=nuisances_of(result.fit, camera, gains))
    return with_setups(diagnosis, judged.setups)
