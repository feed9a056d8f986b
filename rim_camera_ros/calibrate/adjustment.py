"""The adjustment of a calibration: on a grid of pixels, until no assumption is contradicted by the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rim_camera_ros.calibrate.joint import Outcome, by_search, exactly
from rim_camera_ros.calibrate.large_sensor import LargeSensor
from rim_camera_ros.calibrate.recordings import Watch
from rim_camera_ros.calibrate.refinement import Refinement
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OPTICS
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.decimation import correlated_decimation, decimation_for, decimation_of
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixels import beside_in_view, usable_pixels
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.scene import Scene


@dataclass(frozen=True)
class Adjustment:
    """The ``outcome``, the ``problem`` with the assumptions that hold, and ``notes`` on those given up.

    ``large`` is set where parameters were fitted on a coarser grid. Pixels within ``edges_within`` [px] of
    edges were excluded.
    """

    outcome: Outcome
    problem: Problem
    notes: list[str]
    large: LargeSensor | None
    edges_within: int


def steps_of(camera: Camera, effects: Sequence[str] | None) -> tuple[int, int]:
    """Return the steps of the grids [px] for --effects: with independent errors, and with shared ones."""
    step = decimation_of(camera) if effects is None else decimation_for(camera, effects)
    return step, max(step, correlated_decimation(camera, effects))


def adjust(
    camera: Camera,
    dataset: Dataset,
    scene: Scene,
    words: Sequence[str] | None,
    *,
    steps: tuple[int, int],
    surfaces: int,
    geometry: bool,
    seed: int,
    threads: int,
    watch: Watch,
) -> Adjustment:
    """Fit effects to stations: those that ``words`` name, None: those that the recordings need.

    ``steps`` as `steps_of` returns them: where neighbours share their errors, a coarser grid contains as much
    information and takes less time and memory. ``surfaces`` is the greatest number of surfaces of a
    recording; ``geometry`` estimates the optics, too.

    Raises `InputError` where the recordings determine none of the effects that are named.
    """
    step, coarsest = steps
    correlated_error = 0.0
    while True:
        large = LargeSensor(camera, dataset, scene, step) if step > 1 else None
        small, stations = (camera, dataset) if large is None else large.coarse
        problem = Problem(
            stations,
            scene,
            geometry=tuple(OPTICS) if geometry else (),
            stray_light=scene.stray_light,
            correlated_error=correlated_error,
            tick=watch.tick,
            threads=threads,
        )
        found = _on_grid(
            problem,
            small,
            words,
            large=large,
            surfaces=surfaces,
            coarser=step < coarsest,
            seed=seed,
            watch=watch,
        )
        if isinstance(found, Adjustment):
            return found
        step, correlated_error = coarsest, found
        watch.say(f"again, with errors that neighbours share, on one of {step} x {step} pixels")


def _on_grid(
    problem: Problem,
    camera: Camera,
    words: Sequence[str] | None,
    *,
    large: LargeSensor | None,
    surfaces: int,
    coarser: bool,
    seed: int,
    watch: Watch,
) -> Adjustment | float:
    """Fit on one grid; return a size of errors that neighbours share [m] where they need a coarser grid."""
    dataset, scene = problem.dataset, problem.scene
    notes = [] if large is None else [large.note]
    facts = Facts.of(dataset, moves=scene.camera_motion.moves, surfaces=surfaces, camera=camera)
    forward = Forward(dataset, scene, camera)
    forward.tick = watch.tick
    forward.estimate_amplitudes()
    # the same pixels throughout, or a term could grow by losing those that contradict it
    masks, gross = usable_pixels(forward)
    if problem.geometry:
        problem = replace(problem, patches=forward.patches_seen())
    if gross:
        notes.append(f"excluded: {gross} distances that are far from any surface of the scene")
    beside = beside_in_view if large is None else large.beside_edges
    refinement = Refinement(problem, masks, beside=beside, coarser=coarser)
    problem = refinement.first(problem)
    begin: Camera | None = None
    is_first, part = True, None
    while True:
        views = forward.views
        if words is None:
            outcome = by_search(
                problem,
                camera,
                facts,
                views=views,
                say=watch.say,
                seed=seed,
                part_is_enough=is_first,
                begin=part,
                may_hold_foreign=refinement.may_hold_foreign,
            )
            if outcome.foreign is not None:
                # the search would add what explains them
                watch.say("again, with fewer values")
                problem = refinement.without(problem, outcome.foreign, outcome.solution.fit)
                continue
        else:
            outcome = exactly(problem, camera, facts, words, views=views, say=watch.say, begin=begin)
        is_first = False
        # a search is long: all assumptions that its result contradicts are given up before the next search
        settled = refinement.settled(problem, outcome.problem, outcome.solution.fit, say=watch.say)
        if settled is None:
            part = outcome.part
            if part is not None:
                continue
            notes += refinement.notes(problem, outcome.solution.fit)
            return Adjustment(outcome, problem, notes, large, refinement.edges_within)
        part = None
        if coarser and settled[0].correlated_error:
            return settled[0].correlated_error
        if settled[0].scene is not problem.scene:
            forward = Forward(dataset, settled[0].scene, camera)
        problem, begin = settled[0], settled[1].camera
