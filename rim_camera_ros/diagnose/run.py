"""The diagnosis: from a recording and what is believed of it to all that a verdict rests on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.codes import missing_codes, note_on_grid
from rim_camera_ros.diagnose.compare_setups import against_physics, compare_setups
from rim_camera_ros.diagnose.depth import standing_elsewhere
from rim_camera_ros.diagnose.described import best_rest, describe, explained_share, is_unknown
from rim_camera_ros.diagnose.full_grid import on_full_grid
from rim_camera_ros.diagnose.hypotheses import (
    DEPTH,
    Files,
    Hypothesis,
    best_setup,
    by_gain,
    leaving_nothing,
    poses_elsewhere,
)
from rim_camera_ros.diagnose.inconsistent import (
    hopeless,
    of_another_setup,
    with_setups,
    without_search,
)
from rim_camera_ros.diagnose.noise_verdict import only_background, only_noise, only_rectified_noise
from rim_camera_ros.diagnose.nuisances import (
    common_pose_beyond,
    conditional_on_physics,
    disputed_effect,
    nuisances_of,
    optics_beyond,
    poses_beyond,
    reflectivities_beyond,
)
from rim_camera_ros.diagnose.pixel_gains import spread_of_gains
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.diagnose.setup import VERY_FEW, Setup, check_setup, errors_of_poses, few_of
from rim_camera_ros.diagnose.smooth import axes_of, gradient_terms, single_terms
from rim_camera_ros.diagnose.under_setup import left_by_chance
from rim_camera_ros.diagnose.variance import examine_variance, moving
from rim_camera_ros.diagnose.verdict import Findings, verdict_of
from rim_camera_ros.effects import OF_SURFACES, CovariateTable, without_poses
from rim_camera_ros.effects.base import response_of
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset, with_stated_errors
from rim_camera_ros.fit.decimation import (
    correlated_decimation,
    decimated_camera,
    decimated_dataset,
    decimation_of,
)
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.variance_components import likely_correlated_error
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.candidates import SHARE
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.moved_poses import NONE_MOVED, moved_beside_physics, total_gain
from rim_camera_ros.select.search import MOST_EFFECTS, search
from rim_camera_ros.select.trials import Workers

#: A term outside the vocabulary must gain this share more than the named ones to take their place.
_BEYOND_NAMED = 1.2
#: 1-sigma of light that all pixels share, as a share of the median amplitude, once it is known to be there.
_COMMON_LIGHT = 0.1
_ONE_POSE = (
    "only one pose: what depends on distance, amplitude or angle cannot be told from an offset of each "
    "pixel, so none of it is named, and nothing is held out; record 20 poses or more at different distances"
)
#: Poses below which what is named rests on little.
_FEW_POSES = 6
_OF_FEW_POSES = (
    "only {} poses: what is named or not, and what is left of held-out poses, rests on little; record 20 or "
    "more at different distances"
)
_SATURATED_ELSEWHERE = (
    "pixels are saturated: what that does to their rows and columns is looked for on sensors of up to "
    "60,000 pixels only"
)
_BESIDE_A_SECOND_CAMERA = "a second camera shines in: nothing else can be told; record with it switched off"


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
    """Compare a recording with what the camera and scene files say of it.

    ``against`` is a recording of the simulation, with the same stations, which is then compared with. Of a
    large sensor every k-th pixel is looked at. The result is the same with any number of ``threads``, and
    wherever ``workers`` fit candidates.

    Raises `InputError` where no pixel can be compared.
    """
    say = progress if progress is not None else _silent
    scene = with_stated_errors(scene, dataset)
    step = decimation_of(camera)
    if step == 1:
        return _diagnose(dataset, scene, camera, against, seed, threads, workers, say)
    small = decimated_camera(camera, step)
    result = _diagnose(
        decimated_dataset(dataset, step),
        scene,
        small,
        None if against is None else decimated_dataset(against, step),
        seed,
        threads,
        workers,
        say,
    )
    if any(station.saturated.any() for station in dataset.stations):
        result.notes.append(_SATURATED_ELSEWHERE)
    return on_full_grid(result, camera, step)


def _diagnose(
    dataset: Dataset,
    scene: Scene,
    camera: Camera,
    against: Dataset | None,
    seed: int,
    threads: int,
    workers: Workers,
    say: Callable[[str], None],
    spare: int | None = None,
    setups: list[Hypothesis] | None = None,
    correlated_error: float = 0.0,
) -> Diagnosis:
    moves = scene.camera_motion.moves
    facts = Facts.of(dataset, moves=moves, surfaces=len(scene.surfaces), camera=camera)
    shifts = None
    if against is not None:
        shifts = Forward(dataset, scene, camera).shifts_to(against)
    if setups is None:
        setups = [] if against is not None else compare_setups(dataset, scene, camera)

        def left(files: Files) -> float | None:
            say("as if the set-up were another")
            return left_by_chance(files, seed=seed, threads=threads)

        setups = leaving_nothing(setups, (dataset, scene, camera), left)
    tried = setups
    other = best_setup(setups)
    say("looking at the covariates")
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    variance = examine_variance(forward)
    if variance.moves and against is None:
        problem = Problem(dataset, scene, threads=threads)
        return with_setups(hopeless(problem, camera, variance, seed, reason=moving(variance)), setups)
    light = _COMMON_LIGHT * facts.amplitude if variance.pixels_vary_together else 0.0
    light = max(light, scene.stray_light)
    problem = Problem(
        dataset, scene, shifts=shifts, stray_light=light, correlated_error=correlated_error, threads=threads
    )
    if other is not None:
        return with_setups(of_another_setup(other, problem, camera, variance, seed), setups)
    samples = axes_of(forward, seed=seed)
    smooth = [*single_terms(samples), *gradient_terms(samples)]
    # the light of a second camera has a pattern and a phase of its own, which many effects can imitate
    alone = variance.pixels_vary_together
    one_pose = dataset.poses < 2
    most = 0 if alone or (one_pose and len(dataset.stations) < 2) else MOST_EFFECTS
    effects = without_poses() if one_pose else None
    if one_pose:
        dataset = replace(dataset, notes=[*dataset.notes, _ONE_POSE])
        smooth = []
    elif dataset.poses < _FEW_POSES:
        dataset = replace(dataset, notes=[*dataset.notes, _OF_FEW_POSES.format(dataset.poses)])
    # another simulation has the same poses, and the light of a second camera looks like anything
    may_have_moved = NONE_MOVED if alone or against is not None else few_of(dataset)
    try:
        result = search(
            problem,
            camera,
            facts,
            effects=effects,
            most=most,
            further=smooth,
            may_have_moved=may_have_moved,
            seed=seed,
            views=forward.views,
            workers=workers,
            progress=say,
        )
    except (RimError, np.linalg.LinAlgError):
        return with_setups(without_search(setups, problem, camera, variance, seed), setups)
    baseline, final = result.explorations[0], result.explorations[-1]
    # physics that is missing moves the optics too: they are held against the file beside what was found
    beyond_stated = None if result.moved else _other_lens(final.fit, camera)
    if beyond_stated is not None:
        assert camera.covariance is not None
        # a board that is another one moves the optics by hundreds of sigmas
        setups, winner = _against(setups, problem, camera, found=final.fit.camera)
        if winner is not None:
            result.forget()
            return with_setups(of_another_setup(winner, problem, camera, variance, seed), setups)
        if against is None and not alone:
            # so does a surface that stands elsewhere
            elsewhere, setups = _elsewhere(result, final.fit, problem, camera, setups, say)
            if elsewhere is not None:
                result.forget()
                return with_setups(of_another_setup(elsewhere, problem, camera, variance, seed), setups)
        result.forget()
        say("once more without the stated covariance of the optics")
        free = replace(camera, covariance=camera.covariance.without(["optics."]))
        noted = replace(dataset, notes=[*dataset.notes, beyond_stated])
        return _diagnose(
            noted, scene, free, against, seed, threads, workers, say, spare, setups, correlated_error
        )
    if alone:
        dataset = replace(dataset, notes=[*dataset.notes, _BESIDE_A_SECOND_CAMERA])
    say("looking for what no named effect explains")
    unknown = None if alone or one_pose or result.moved else best_rest(result, samples, seed)
    responds = response_of(final.fit.camera) is not None and response_of(camera) is None
    variance = examine_variance(final.fit.forward)
    if responds and variance.noise_is_wrong:
        scaled = examine_variance(final.fit.forward, free_scale=True)
        # a scale that does not explain all of it says nothing of the noise
        variance = variance if scaled.noise_is_wrong else scaled
    noise = camera.noise.floor / camera.sensor.lsb
    codes = missing_codes(dataset.codes, noise=noise)
    if codes is not None and codes.is_fine_grid(noise):
        dataset = replace(dataset, notes=[*dataset.notes, note_on_grid(codes, camera)])
        codes = None
    named = result.gained
    explained = explained_share(result, unknown)
    described = None
    # a curve of the light that is not refitted leaves a smooth rest by itself, smaller than what it explains
    linear = any(finding.effect in OF_SURFACES for finding in result.found)
    by_itself = linear and unknown is not None and unknown.on_top < named
    if unknown is not None and not by_itself and not only_noise(result, unknown, variance):
        beyond = not result.found or unknown.gain > _BEYOND_NAMED * result.found[0].gain
        if beyond and is_unknown(unknown, named, final, result):
            try:
                described = describe(unknown, baseline, result, seed)
            except (RimError, np.linalg.LinAlgError):
                return with_setups(hopeless(problem, camera, variance, seed), setups)
    best_fit = final.fit if described is None else described.fit
    conditional = conditional_on_physics(result) if described is None else best_fit
    moved, form_size = result.moved, SHARE
    if not moved and described is None:
        disputed = disputed_effect(result)
        extra = [] if disputed is None else final.spans[disputed]
        moved = moved_beside_physics(final, may_have_moved, extra=extra)
        form_size = SHARE * final.conditional.relative_size(extra)
    setup = check_setup(
        conditional,
        explained=explained,
        physics=[finding.effect for finding in result.found] if described is None else [CovariateTable.name],
        before=baseline.fit,
        moved=moved,
        form_size=form_size,
    )
    setups, winner = _against(setups, problem, camera, found=best_fit.camera)
    reason = setup.reason if winner is None else winner.reason
    if reason is None and against is None and not alone and (result.found or unknown is not None):
        elsewhere, setups = _elsewhere(result, best_fit, problem, camera, setups, say)
        reason = None if elsewhere is None else elsewhere.reason
    if reason is None and described is None:
        # what was so before any physics was fitted, and stays
        of_board = reflectivities_beyond(baseline.fit, scene) and reflectivities_beyond(final.fit, scene)
        astray = {key: error for key, error in errors_of_poses(conditional).items() if error > BEYOND}
        of_surface = common_pose_beyond(conditional, camera)
        reason = of_board or of_surface or poses_beyond(conditional, camera, astray)
        if reason is not None and not of_board and not of_surface:
            costs = 0.5 * sum(error**2 for error in astray.values())
            setups = by_gain([*setups, poses_elsewhere(costs, len(astray))])
    elif setup.bad and moved:
        setups = by_gain([*setups, poses_elsewhere(total_gain(moved), len(setup.bad))])
    reason = None if variance.pixels_vary_together or codes is not None else reason
    spare = max(1, int(VERY_FEW * dataset.poses)) if spare is None else spare
    if reason is not None and 0 < len(setup.bad) <= spare and against is None:
        say("once more without what does not agree")
        result.forget()
        kept = _without(problem.dataset, setup)
        fewer = spare - len(setup.bad)
        return _diagnose(
            kept, scene, camera, None, seed, threads, workers, say, fewer, correlated_error=correlated_error
        )
    # a function that is not part of the fit would itself be what neighbours share
    modelled = bool(result.found) if described is None else described.missing.modelled
    explains = modelled and not alone
    if (reason is not None or explains) and winner is None and against is None and not correlated_error:
        size = likely_correlated_error(problem, best_fit)
        if size is not None:
            # thousands of pixels that err alike speak for effects and functions, and move poses, by far more
            # than they know
            result.forget()
            say("once more with errors that neighbours share")
            coarse = correlated_decimation(camera)
            few, small = dataset, camera
            if coarse > 1:
                few, small = decimated_dataset(dataset, coarse), decimated_camera(camera, coarse)
            again = _diagnose(
                few, scene, small, None, seed, threads, workers, say, spare, tried, correlated_error=size
            )
            return again if coarse == 1 else on_full_grid(again, camera, coarse)
    if winner is not None and reason == winner.reason:
        # what was fitted to the files as given is no camera
        result.forget()
        return with_setups(of_another_setup(winner, problem, camera, variance, seed), setups)
    by_background = only_background(result, unknown, variance, camera)
    if by_background or only_rectified_noise(result, variance):
        described = None
        result = result.withdrawn()
    say("held-out poses before and after")
    gains = spread_of_gains(result.fit)
    findings = Findings(
        camera=camera,
        dataset=dataset,
        result=result,
        unknown=described,
        rest=unknown,
        variance=variance,
        codes=codes,
        reason=reason,
        shifted=by_background,
        left_over=setup.chi_square,
        gains=gains,
        seed=seed,
    )
    diagnosis = verdict_of(findings, say)
    if diagnosis.accuracy.hopeless:
        diagnosis = hopeless(problem, camera, variance, seed)
    return with_setups(replace(diagnosis, nuisances=nuisances_of(result.fit, camera, gains)), setups)


def _against(
    setups: list[Hypothesis], problem: Problem, camera: Camera, *, found: Camera
) -> tuple[list[Hypothesis], Hypothesis | None]:
    """Return the set-ups held against the camera ``found``, and the one that explains more, if any."""
    if not any(hypothesis.is_better for hypothesis in setups):
        return setups, None
    setups = against_physics(setups, problem.dataset, problem.scene, camera, found=found)
    return setups, best_setup(setups)


def _elsewhere(
    result: Result,
    final: Fit,
    problem: Problem,
    camera: Camera,
    setups: list[Hypothesis],
    say: Callable[[str], None],
) -> tuple[Hypothesis | None, list[Hypothesis]]:
    """Return the surface that stands elsewhere, if one does, and the set-ups with all that do."""
    try:
        found = standing_elsewhere(result, final, problem, camera, say=say)
    except (RimError, np.linalg.LinAlgError):
        found = []  # nothing can be fitted to what the poses that are compared see alike
    if not found:
        return None, setups
    surfaces = {hypothesis.surface for hypothesis in found}
    rest = [
        hypothesis
        for hypothesis in setups
        if hypothesis.hypothesis != DEPTH or hypothesis.surface not in surfaces
    ]
    return found[0], [*found, *rest]


def _other_lens(fitted: Fit, camera: Camera) -> str | None:
    """Return in words that the optics are none that the file's covariance allows; None: they may be."""
    return None if camera.covariance is None else optics_beyond(fitted)


def _without(dataset: Dataset, setup: Setup) -> Dataset:
    """Return the recording without its bad poses, which a note tells."""
    kept = dataset.without({*setup.bad})
    return replace(kept, notes=[*kept.notes, f"{setup.fault}; left out"])


def _silent(text: str) -> None:
    return None
