"""Forward search: which effects the recordings require in addition to those of the camera file.

The leading candidates of an exploration are fitted non-linearly in the full forward chain, and the best
enters the camera; then all candidates are explored again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import response_of
from rim_camera_ros.effects.candidate import Candidate, Facts
from rim_camera_ros.fit.data import level_of
from rim_camera_ros.fit.problem import FreeResponse, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.views import Views
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.compare import (
    Result,
    image_says_more,
    leading_variants,
    refused,
    smooth_says_more,
)
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.foreign_values import foreign_values
from rim_camera_ros.select.forward_search import Search
from rim_camera_ros.select.moved_poses import MayHaveMoved, MovedPose, moved_before_physics
from rim_camera_ros.select.trials import Workers, silent

MOST_EFFECTS = 4


def search(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    *,
    effects: Sequence[str] | None = None,
    seed: int = 0,
    most: int = MOST_EFFECTS,
    further: Sequence[Candidate] = (),
    image: Candidate | None = None,
    begin: Result | None = None,
    may_have_moved: MayHaveMoved | None = None,
    may_hold_foreign: bool = False,
    views: Views | None = None,
    workers: Workers = map,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Add effects to a camera one after the other as long as they improve the prediction of held-out poses.

    ``effects`` restricts the candidates. ``further`` candidates (smooth terms) are scored with the others but
    are never named; where one of them, or the ``image``, a term with many values over the array, explains far
    more than any effects, no effect enters. ``begin`` is the result of a search of fewer stations, from which
    this one goes on: its effects count among the ``most`` that may enter, and are tested again. ``views`` are
    those of the same scene by the same rays, if there are any. Where displaced surfaces in a few poses,
    within ``may_have_moved``, explain more than any effect, no effect enters either; nor does one where there
    are values that do not see the scene, which are looked for if it ``may_hold_foreign`` ones. ``workers``
    fit candidates, as `cluster.on_workers` does.
    """
    say = progress if progress is not None else silent
    folds = folds_of(problem.dataset)
    problem = replace(problem, origin=problem.origin or camera)
    start_camera, ahead = camera, [] if begin is None else begin.found
    if begin is not None:
        start_camera = begin.camera
        problem = replace(problem, geometry=begin.problem.geometry, reflectance=begin.problem.reflectance)
    if response_of(start_camera) is not None and problem.gain:
        problem = replace(problem, response=FreeResponse(level_of(problem.dataset)))
    present = {finding.effect for finding in ahead}
    pool = [
        candidate
        for candidate in candidates(camera, facts, effects=effects)
        if candidate.effect not in present
    ]
    say(f"baseline and {len(pool)} candidates")

    def begun(problem: Problem, *, again: bool) -> Search:
        # first the poses that the search before did not have, then what its poses could not determine
        settled = None if begin is None else fit(problem, start_camera, views=views, near=True)
        first = explore(
            problem,
            start_camera if settled is None else settled.camera,
            pool,
            folds,
            further=further,
            views=views if settled is None else settled.forward.views,
            warm=settled,
            seed=seed,
            near=begin is not None,
        )
        return Search(
            problem=replace(
                problem,
                masks=first.fit.forward.pixels_used(),
                patches=first.fit.forward.patches_seen(),
            ),
            camera=camera,
            explorations=[first],
            found=[replace(finding, step=0) for finding in ahead],
            folds=folds,
            further=further,
            pool=pool,
            variants=leading_variants(first),
            seed=seed,
            say=say,
            # masks that the caller chose may exclude pixels beside edges for good
            may_look=may_look,
            may_narrow=may_look and not again,
            workers=workers,
        )

    may_look = problem.masks is None
    state = begun(problem, again=False)
    foreign = foreign_values(state.step.fit) if may_hold_foreign else None
    moved: list[MovedPose] = []
    if foreign is None and may_have_moved is not None:
        moved = moved_before_physics(state.step, may_have_moved)
    # furniture before a wall looks like light that does not move: objects are excluded before
    seen = foreign is None and not moved
    by_image = seen and image_says_more(state.step, image, state.problem, folds)
    if not seen or by_image or smooth_says_more(state.step):
        most = 0
    state.add(most)
    if state.narrowed is not None:
        say("once more without pixels that edges reach by either camera")
        state.step.forget()
        state = begun(replace(problem, masks=state.narrowed.masks), again=True)
        state.add(most)
    start = state.explorations[0].scores.log_likelihood()
    if len(state.found) > max(1, len(ahead)) or state.at_bounds:
        say("whether each is still needed")
        state.drop_needless()
        if not state.found and most > len(ahead):
            # no search was made yet without the effect that ended at a bound; the pixels are decided by now
            state.may_narrow = False
            state.add(most)
    not_added = refused(state.step, state.failed)
    if len(state.found) < most:
        state.look_beside_edges()
    names = {finding.effect for finding in state.found}
    return Result(
        camera=state.step.fit.camera,
        found=state.found,
        explorations=state.explorations,
        log_likelihood=state.step.scores.log_likelihood(),
        start_log_likelihood=start,
        problem=state.problem,
        folds=folds,
        refused=[finding for finding in not_added if finding.effect not in names],
        beside_edges=state.beside_edges,
        moved=moved,
        foreign=foreign,
        by_image=by_image,
    )
