"""What an exploration tells a search: who leads, what they rival, and what is the mark of something else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.calibrate.entry import LEAST_SIZE, Found, curve_of_forms
from rim_camera_ros.calibrate.exploration import Exploration
from rim_camera_ros.calibrate.sizes import effect_size
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Candidate

#: A smooth function of one covariate that gains this many times what any two effects do is another physics'
#: mark: of an effect's own covariate it gains what the effect does.
SMOOTHER = 1.5
#: Variants of an effect that are looked at again once another effect was found.
_MOST_VARIANTS = 4
#: Why an effect that would gain beside those found was not added.
NOT_IN_ALL_POSES = "as the poses do not agree that it gains"
NOT_ELSEWHERE = "as it gains only where what was found acts"
ONCE_FITTED = "as it gains or moves too little once it is fitted"
NOT_IN_TIME = "as it follows the time of the poses no better than chance does"


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


def refused(step: Exploration, found: Sequence[Found], failed: Mapping[str, str]) -> list[Refused]:
    """Return the effects that would gain beside those ``found`` and were not added, the best first.

    ``failed`` says why.
    """
    result = []
    for effect, k in step.best().items():
        gain, threshold = float(step.gains[k]), float(step.thresholds[k])
        if found and effect in failed and gain > threshold:
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
