"""Forward search: which effects the recordings ask for, beyond those of the camera file.

The leaders of an exploration are fitted non-linearly in the full forward chain, and the best joins the
camera; then everything is looked at anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.calibrate.adjustment import Fit, Problem
from rim_camera_ros.calibrate.elsewhere import shows_elsewhere
from rim_camera_ros.calibrate.exploration import Exploration, explore, explored, further_equations
from rim_camera_ros.calibrate.forms import form_blocks
from rim_camera_ros.calibrate.library import GEOMETRY, OF_SURFACES, Candidate, Facts, candidates
from rim_camera_ros.calibrate.needs import Found, least_size, needed
from rim_camera_ros.calibrate.selection import folds_of
from rim_camera_ros.calibrate.sizes import effect_size
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.scattering import Scattering

MOST_EFFECTS = 4
#: Leaders that may prove wrong when they are fitted, until the search ends.
_MOST_FAILURES = 2
#: Iterations of fits that add an effect, and shares of the sigmas at which they end.
_ITERATIONS = 12
_TOLERANCE = 0.15
#: A smooth function of one covariate that gains this many times what any two effects do is another physics'
#: mark: of an effect's own covariate it gains what the effect does.
_SMOOTHER = 1.5
#: Gain of a fit over its linear forecast above which it is looked at what gained it.
_BY_ITSELF = 2.0
#: Sigma [px] up to which stray light is none: the pixel's own footprint.
_LEAST_SPREAD = 1.0
#: Variants of an effect that are looked at again once another effect was found.
_MOST_VARIANTS = 4


@dataclass
class Result:
    """The search's end: the camera with all that was found, its last fit, and every exploration."""

    camera: Camera
    found: list[Found]
    explorations: list[Exploration]
    log_likelihood: float
    start_log_likelihood: float
    problem: Problem
    folds: Mapping[tuple[int, int], int]

    @property
    def fit(self) -> Fit:
        """The fit of the final camera."""
        return self.explorations[-1].fit


def search(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    *,
    effects: Sequence[str] | None = None,
    seed: int = 0,
    most: int = MOST_EFFECTS,
    further: Sequence[Candidate] = (),
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Add effects to a camera one after the other as long as held-out poses ask for them.

    ``effects`` restricts the candidates. ``further`` candidates are scored with the others but never join
    (smooth terms); where one of them explains far more than any effects, none joins.
    """
    say = progress if progress is not None else _silent
    folds = folds_of(problem.dataset)
    if "amplitude_nonlinearity" in camera.effects and problem.gain:
        problem = replace(problem, response=_level(problem.dataset))
    pool = candidates(camera, facts, effects=effects)
    say(f"baseline and {len(pool)} candidates")
    first = explore(problem, camera, pool, folds, further=further, seed=seed)
    problem = replace(problem, masks=first.fit.forward.pixels_used())
    explorations = [first]
    if _smooth_says_more(first):
        most = 0
    start = first.scores.log_likelihood()
    variants = _leading_variants(first)
    found: list[Found] = []
    step = first
    failed: set[str] = set()
    settled: set[int] = set()
    while len(found) < most and len(failed) <= _MOST_FAILURES:
        named = [one for one in _named(step, found) if step.candidates[one[0]].effect not in failed]
        if not named:
            break
        leader, gain = named[0]
        need = needed(step, leader, found)
        pair = step.best_pair(without=failed) if gain > 0.5 * step.threshold else None
        both = 0.0 if pair is None else max(needed(step, k, found) for k in pair[1])
        numbers: tuple[int, ...] = (leader,)
        if pair is not None and leader not in pair[1] and pair[0] > gain + max(both, 0.25 * gain):
            numbers = pair[1]
        elif gain <= need:
            if pair is None or pair[0] <= 1.5 * both:
                break
            numbers = pair[1]
        need = max(needed(step, k, found) for k in numbers)
        names = [one.effect for one in found]
        local = {
            step.candidates[k].effect for k in numbers if not shows_elsewhere(problem, step, k, names, folds)
        }
        if local:
            failed |= local
            continue
        chosen, likelihood, next_step, next_problem = _refined(
            problem, step, numbers, leader, found, failed, folds, further, variants, seed, say
        )
        gain = likelihood - step.scores.log_likelihood()
        need = max(needed(step, k, found) for k in step.best_of(chosen))
        again = _without_further(problem, step, next_step, chosen, gain, folds, seed) if found else None
        if again is not None:
            more = again.scores.log_likelihood() - step.scores.log_likelihood()
            gain -= max(more, 0.0)
            if gain <= need < more and len(found) not in settled:
                # the fit before had not come to its end: look at what is left of it
                settled.add(len(found))
                step.forget()
                step = _explored_further(again.fit, names, step, further, variants, folds, problem, seed)
                explorations[-1] = step
                continue
        if gain <= need or effect_size(next_step.fit, chosen, camera) < least_size(next_step, chosen, found):
            # what looked like it is something else: perhaps the next in line
            failed |= {step.candidates[k].effect for k in numbers}
            continue
        failed.clear()
        for name in chosen:
            rivals, ties = _rivals(step, name, need)
            found.append(Found(name, gain, rivals, ties, step=len(explorations) - 1))
        explorations.append(next_step)
        step.forget()
        step, problem = next_step, next_problem
    if len(found) > 1:
        say("whether each is still needed")
        step = _without_needless(problem, explorations, found, folds, further, variants, seed)
    return Result(
        camera=step.fit.camera,
        found=found,
        explorations=explorations,
        log_likelihood=step.scores.log_likelihood(),
        start_log_likelihood=start,
        problem=problem,
        folds=folds,
    )


def _fitted_anew(
    problem: Problem, camera: Camera, step: Exploration, folds: Mapping[tuple[int, int], int], seed: int
) -> Exploration:
    """Return the fit of a camera that begins at the nuisances of a step, without candidates."""
    return explore(
        problem,
        camera,
        [],
        folds,
        views=step.fit.forward.views,
        warm=step.fit,
        seed=seed,
        replicates=0,
        iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
    )


def _without_needless(
    problem: Problem,
    explorations: list[Exploration],
    found: list[Found],
    folds: Mapping[tuple[int, int], int],
    further: Sequence[Candidate],
    variants: Sequence[Candidate],
    seed: int,
) -> Exploration:
    """Drop effects from ``found`` that gain too little beside those that joined after them.

    An effect that stood in for others, found first, is needless once they are there. The last exploration is
    replaced by one without them, and returned.
    """
    step = explorations[-1]
    for one in list(found[:-1]):
        if one.effect not in step.fit.camera.effects or len(found) < 2:
            continue
        others = [other for other in found if other is not one]
        effects = {name: e for name, e in step.fit.camera.effects.items() if name != one.effect}
        without = _fitted_anew(problem, with_effects(step.fit.camera, effects), step, folds, seed)
        before = explorations[one.step]
        gain = step.scores.log_likelihood() - without.scores.log_likelihood()
        if gain > needed(before, before.best()[one.effect], others):
            continue
        found.remove(one)
        names = {other.effect for other in found}
        step.forget()
        step = _explored_further(without.fit, sorted(names), before, further, variants, folds, problem, seed)
        explorations[-1] = step
    return step


def _explored_further(
    fitted: Fit,
    present: Sequence[str],
    before: Exploration,
    further: Sequence[Candidate],
    variants: Sequence[Candidate],
    folds: Mapping[tuple[int, int], int],
    problem: Problem,
    seed: int,
) -> Exploration:
    """Explore what a fit leaves, beside changes of the forms of the effects that were found.

    Candidates are the leading ones of an exploration before, but those present.
    """
    left = [one for one in _leading_variants(before) if one.effect not in present]
    forms = form_blocks(fitted, present, variants)
    blocks = [*(one.block for one in (*left, *further)), *forms]
    return explored(
        further_equations(fitted, blocks, folds, problem),
        left,
        further=further,
        forms=sum(len(one.regressors) for one in forms),
        seed=seed,
    )


def _without_further(
    problem: Problem,
    before: Exploration,
    after: Exploration,
    chosen: Sequence[str],
    gain: float,
    folds: Mapping[tuple[int, int], int],
    seed: int,
) -> Exploration | None:
    """Return the fit without further effects from where that with them ended, where it gained much.

    Perhaps it is the effects found before them that gained, whose fit had not come to its end.
    """
    if gain <= _BY_ITSELF * before.joint(*before.best_of(chosen)):
        return None
    left = {name: e for name, e in after.fit.camera.effects.items() if name not in chosen}
    return _fitted_anew(problem, with_effects(before.fit.camera, left), after, folds, seed)


def _silent(text: str) -> None:
    return None


def _smooth_says_more(step: Exploration) -> bool:
    """Return whether a smooth function explains so much more than effects do that none of them is it."""
    smooth = step.best_further()
    if smooth is None or smooth[0] <= _SMOOTHER * float(step.thresholds[smooth[1]]):
        return False
    pair = step.best_pair()
    leader = float(step.gains[: step.named].max()) if step.named else 0.0
    return smooth[0] > _SMOOTHER * max(leader, 0.0 if pair is None else pair[0])


def _named(step: Exploration, found: Sequence[Found]) -> list[tuple[int, float]]:
    """Return candidates and gains, those first that gain what they must, by gain."""
    order = [(k, float(step.gains[k])) for k in range(step.named)]
    return sorted(order, key=lambda one: (one[1] < needed(step, one[0], found), -one[1]))


def _refined(
    problem: Problem,
    step: Exploration,
    numbers: tuple[int, ...],
    leader: int,
    found: Sequence[Found],
    failed: Set[str],
    folds: Mapping[tuple[int, int], int],
    further: Sequence[Candidate],
    variants: Sequence[Candidate],
    seed: int,
    say: Callable[[str], None],
) -> tuple[list[str], float, Exploration, Problem]:
    """Fit the leader and its near rivals non-linearly; return the best by held-out likelihood.

    A pair must beat the leader alone by what a further effect must gain: linearly, one that bends the light
    much looks worse than it is.
    """
    trials: list[tuple[int, ...]] = [numbers]
    lead = step.joint(*numbers)
    if len(numbers) == 2 and step.gains[leader] > needed(step, leader, found):
        trials.append((leader,))
    elif len(numbers) == 1:
        for effect, k in step.best().items():
            close = step.gains[k] > 0.6 * lead or lead - step.gains[k] < 2 * step.threshold
            possible = close and step.gains[k] > needed(step, k, found)
            if possible and effect not in {step.candidates[numbers[0]].effect, *failed}:
                trials.append((k,))
    best: tuple[float, list[str], Exploration, Problem] | None = None
    trials = trials[:3]
    for trial in trials:
        names = [step.candidates[k].effect for k in trial]
        say("fitting " + " and ".join(names))
        geometry = tuple(dict.fromkeys([*problem.geometry, *(n for n in names if n in GEOMETRY)]))
        reflectance = problem.reflectance or not OF_SURFACES.isdisjoint(names)
        own = replace(problem, geometry=geometry, reflectance=reflectance)
        # first by itself: what loses need not be explored; rays from where they are, as a linear guess of
        # them may put a texture's edges on other pixels
        start = step.camera_with([k for k in trial if step.candidates[k].effect not in GEOMETRY])
        alone = _fitted_anew(own, start, step, folds, seed)
        if "amplitude_nonlinearity" in names:
            # its one parameter first: together with a free response it would not find the way
            own = replace(own, response=_level(problem.dataset))
            alone = explore(
                own, alone.fit.camera, [], folds, views=step.fit.forward.views, warm=alone.fit, replicates=0
            )
        other = _what_it_became(alone, trial, step)
        if other is not None:
            if other not in trials:
                trials.append(other)
            continue
        likelihood = alone.scores.log_likelihood()
        if len(trial) == 2:
            likelihood -= max(needed(step, k, found) for k in trial)
        if best is None or likelihood > best[0]:
            best = (likelihood, names, alone, own)
    assert best is not None
    likelihood, names, alone, own = best
    present = [*(one.effect for one in found), *names]
    final = _explored_further(alone.fit, present, step, further, variants, folds, own, seed)
    return names, final.scores.log_likelihood(), final, own


def _what_it_became(alone: Exploration, trial: tuple[int, ...], step: Exploration) -> tuple[int, ...] | None:
    """Return the trial with two surfaces in a pixel for stray light that was fitted within its own pixel.

    None where each effect is what it was.
    """
    scattering = alone.fit.camera.effects.get("scattering")
    mixed = step.best().get("mixed_pixels")
    numbers = [k for k in trial if step.candidates[k].effect == "scattering"]
    if not isinstance(scattering, Scattering) or mixed is None or mixed in trial or not numbers:
        return None
    if scattering.ghost is not None or max(max(one.sigma) for one in scattering.kernels) > _LEAST_SPREAD:
        return None
    return tuple(mixed if k in numbers else k for k in trial)


def _level(dataset: Dataset) -> float:
    """Return the amplitude [counts] in the middle of a recording's."""
    values = np.concatenate([one.amplitude[one.count > 0][::17] for one in dataset.stations])
    return max(float(np.median(values)), 1.0) if values.size else 1000.0


def _leading_variants(step: Exploration) -> list[Candidate]:
    """Return the variants of each effect that are still worth their columns, in their order."""
    kept: set[int] = set()
    count: Counter[str] = Counter()
    for k in np.argsort(-step.gains[: step.named], kind="stable"):
        effect = step.candidates[int(k)].effect
        if count[effect] < _MOST_VARIANTS:
            kept.add(int(k))
            count[effect] += 1
    return [step.candidates[k] for k in sorted(kept)]


def _rivals(step: Exploration, name: str, need: float) -> tuple[list[tuple[str, float]], list[str]]:
    """Return the gains of all effects, and those which the named one cannot be told apart from.

    The encompassing test: a rival ties unless the named effect gains well on top of it.
    """
    best = step.best()
    rivals = [(effect, float(step.gains[k])) for effect, k in best.items()]
    own = best.get(name)
    ties = []
    if own is not None:
        for effect, k in best.items():
            if effect == name or step.gains[k] < 0.5 * step.gains[own]:
                continue
            on_top = step.joint(own, k) - float(step.gains[k])
            if on_top < min(need, 0.5 * float(step.gains[own])):
                ties.append(effect)
    return rivals, ties
