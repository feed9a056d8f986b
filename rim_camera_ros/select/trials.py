"""Trials of a search: independent fits of candidates, in this process or on workers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import in_order, with_effects
from rim_camera_ros.effects import OF_SURFACES, OPTICS, vocabulary
from rim_camera_ros.effects.light_curves import RESPONSE
from rim_camera_ros.effects.sections import REFLECTANCE_PRIOR
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.amplitudes import AMPLITUDE_MODEL
from rim_camera_ros.fit.data import level_of
from rim_camera_ros.fit.pixels import LEAST_LEFT
from rim_camera_ros.fit.problem import FreeResponse, Point, Problem, forward_of
from rim_camera_ros.fit.views import WIDE, Views
from rim_camera_ros.select.compare import Trial
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.subsample import at_stations

#: Sizes of a free curve in addition to the one parameter of a response (relative amplitude, 1-sigma): the
#: largest is that of an unknown curve, the least is below the accuracy of predicted amplitudes.
RESPONSE_SIZES = tuple(np.geomspace(REFLECTANCE_PRIOR, AMPLITUDE_MODEL / 10, 6).tolist())
#: Iterations of fits that add an effect, and the share of the sigmas at which they end.
ITERATIONS = 12
TOLERANCE = 0.15


def silent(text: str) -> None:
    """Say nothing."""
    return


#: A function that maps a function over items and yields the results in their order: ``map``, or workers.
Workers = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]


@dataclass(frozen=True)
class TrialFit:
    """A fit of ``effects`` to a ``problem`` from a camera ``start`` and the ``point`` of a fit without them.

    ``near`` as in `solver.fit`. ``views`` are those of the fit without them; they are not pickled, and None
    on workers. Fits ``away_from_edges`` begin with the pixels that stay clean however their rays move.
    """

    effects: tuple[str, ...]
    problem: Problem
    start: Camera
    point: Point
    folds: Mapping[tuple[int, int], int]
    seed: int
    near: bool = False
    views: Views | None = None
    away_from_edges: bool = False

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"views": None}


def fit_trial(trial: TrialFit) -> Exploration:
    """Fit a trial; a pure function that may run in any process.

    Where rays move, edges move to other pixels, and pixels that an edge reaches hold the rays at their start.
    So a first fit is to pixels that no edge comes near; the fit to all begins where it ended.
    """
    # likelihoods are compared with that of the step: they require the same noise
    error = trial.point.amplitude_model.tau

    def fitted_to(problem: Problem, camera: Camera, views: Views | None, point: Point) -> Exploration:
        return explore(
            replace(problem, amplitude_error=error),
            camera,
            [],
            trial.folds,
            views=views,
            warm=point,
            seed=trial.seed,
            replicates=0,
            iterations=ITERATIONS,
            tolerance=TOLERANCE,
            near=trial.near,
        )

    problem, start, views, point = trial.problem, trial.start, trial.views, trial.point
    responds = any(vocabulary()[name].is_response for name in trial.effects)
    if responds:
        # its one parameter first: jointly with a free response the fit would not converge
        least = FreeResponse(level_of(problem.dataset), RESPONSE_SIZES[-1])
        problem = replace(problem, response=least)
    far = _far_from_edges(trial) if trial.away_from_edges else None
    if far is not None:
        first = fitted_to(far, start, views, point).fit
        start, views, point = first.camera, first.forward.views, first.point
    fitted = fitted_to(problem, start, views, point)
    if responds:
        freer = replace(problem, response=_free_response(fitted, least.level), amplitude_error=error)
        camera, views = fitted.fit.camera, fitted.fit.forward.views
        fitted = explore(freer, camera, [], trial.folds, views=views, warm=fitted.fit, replicates=0)
    return fitted


def _free_response(fitted: Exploration, level: float) -> FreeResponse:
    """Return the free curve about a ``level`` [counts], in addition to the parameter of a response.

    Its size is that by which held-out poses are predicted best, from a fit of the response's parameter with
    next to no curve.
    """
    scores, sigma = fitted.scores, fitted.fit.sigma
    curve = np.array([regressor.label in RESPONSE for regressor in scores.regressors], bool)
    held_out = [
        float(scores.with_priors(np.where(curve, size, scores.prior)).held_out()) for size in RESPONSE_SIZES
    ]
    parameter = {
        path: (value, sigma[path])
        for path, value in fitted.fit.parameters.items()
        if path.startswith("effects.") and vocabulary()[path.split(".")[1]].is_response
    }
    return FreeResponse(level, RESPONSE_SIZES[int(np.argmax(held_out))], parameter)


def _far_from_edges(trial: TrialFit) -> Problem | None:
    """Return a trial's problem with the pixels that no edge comes near; None where too few remain."""
    problem = trial.problem
    forward = forward_of(problem, problem.scene, trial.start, views=trial.views, offsets={})
    now = forward.pixels_used()
    wide = forward.pixels_near_edges(WIDE)
    masks = [(a & c, b & d) for (a, b), (c, d) in zip(now, wide, strict=True)]
    left, before = (sum(int(used.sum()) for used, _ in each) for each in (masks, now))
    return replace(problem, masks=masks) if left >= LEAST_LEFT * before else None


def fitted_trials(
    trials: Sequence[TrialFit], workers: Workers, say: Callable[[str], None], *, to: str = "all poses"
) -> Iterator[Exploration]:
    """Yield the fits of trials in their order; report how many are done and how long the rest takes."""
    begun, done, count = monotonic(), 0, len(trials)

    def report(words: str) -> None:
        seconds = f", about {(monotonic() - begun) / done * (count - done):.0f} s left" if done else ""
        say(f"fitting{words} to {to} ({done} of {count} fits done{seconds})")

    def reported() -> Iterator[TrialFit]:
        for trial in trials:
            report(" " + " and ".join(trial.effects) if trial.effects else "")
            yield trial

    for trial, fitted in zip(trials, workers(fit_trial, reported()), strict=True):
        # the result of a worker has a copy of the data
        fitted.fit.forward.dataset, fitted.fit.forward.masks = trial.problem.dataset, trial.problem.masks
        done += 1
        report("")
        yield fitted


def trial_fit(
    problem: Problem,
    step: Exploration,
    choice: tuple[int, ...],
    folds: Mapping[tuple[int, int], int],
    seed: int,
    few: Sequence[int] | None = None,
    start: Camera | None = None,
    *,
    with_edges: bool = False,
) -> TrialFit:
    """Return the fit of some candidates jointly with the effects of a ``step``, to stations ``few`` if given.

    It begins at the linear guess, or at the camera ``start``, which is nearer to the solution. With
    ``with_edges`` pixels beside edges take part.
    """
    names = tuple(step.candidates[k].effect for k in choice)
    geometry = tuple(dict.fromkeys([*problem.geometry, *(n for n in names if n in OPTICS)]))
    reflectance = problem.reflectance or not OF_SURFACES.isdisjoint(names)
    problem = replace(problem, geometry=geometry, reflectance=reflectance)
    if few is not None:
        problem = at_stations(problem, few)
    near, views = start is not None, step.fit.forward.views
    if start is None:
        # rays begin where they are: a linear guess of them may put a texture's edges on other pixels
        start = step.camera_with([k for k in choice if step.candidates[k].effect not in OPTICS])
    moves = any(vocabulary()[name].moves_rays for name in names)
    return TrialFit(
        names,
        problem,
        start,
        step.fit.point,
        folds,
        seed,
        near=near,
        views=views,
        away_from_edges=moves and not with_edges,
    )


def without_effect(
    name: str, problem: Problem, camera: Camera, origin: Camera
) -> tuple[Problem, Camera] | None:
    """Return problem and camera without an effect that was found; None where the camera does not have it.

    Optics become those of the camera ``origin``; None also where the other effects are invalid with these.
    """
    if name in problem.geometry:
        left = tuple(kept for kept in problem.geometry if kept != name)
        try:
            return replace(problem, geometry=left), in_order(OPTICS[name].of_another(camera, origin))
        except InputError:
            return None
    if name not in camera.effects:
        return None
    return problem, with_effects(
        camera, {key: effect for key, effect in camera.effects.items() if key != name}
    )


def onwards(trial: Trial, folds: Mapping[tuple[int, int], int], seed: int) -> TrialFit:
    """Return the fit that goes on from where a trial ended."""
    fitted = trial.fitted.fit
    views = fitted.forward.views
    return TrialFit((), trial.problem, fitted.camera, fitted.point, folds, seed, near=True, views=views)
