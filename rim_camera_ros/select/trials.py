"""Trials of a search: fits of candidates that need nothing of one another, here or on workers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import vocabulary
from rim_camera_ros.fit.data import level_of
from rim_camera_ros.fit.problem import Point, Problem
from rim_camera_ros.fit.views import Views
from rim_camera_ros.select.exploration import Exploration, explore

#: Iterations of fits that add an effect, and shares of the sigmas at which they end.
ITERATIONS = 12
TOLERANCE = 0.15

#: What calls a function for each of some things, and yields the results in their order: ``map``, or workers.
Workers = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]


@dataclass(frozen=True)
class TrialFit:
    """A fit of ``effects`` to a ``problem`` from a camera ``start`` and the ``point`` of a fit without them.

    ``near`` as in `adjustment.fit`; ``views`` are those of that fit, None where they are elsewhere.
    """

    effects: tuple[str, ...]
    problem: Problem
    start: Camera
    point: Point
    folds: Mapping[tuple[int, int], int]
    seed: int
    near: bool = False
    views: Views | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"views": None}

    @property
    def response(self) -> Problem:
        """The problem with the rest of the amplitudes' response free, where that is tried."""
        if not any(vocabulary()[name].is_response for name in self.effects):
            return self.problem
        return replace(self.problem, response=level_of(self.problem.dataset))


def fit_trial(trial: TrialFit) -> Exploration:
    """Fit a trial; a pure function that may run anywhere."""
    fitted = explore(
        trial.problem,
        trial.start,
        [],
        trial.folds,
        views=trial.views,
        warm=trial.point,
        seed=trial.seed,
        replicates=0,
        iterations=ITERATIONS,
        tolerance=TOLERANCE,
        near=trial.near,
    )
    if trial.response is not trial.problem:
        # its one parameter first: together with a free response it would not find the way
        camera, views = fitted.fit.camera, fitted.fit.forward.views
        fitted = explore(trial.response, camera, [], trial.folds, views=views, warm=fitted.fit, replicates=0)
    return fitted
