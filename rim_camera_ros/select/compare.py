"""Comparisons of candidates: when one enters the model, which leads, which tie, and a search's result.

The form of an effect that was found is never quite the true one. So its model discrepancy (Kennedy and
O'Hagan 2001) competes with the candidates: a smooth curve of a covariate that the effect depends on enters
the model, unnamed, where it predicts held-out poses better than every named candidate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Candidate
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.select.effect_sizes import effect_size
from rim_camera_ros.select.exploration import Exploration, explored, further_equations
from rim_camera_ros.select.foreign_values import ForeignValues
from rim_camera_ros.select.moved_poses import MovedPose
from rim_camera_ros.select.thresholds import LEAST_EXPLAINED, STANDARD_ERRORS, WITHOUT_REPLICATES

#: An effect must gain `STANDARD_ERRORS`, paired over poses, conditional on those found before it: the null
#: replicates give the threshold of the first effect; they do not contain residuals of inexact forms. Or this
#: is the greatest probability that every fold gains where none does on average (sign test).
SIGN_CHANCE = 0.05
#: An effect must move distances by this much somewhere [m] (RMS over the 5 % of pixels it moves most).
LEAST_SIZE = 0.0005


@dataclass
class Found:
    """An effect that was found: its own gain in nats at that step, and ``ties``, others that gain as much.

    ``step`` is the number of the exploration in which it was found, ``threshold`` its entry threshold there
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
    """Return the gain [nats] that an effect requires: its threshold or, if more, two standard errors of it.

    The threshold alone where every fold gains. An effect that acts on oblique or near surfaces gains mostly
    by a few poses: the standard error of such a gain is large, which is no evidence against the effect.
    """
    gains = np.asarray(after, float) - np.asarray(before, float)
    if gains.size and gains.min() > 0 and 0.5**gains.size <= SIGN_CHANCE:
        return threshold
    return max(threshold, STANDARD_ERRORS * paired_error(after, before))


def curve_of_forms(step: Exploration, found: Sequence[Found]) -> tuple[float, int] | None:
    """Return gain and number of the best smooth curve of a covariate of the effects found, if there is one.

    The gain is conditional on the changes of forms that the exploration already contains.
    """
    effects = [step.fit.camera.effects.get(finding.effect) for finding in found]
    own = {name for effect in effects if effect is not None for name in effect.own_covariates()}
    smooth = [k for k in range(step.named, len(step.candidates)) if step.candidates[k].variant in own]
    return max(((step.joint(k), k) for k in smooth), default=None)


#: A smooth function of one covariate that gains this many times what any two effects gain is a sign of
#: unknown physics: a smooth function of an effect's own covariate gains about as much as the effect.
SMOOTHER = 1.5
#: Variants of an effect that are scored again once another effect was found.
_MOST_VARIANTS = 4
#: Why an effect that would gain conditional on those found was not added.
NOT_IN_ALL_POSES = "as the poses do not agree that it gains"
NOT_IN_QUIET_PIXELS = "as it gains only where what was found acts"
ONCE_FITTED = "as it gains or moves too little once it is fitted"
NOT_IN_TIME = "as it follows the time of the poses no better than chance does"
SAME_PHYSICS = "as it is what was found, of another form: its own parameters have no other physics there"


@dataclass(frozen=True)
class Refused:
    """An effect that was not added though it gains: its gain and threshold [nats], and the reason."""

    effect: str
    gain: float
    threshold: float
    why: str


def smooth_says_more(step: Exploration) -> bool:
    """Return whether a smooth function explains so much more than any effects that none of them fits."""
    smooth = step.best_further()
    if smooth is None or smooth[0] <= SMOOTHER * float(step.thresholds[smooth[1]]):
        return False
    return smooth[0] > _far_more_than_named(step)


def image_says_more(
    step: Exploration, image: Candidate | None, problem: Problem, folds: Mapping[tuple[int, int], int]
) -> bool:
    """Return whether a term with many values over the array, if there is one, explains so much more.

    That is half of the misfit at least. It is scored where a smooth function gains and the misfit is as large
    as the term would have to gain.
    """
    smooth, need = step.best_further(), _far_more_than_named(step)
    if smooth is None or image is None or smooth[0] <= float(step.thresholds[smooth[1]]):
        return False
    left = misfit(step)
    if left <= need:
        return False
    scored = in_addition(step.fit, image, problem, folds)
    least = SMOOTHER * float(scored.thresholds[0])
    return float(scored.gains[0]) > max(need, least, LEAST_EXPLAINED * left)


def in_addition(
    fitted: Fit, candidate: Candidate, problem: Problem, folds: Mapping[tuple[int, int], int]
) -> Exploration:
    """Score a term outside the vocabulary in addition to a fit, without replicates."""
    equations = further_equations(fitted, [candidate.block], folds, problem)
    return explored(equations, [], further=[candidate], replicates=0)


def misfit(step: Exploration) -> float:
    """Return what a perfect model would gain [nats] over an exploration's, by its held-out poses."""
    chi_square, rows = step.scores.chi_square(held_out=True)
    return (chi_square - rows) / 2


def _far_more_than_named(step: Exploration) -> float:
    """Return what a term outside the vocabulary must gain to be a sign of unknown physics [nats]."""
    pair = step.best_pair()
    leader = float(step.gains[: step.named].max()) if step.named else 0.0
    return SMOOTHER * max(leader, 0.0 if pair is None else pair[0])


def discrepancy(step: Exploration, found: Sequence[Found], failed: Set[str]) -> int | None:
    """Return the number of the smooth curve that gains more than every named candidate; None: there is none.

    It is a curve of a covariate of the effects found, whose form is then not quite the true one.
    """
    curve = curve_of_forms(step, found)
    if curve is None or curve[0] <= float(step.thresholds[curve[1]]):
        return None
    named = [gain for k, gain in _named(step) if step.candidates[k].effect not in failed]
    return curve[1] if curve[0] > max(named, default=0.0) else None


def leaders(step: Exploration, failed: Set[str]) -> tuple[tuple[int, ...], int] | None:
    """Return the candidate or the pair to fit next, and the leader alone; None where nothing gains enough.

    ``failed`` effects are excluded.
    """
    named = [(k, gain) for k, gain in _named(step) if step.candidates[k].effect not in failed]
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
    """Return the effects that gain at a step and were not added, the best first.

    ``failed`` holds the reasons by effect.
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
    """Return rivals to fit as well: of a pair its leader alone, else the effects that gain nearly as much."""
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
    """Return the named candidates and their gains, by gain; first those that exceed their threshold."""
    order = [(k, float(step.gains[k])) for k in range(step.named)]
    return sorted(order, key=lambda item: (item[1] < step.thresholds[item[0]], -item[1]))


def leading_variants(step: Exploration) -> list[Candidate]:
    """Return the leading variants of each effect, at most `_MOST_VARIANTS`, in their order."""
    kept: set[int] = set()
    count: Counter[str] = Counter()
    for k in np.argsort(-step.gains[: step.named], kind="stable"):
        effect = step.candidates[int(k)].effect
        if count[effect] < _MOST_VARIANTS:
            kept.add(int(k))
            count[effect] += 1
    return [step.candidates[k] for k in sorted(kept)]


def tied(step: Exploration, name: str, need: float) -> list[str]:
    """Return the effects from which the named one cannot be distinguished.

    The encompassing test: another effect ties unless the named one gains enough conditional on it.
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
    """Return the candidates to which a trial reduces once it is fitted; None where each effect stays itself.

    A pair reduces to one effect where the other moves distances by next to nothing; an effect becomes another
    effect in a limit of its parameters. ``start`` is the camera before anything was found.
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
            return tuple(best[limit] if number == k else number for number in trial)
    return None


@dataclass(frozen=True)
class Trial:
    """Effects that were fitted, the problem with the parameters they free, the fit, and its log likelihood.

    The likelihood of a pair is reduced by the entry threshold of a further effect.
    """

    effects: list[str]
    problem: Problem
    fitted: Exploration
    likelihood: float


def is_form_of_another(trial: Trial, found: Sequence[str]) -> bool:
    """Return whether an effect of a trial equals an effect ``found`` before, in a limit of its parameters."""
    effects = trial.fitted.fit.camera.effects
    return any(effects[name].limit in found for name in trial.effects if name in effects)


def as_good(alone: Mapping[str, Trial], best: Trial) -> list[str]:
    """Return the effects, of those fitted ``alone``, than which the best is not significantly better.

    These are the effects whose paired difference is within two standard errors. Empty where the best trial
    is of two effects.
    """
    if len(best.effects) > 1:
        return []
    mine = best.fitted.scores.log_likelihoods()
    result = []
    for name, trial in alone.items():
        theirs = trial.fitted.scores.log_likelihoods()
        ahead = best.likelihood - trial.likelihood
        close = not mine or ahead <= STANDARD_ERRORS * paired_error(mine, theirs)
        if name not in best.effects and close:
            result.append(name)
    return result


@dataclass
class Result:
    """The result of a search: the camera with all that was found, its last fit, and every exploration.

    ``refused`` are effects that gain conditional on those found and were not added. Explorations from number
    ``beside_edges`` on include pixels beside edges. ``moved`` are surfaces that are displaced in a few poses,
    where no physics explains as much; ``foreign`` are values that do not see the scene, without which the
    search is to be repeated. ``by_image`` says that a term with many values over the array explains far more
    than any effects.
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
    foreign: ForeignValues | None = None
    by_image: bool = False

    @property
    def fit(self) -> Fit:
        """The fit of the final camera."""
        return self.explorations[-1].fit

    def away_from_edges(self) -> Exploration:
        """Return the final exploration without its candidates, by the pixels that no edge reaches."""
        final = self.explorations[-1]
        if self.beside_edges is None:
            return final
        before = self.explorations[self.beside_edges - 1]
        problem = replace(self.problem, masks=before.fit.forward.masks)
        fitted = further_equations(final.fit, final.forms, self.folds, problem)
        return explored(fitted, [], forms=final.forms, replicates=0)

    def without_edges(self, fitted: Fit) -> Fit:
        """Return a fit with the residuals of the pixels alone that no edge reaches."""
        if self.beside_edges is None:
            return fitted
        clean = self.explorations[self.beside_edges - 1].fit.forward.masks
        forward = copy(fitted.forward)
        if clean is not None and forward.masks is not None:
            pairs = zip(forward.masks, clean, strict=True)
            forward.masks = [(used & own, lit & shown) for (used, lit), (own, shown) in pairs]
        return replace(fitted, forward=forward)

    def forget(self) -> None:
        """Free the sums per pixel, where the search is repeated."""
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
        """The gain of the search in held-out log likelihood [nats], each step by its own pixels."""
        total = self.log_likelihood - self.start_log_likelihood
        if self.beside_edges is None:
            return total
        before, at = self.explorations[self.beside_edges - 1 : self.beside_edges + 1]
        return total - (at.scores.log_likelihood() - before.scores.log_likelihood())
