"""What a search tries, and what it comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rim_camera_ros.calibrate.entry import PAIRED_ERRORS, Found, paired_error
from rim_camera_ros.calibrate.exploration import Exploration
from rim_camera_ros.calibrate.leaders import Refused
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.camera import Camera


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted, the problem with what they free, the fit, and its log likelihood.

    A pair's is less by what a further effect must gain.
    """

    effects: list[str]
    problem: Problem
    fitted: Exploration
    likelihood: float


def as_good(alone: Mapping[str, Trial], best: Trial) -> list[str]:
    """Return the effects, of those fitted ``alone``, of which poses do not agree that the best is better.

    None where the best are two effects. Those whose paired difference is within two standard errors.
    """
    if len(best.effects) > 1:
        return []
    mine = best.fitted.scores.log_likelihoods()
    result = []
    for name, one in alone.items():
        theirs = one.fitted.scores.log_likelihoods()
        close = sum(mine) - sum(theirs) <= PAIRED_ERRORS * paired_error(mine, theirs)
        if name not in best.effects and close:
            result.append(name)
    return result


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
