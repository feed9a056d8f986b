"""Pixels beside edges, which a search excludes until it looks for effects that act there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import registry, vocabulary
from rim_camera_ros.effects.candidate import Candidate
from rim_camera_ros.fit.pixels import disagree, more_pixels
from rim_camera_ros.fit.problem import Fit, Problem, clean_by
from rim_camera_ros.fit.views import CROSSED
from rim_camera_ros.select.compare import Trial
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.thresholds import WITHOUT_REPLICATES

#: Share of its entry threshold that such an effect must gain before the other parameters are fitted.
_AT_FIRST_SIGHT = 0.5
_REPLICATES = 200
#: Side [px] up to which a footprint shows only in pixels that an edge crosses near their centre.
_NARROW = 0.4


class Fits(Protocol):
    """A function that fits a camera to pixels, from the nuisances of a step, and scores candidates."""

    def __call__(
        self,
        problem: Problem,
        camera: Camera,
        step: Exploration,
        wanted: Sequence[Candidate],
        /,
        *,
        replicates: int = ...,
        iterations: int = ...,
    ) -> Exploration: ...


@dataclass(frozen=True)
class Look:
    """A fit of pixels beside edges, the problem with them, and the variants to try there."""

    problem: Problem
    fitted: Exploration
    variants: Sequence[Candidate]


def edge_candidates(*, at_first_sight: bool = False) -> list[Candidate]:
    """Return the variants of all effects that show only in pixels which an edge crosses."""
    kinds = registry().values()
    return [candidate for kind in kinds for candidate in kind.edge_candidates(at_first_sight=at_first_sight)]


def where_clean(
    trial: Trial, before: Exploration, problem: Problem, folds: Mapping[tuple[int, int], int]
) -> tuple[Exploration, Exploration]:
    """Return the fits with and without a trial's effects, by the pixels that are clean by both cameras.

    Where the effects move no rays these are the pixels of the trial, and the fits are those given.
    """
    after = trial.fitted
    if not any(vocabulary()[name].moves_rays for name in trial.effects):
        return after, before
    # likelihoods of the same noise
    error = before.fit.forward.amplitude_model.tau
    fits = ((after, trial.problem), (before, problem))
    with_rays, without = (
        explore(
            replace(
                clean_by(after.fit.camera, own, after.fit.scene, views=after.fit.forward.views),
                amplitude_error=error,
            ),
            exploration.fit.camera,
            [],
            folds,
            views=exploration.fit.forward.views,
            warm=exploration.fit,
            replicates=0,
            iterations=0,
        )
        for exploration, own in fits
    )
    return with_rays, without


def with_edges(problem: Problem, fitted: Fit) -> Problem:
    """Return the problem with the pixels beside edges; the same problem where there are none."""
    masks = fitted.forward.pixels_near_edges()
    if problem.masks is not None and not more_pixels(masks, problem.masks):
        return problem
    return replace(problem, masks=masks)


def promising(
    problem: Problem,
    step: Exploration,
    blurs: Sequence[Candidate],
    fit: Fits,
    *,
    footprint: bool,
) -> Look | None:
    """Return a fit with pixels beside edges in which a variant exceeds its threshold; None: none does.

    With ``footprint`` the variants include the footprint of a pixel. A narrow one is tested by the pixels
    that edges cross near their centre, where errors of poses matter most. ``step`` is the last exploration
    without pixels beside edges.
    """
    camera = step.fit.camera
    variants = [*blurs, *(edge_candidates(at_first_sight=True) if footprint else [])]
    first = fit(problem, camera, step, variants, iterations=0)
    leader = _leader(first, _AT_FIRST_SIGHT)
    first.forget()
    if leader is None:
        return None
    side = leader.footprint
    if side is not None and side <= _NARROW:
        problem = replace(problem, masks=step.fit.forward.pixels_near_edges(CROSSED))
    variants = [*blurs, *(edge_candidates() if footprint else [])]
    then = fit(problem, camera, step, variants, replicates=_REPLICATES)
    return None if _leader(then, 1.0) is None else Look(problem, then, variants)


def refined(step: Exploration, names: Sequence[str], problem: Problem, fit: Fits) -> Exploration:
    """Return a step's fit with some effects in their finest forms; the step where these gain nothing."""
    camera = step.fit.camera
    finest = {name: camera.effects[name].finest() for name in names if name in camera.effects}
    finest = {name: effect for name, effect in finest.items() if effect != camera.effects[name]}
    if not finest:
        return step
    alike = replace(problem, amplitude_error=step.fit.forward.amplitude_model.tau)
    finer = fit(alike, with_effects(camera, {**camera.effects, **finest}), step, ())
    gain = finer.scores.log_likelihood() - step.scores.log_likelihood()
    return finer if gain > WITHOUT_REPLICATES else step


def sharper(problem: Problem, step: Exploration, fit: Fits) -> tuple[Exploration, Exploration] | None:
    """Return two fits with pixels beside edges: by the blur of a step's camera, and by a footprint instead.

    None where the footprint fits no better, or so badly that neither describes what edges show: the result
    without pixels beside edges then stands.
    """
    camera = step.fit.camera
    without = with_effects(camera, {n: effect for n, effect in camera.effects.items() if not effect.at_edges})
    first = fit(problem, without, step, edge_candidates(), iterations=0)
    number = next(iter(first.best().values()))
    if first.gains[number] <= WITHOUT_REPLICATES:
        return None
    footprint = fit(problem, first.camera_with([number]), step, ())
    if disagree(_chi_square(footprint), _chi_square(step)):
        return None
    blur = fit(problem, camera, step, ())
    gain = footprint.scores.log_likelihood() - blur.scores.log_likelihood()
    return (blur, footprint) if gain > WITHOUT_REPLICATES else None


def _chi_square(step: Exploration) -> float:
    """Return chi-square per value of held-out poses."""
    chi_square, rows = step.scores.chi_square(held_out=True)
    return chi_square / max(rows, 1)


def _leader(step: Exploration, share: float) -> Candidate | None:
    """Return the best variant where it gains a share of its threshold."""
    number = next(iter(step.best().values()))
    return step.candidates[number] if step.gains[number] > share * step.thresholds[number] else None
