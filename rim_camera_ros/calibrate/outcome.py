"""What a search tries, and what it comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rim_camera_ros.calibrate.exploration import Exploration
from rim_camera_ros.calibrate.leaders import Refused
from rim_camera_ros.calibrate.needs import Found
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.camera import Camera

#: Share of what the best of several fits gains from which another is as good: no form is quite the true one.
_AS_GOOD = 0.9


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted, the problem with what they free, the fit, and its log likelihood.

    A pair's is less by what a further effect must gain.
    """

    effects: list[str]
    problem: Problem
    fitted: Exploration
    likelihood: float


def as_good(alone: Mapping[str, float], best: Trial, before: float) -> list[str]:
    """Return the effects that explain nearly what the best trial does, where that is of one effect.

    ``alone`` are log likelihoods with each effect fitted alone, ``before`` that with none. Which of them it
    is hangs on how true their forms are.
    """
    if len(best.effects) > 1:
        return []
    least = before + _AS_GOOD * (best.likelihood - before)
    return [name for name, one in alone.items() if name not in best.effects and one >= least]


@dataclass
class Result:
    """The search's end: the camera with all that was found, its last fit, and every exploration.

    ``refused`` are effects that would have gained beside those found; explorations from number
    ``beside_edges`` on take in pixels beside edges.
    """

    camera: Camera
    found: list[Found]
    explorations: list[Exploration]
    log_likelihood: float
    start_log_likelihood: float
    problem: Problem
    folds: Mapping[tuple[int, int], int]
    refused: list[Refused] = field(default_factory=list)
    beside_edges: int | None = None

    @property
    def fit(self) -> Fit:
        """The fit of the final camera."""
        return self.explorations[-1].fit

    def withdrawn(self) -> Result:
        """Return the result as if nothing had been found."""
        start = self.explorations[0]
        problem = replace(
            self.problem, masks=start.fit.forward.masks, geometry=(), reflectance=False, response=None
        )
        return replace(
            self,
            camera=start.fit.camera,
            found=[],
            explorations=[start],
            log_likelihood=self.start_log_likelihood,
            problem=problem,
            refused=[],
            beside_edges=None,
        )

    @property
    def gained(self) -> float:
        """What the search gained in held-out log likelihood [nats], each step at its own pixels."""
        total = self.log_likelihood - self.start_log_likelihood
        if self.beside_edges is None:
            return total
        before, at = self.explorations[self.beside_edges - 1 : self.beside_edges + 1]
        return total - (at.scores.log_likelihood() - before.scores.log_likelihood())
