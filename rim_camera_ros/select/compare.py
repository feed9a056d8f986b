"""Comparisons of candidates: when one enters the model, who leads, who ties, and what a search comes to.

The form of an effect that was found is never quite the true one. What it leaves is compared with candidates
as one of them: a smooth curve of a covariate that the effect depends on enters as its discrepancy (Kennedy
and O'Hagan 2001), unnamed, where it predicts held-out poses better than every named candidate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Candidate
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.select.effect_sizes import effect_size
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.moved_poses import MovedPose
from rim_camera_ros.select.thresholds import WITHOUT_REPLICATES

#: Paired standard errors over poses that an effect must gain beside those found before it. The null
#: replicates give the threshold of the first; what forms leave that are not quite true is not in them.
PAIRED_ERRORS = 2.0
#: ... or the chance that every fold gains where none does on average (sign test), at most.
SIGN_CHANCE = 0.05
#: An effect must move distances by this much somewhere [m] (RMS over the 5 % of pixels it moves most).
LEAST_SIZE = 0.0005


@dataclass
class Found:
    """An effect that joined: its gain in nats alone at that step, and which others explain it as well.

    ``step`` is the number of the exploration that it was found in, ``threshold`` what it had to gain there
    [nats].
    """

    effect: str
    gain: float
    ties: list[str] = field(default_factory=list)
    step: int = 0
    threshold: float = WITHOUT_REPLICATES


def paired_error(after: Sequence[float], before: Sequence[float]) -> float:
    """Return the standard error [nats] of a gain of held-out log likelihood, from those of folds of poses.

    The folds' differences are paired (Vehtari, Gelman, Gabry 2017, eq. 23). 0 for fewer than two folds.
    """
    gains = np.asarray(after, float) - np.asarray(before, float)
    return float(np.sqrt(len(gains)) * np.std(gains, ddof=1)) if len(gains) > 1 else 0.0


def entry_gain(after: Sequence[float], before: Sequence[float], threshold: float) -> float:
    """Return what an effect must gain in all [nats]: the threshold, and more than poses disagree about.

    `PAIRED_ERRORS` of its gain, where folds do not all speak for it. What acts on oblique surfaces, or near
    ones, gains by a few poses most of all: the standard error of such a gain is large, and no evidence
    against it.
    """
    gains = np.asarray(after, float) - np.asarray(before, float)
    if gains.size and gains.min() > 0 and 0.5**gains.size <= SIGN_CHANCE:
        return threshold
    return max(threshold, PAIRED_ERRORS * paired_error(after, before))


def curve_of_forms(step: Exploration, found: Sequence[Found]) -> tuple[float, int] | None:
    """Return gain and number of the best smooth curve of what the effects found depend on, if there is one.

    The gain is that beside the changes of forms which the exploration has already.
    """
    effects = [step.fit.camera.effects.get(finding.effect) for finding in found]
    own = {name for effect in effects if effect is not None for name in effect.own_covariates()}
    smooth = [k for k in range(step.named, len(step.candidates)) if step.candidates[k].variant in own]
    return max(((step.joint(k), k) for k in smooth), default=None)


#: A smooth function of one covariate that gains this many times what any two effects do is another physics'
#: mark: of an effect's own covariate it gains what the effect does.
SMOOTHER = 1.5
#: Variants of an effect that are looked at again once another effect was found.
_MOST_VARIANTS = 4
#: Why an effect that would gain beside those found was not added.
NOT_IN_ALL_POSES = "as the poses do not agree that it gains"
NOT_IN_QUIET_PIXELS = "as it gains only where what was found acts"
ONCE_FITTED = "as it gains or moves too little once it is fitted"
NOT_IN_TIME = "as it follows the time of the poses no better than chance does"
SAME_PHYSICS = "as it is what was found, of another form: its own parameters have no other physics there"


@dataclass(frozen=True)
class Refused:
    """An effect that was not added though it would gain: gain and its threshold [nats], and why."""

    effect: str
    gain: float
    threshold: float
    why: str


def smooth_says_more(step: Exploration) -> bool:
    """Return whether a smooth function explains so much more than effects do that none of them is it."""
    smooth = step.best_further()
    if smooth is None or smooth[0] <= SMOOTHER * float(step.thresholds[smooth[1]]):
        return False
    pair = step.best_pair()
    leader = float(step.gains[: step.named].max()) if step.named else 0.0
    return smooth[0] > SMOOTHER * max(leader, 0.0 if pair is None else pair[0])


def discrepancy(step: Exploration, found: Sequence[Found], failed: Set[str]) -> int | None:
    """Return the smooth curve that says more of what is left than any candidate does; None: there is none.

    It is one of what the effects found depend on, whose form is not quite the true one then.
    """
    curve = curve_of_forms(step, found)
    if curve is None or curve[0] <= float(step.thresholds[curve[1]]):
        return None
    named = [gain for k, gain in _named(step) if step.candidates[k].effect not in failed]
    return curve[1] if curve[0] > max(named, default=0.0) else None


def leaders(step: Exploration, failed: Set[str]) -> tuple[tuple[int, ...], int] | None:
    """Return the candidate or the pair to fit next, and the leader alone; None where nothing gains enough.

    ``failed`` effects are left out.
    """
    named = [one for one in _named(step) if step.candidates[one[0]].effect not in failed]
    if not named:
        return None
    leader, gain = named[0]
    need = float(step.thresholds[leader])
    pair = step.best_pair(without=failed) if gain > 0.5 * step.threshold else None
    both = 0.0 if pair is None else max(float(step.thresholds[k]) for k in pair[1])
    if pair is not None and leader not in pair[1] and pair[0] > gain + max(both, 0.25 * gain):
        return pair[1], leader
    if gain > need:
        return (leader,), leader
    return None if pair is None or pair[0] <= 1.5 * both else (pair[1], leader)


def refused(step: Exploration, failed: Mapping[str, str]) -> list[Refused]:
    """Return the effects that would gain at a step and were not added, the best first.

    ``failed`` says why.
    """
    result = []
    for effect, k in step.best().items():
        gain, threshold = float(step.gains[k]), float(step.thresholds[k])
        if effect in failed and gain > threshold:
            result.append(Refused(effect, gain, threshold, failed[effect]))
    return result


def near_rivals(
    step: Exploration, numbers: tuple[int, ...], leader: int, failed: Set[str]
) -> list[tuple[int, ...]]:
    """Return what to fit beside the chosen: the leader alone for a pair, else who gains nearly as much."""
    if len(numbers) == 2:
        return [(leader,)] if step.gains[leader] > step.thresholds[leader] else []
    lead = step.joint(*numbers)
    result: list[tuple[int, ...]] = []
    for effect, k in step.best().items():
        close = step.gains[k] > 0.6 * lead or lead - step.gains[k] < 2 * step.threshold
        possible = close and step.gains[k] > step.thresholds[k]
        if possible and effect not in {step.candidates[numbers[0]].effect, *failed}:
            result.append((k,))
    return result


def _named(step: Exploration) -> list[tuple[int, float]]:
    """Return candidates and gains, those first that exceed their threshold, by gain."""
    order = [(k, float(step.gains[k])) for k in range(step.named)]
    return sorted(order, key=lambda one: (one[1] < step.thresholds[one[0]], -one[1]))


def leading_variants(step: Exploration) -> list[Candidate]:
    """Return the variants of each effect that are still worth their columns, in their order."""
    kept: set[int] = set()
    count: Counter[str] = Counter()
    for k in np.argsort(-step.gains[: step.named], kind="stable"):
        effect = step.candidates[int(k)].effect
        if count[effect] < _MOST_VARIANTS:
            kept.add(int(k))
            count[effect] += 1
    return [step.candidates[k] for k in sorted(kept)]


def tied(step: Exploration, name: str, need: float) -> list[str]:
    """Return the effects which the named one cannot be told apart from.

    The encompassing test: an effect ties unless the named effect gains well on top of it.
    """
    best = step.best()
    own = best.get(name)
    ties = []
    if own is not None:
        for effect, k in best.items():
            if effect == name or step.gains[k] < 0.5 * step.gains[own]:
                continue
            on_top = step.joint(own, k) - float(step.gains[k])
            if on_top < min(need, 0.5 * float(step.gains[own])):
                ties.append(effect)
    return ties


def what_it_became(
    fitted: Exploration, trial: tuple[int, ...], step: Exploration, start: Camera
) -> tuple[int, ...] | None:
    """Return what a trial became once it was fitted; None where each effect is what it was.

    A pair becomes one effect where the other moves next to nothing; an effect becomes another in a limit of
    its parameters. ``start`` is the camera before anything was found.
    """
    if len(trial) == 2:
        for k, other in (trial, trial[::-1]):
            names = [step.candidates[k].effect]
            if effect_size(fitted.fit, names, start) < LEAST_SIZE:
                return (other,)
    best, effects = step.best(), fitted.fit.camera.effects
    for k in trial:
        effect = effects.get(step.candidates[k].effect)
        limit = None if effect is None else effect.limit
        if limit in best and best[limit] not in trial:
            return tuple(best[limit] if one == k else one for one in trial)
    return None


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted, the problem with what they free, the fit, and its log likelihood.

    A pair's is less by what a further effect must gain.
    """

    effects: list[str]
    problem: Problem
    fitted: Exploration
    likelihood: float


def is_form_of_another(trial: Trial, found: Sequence[str]) -> bool:
    """Return whether an effect has become one ``found`` before it, in a limit of its own parameters."""
    effects = trial.fitted.fit.camera.effects
    return any(effects[name].limit in found for name in trial.effects if name in effects)


def as_good(alone: Mapping[str, Trial], best: Trial) -> list[str]:
    """Return the effects, of those fitted ``alone``, of which poses do not agree that the best is better.

    None where the best are two effects. Those whose paired difference is within two standard errors.
    """
    if len(best.effects) > 1:
        return []
    mine = best.fitted.scores.log_likelihoods()
    result = []
    for name, trial in alone.items():
        theirs = trial.fitted.scores.log_likelihoods()
        ahead = best.likelihood - trial.likelihood
        close = not mine or ahead <= PAIRED_ERRORS * paired_error(mine, theirs)
        if name not in best.effects and close:
            result.append(name)
    return result


@dataclass
class Result:
    """The search's end: the camera with all that was found, its last fit, and every exploration.

    ``refused`` are effects that would have gained beside those found; explorations from number
    ``beside_edges`` on take in pixels beside edges. ``moved`` are surfaces that stand elsewhere in a few
    poses, where nothing else explains as much.
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
    moved: list[MovedPose] = field(default_factory=list)

    @property
    def fit(self) -> Fit:
        """The fit of the final camera."""
        return self.explorations[-1].fit

    def forget(self) -> None:
        """Let go of the sums per pixel, where the search is made anew."""
        for exploration in self.explorations:
            exploration.forget()

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
            explorations=[start.recalled(problem, self.folds)],
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
