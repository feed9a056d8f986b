"""Forward search: which effects the recordings ask for, beyond those of the camera file.

One exploration linearises all candidates at the present fit and scores them, alone and in pairs, against a
threshold from simulated nulls of this very recording. The leaders are then fitted non-linearly in the full
forward chain, and the best of them joins the camera; then everything is looked at anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.adjustment import Fit, Problem, fit
from rim_camera_ros.calibrate.library import GEOMETRY, OF_SURFACES, Candidate, Facts, candidates, optics_block
from rim_camera_ros.calibrate.normal_equations import Block
from rim_camera_ros.calibrate.nulls import null_scores
from rim_camera_ros.calibrate.prediction import Prediction
from rim_camera_ros.calibrate.selection import Scores, folds_of
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.parameters import flatten

Array = NDArray[Any]

#: Share of nulls that may raise an alarm, and the least threshold in nats.
ALARM_RATE = 0.02
LEAST_THRESHOLD = 8.0
#: Candidates that differ as much as independent tries would.
_INDEPENDENT = 8
#: A further effect must gain this share of what the effects before it gained: more where it is of the kind
#: of one of them, whose form is never quite the true one and leaves such a rest.
LEAST_SHARE = 0.0015
LEAST_SHARE_OF_KIND = 0.05
#: ... and still more beside effects of which no form is near every true one: surfaces out of the view send
#: light as well.
LEAST_SHARE_BESIDE_ROUGH = 0.15
_ROUGH = {
    "multipath": frozenset(
        {"emitter_offset", "camera_constant", "lens_distortion", "distance_scale", "radiometry", "scattering"}
    ),
}
_KINDS = (
    frozenset({"scattering", "mixed_pixels", "multipath", "saturation_bleed"}),
    frozenset({"emission_pattern", "amplitude_nonlinearity", "emitter_offset", "radiometry", "scattering"}),
    frozenset({"cyclic_error", "distance_scale", "camera_constant", "lens_distortion", "emitter_offset"}),
    frozenset({"warm_up_drift", "ambient_temperature"}),
)
#: ... unless it changes whole poses, whose errors limit what it can gain.
LEAST_SHARE_OF_POSES = 0.0005
OF_POSES = frozenset({"warm_up_drift", "ambient_temperature", "integration_time_offset"})
#: A further effect must move distances by this much somewhere [m] (RMS over the 5 % of pixels it moves most).
LEAST_SIZE = 0.0005
#: ... and these shares of what one of its kind, or any other, moves them: the rest that its form leaves.
LEAST_SIZE_OF_KIND = 0.15
LEAST_SIZE_OF_ALL = 0.07
#: Sigma beyond which light that is added is taken for negative, which none is.
_NEGATIVE = 3.0
MOST_EFFECTS = 4
#: Leaders that may prove wrong when they are fitted, until the search ends.
_MOST_FAILURES = 2
#: Variants of an effect that are looked at again once another effect was found.
_MOST_VARIANTS = 4
#: Number of pixels from which fewer replicates are drawn, for the memory that they take.
_MANY_PIXELS = 60_000


@dataclass
class Exploration:
    """Scores of all candidates at one fit.

    ``gains`` in nats of held-out log likelihood and ``thresholds``, one per candidate, the latter from its
    gains
    in replicates in which nothing is left out; ``null_maxima`` is the greatest excess over the threshold's
    least value in each of them. The first ``named``
    candidates are of the vocabulary, the others stand for what is not.
    """

    fit: Fit
    candidates: Sequence[Candidate]
    scores: Scores
    spans: list[list[int]]
    gains: Array
    null_maxima: Array
    thresholds: Array
    named: int

    @property
    def threshold(self) -> float:
        """Threshold in nats of the best named candidate."""
        leader = int(np.argmax(self.gains[: self.named])) if self.named else 0
        return float(self.thresholds[leader]) if self.thresholds.size else LEAST_THRESHOLD

    def forget(self) -> None:
        """Let go of the sums per pixel, which only the last exploration still needs."""
        for fold in self.fit.equations.folds:
            fold.pixel = fold.pixel[:, :0]

    def best(self) -> dict[str, int]:
        """Return the best variant of each effect, the best effect first; further candidates left out."""
        result: dict[str, int] = {}
        for k in np.argsort(-self.gains[: self.named]):
            result.setdefault(self.candidates[int(k)].effect, int(k))
        return result

    def best_of(self, effects: Sequence[str]) -> list[int]:
        """Return the best variants of some effects."""
        best = self.best()
        return [best[effect] for effect in effects]

    def best_further(self) -> tuple[float, int] | None:
        """Return gain and number of the best candidate that is not of the vocabulary."""
        rest = self.gains[self.named :]
        return (float(rest.max()), self.named + int(rest.argmax())) if rest.size else None

    def joint(self, *numbers: int) -> float:
        """Return the gain of several candidates together."""
        return float(self.scores.gain([i for k in numbers for i in self.spans[k]]))

    def best_pair(
        self, most: int = 12, *, without: Set[str] = frozenset()
    ) -> tuple[float, tuple[int, int]] | None:
        """Return the best pair of different effects among the leading variants of every effect."""
        leaders = [k for effect, k in self.best().items() if effect not in without][:most]
        extra = [
            int(k)
            for k in np.argsort(-self.gains[: self.named])[: 2 * most]
            if int(k) not in leaders
            and self.candidates[int(k)].effect not in without
            and self.gains[int(k)] > 0.3 * self.gains[: self.named].max()
        ]
        pool = leaders + extra[:6]
        pairs = [
            (self.joint(a, b), (a, b))
            for a, b in combinations(pool, 2)
            if self.candidates[a].effect != self.candidates[b].effect
        ]
        return max(pairs, default=None)

    def camera_with(self, numbers: Sequence[int]) -> Camera:
        """Return the fitted camera with candidates at the strength that the linear fit gives them."""
        values = self.scores.values([i for k in numbers for i in self.spans[k]])
        camera = self.fit.camera
        for k in numbers:
            camera = self.candidates[k].build(camera, values)
        return camera


def explore(
    problem: Problem,
    camera: Camera,
    found: Sequence[Candidate],
    folds: Mapping[tuple[int, int], int],
    *,
    further: Sequence[Candidate] = (),
    views: Any = None,
    warm: Fit | None = None,
    seed: int = 0,
    replicates: int = 200,
    iterations: int = 8,
    progress: Callable[[str], None] | None = None,
) -> Exploration:
    """Fit the camera and score all candidates at the solution."""
    blocks: list[Block] = [one.block for one in (*found, *further)]
    fitted = fit(
        problem,
        camera,
        fold_of=folds,
        further=blocks,
        views=views,
        warm=warm,
        iterations=iterations,
        progress=progress,
    )
    return explored(fitted, found, further=further, seed=seed, replicates=replicates)


def explored(
    fitted: Fit,
    named: Sequence[Candidate],
    *,
    further: Sequence[Candidate] = (),
    seed: int = 0,
    replicates: int = 200,
) -> Exploration:
    """Score the candidates whose columns stand in a fit's equations after its parameters."""
    count = len(fitted.parameters)
    found = [*named, *further]
    spans: list[list[int]] = []
    start = count
    for one in found:
        width = len(one.block.regressors)
        spans.append(list(range(start, start + width)))
        start += width
    scores = Scores(fitted.equations, range(count))
    # what no model explains makes every gain larger than the noise would: measure in its units
    chi_square, rows = scores.chi_square(held_out=True)
    temper = max(1.0, chi_square / max(rows, 1)) if rows else 1.0
    gains = np.array([_gain(scores, one, span) for one, span in zip(found, spans, strict=True)])
    maxima = np.zeros(0)
    thresholds = np.full(len(found), LEAST_THRESHOLD)
    if fitted.camera.sensor.width * fitted.camera.sensor.height > _MANY_PIXELS:
        replicates = min(replicates, 60)
    if replicates and scores.trained and found:
        nulls = null_scores(
            fitted.equations,
            range(count),
            replicates=replicates,
            seed=seed,
            temper=temper,
            errors=fitted.nuisances,
        )
        base = nulls.held_out()
        drawn = np.array([nulls.held_out(span) - base for span in spans])
        rate = ALARM_RATE / _INDEPENDENT
        thresholds = np.array([max(LEAST_THRESHOLD, gumbel_quantile(one, 1 - rate)) for one in drawn])
        maxima = drawn[: len(named)].max(axis=0) if named else drawn.max(axis=0)
    return Exploration(fitted, found, scores, spans, gains, maxima, thresholds, len(named))


def _gain(scores: Scores, candidate: Candidate, span: Sequence[int]) -> float:
    gain = float(scores.gain(span))
    if candidate.positive and gain > 0:
        values = scores.values(span)
        sigma = np.sqrt(np.diag(scores.covariance(scores.columns(span))))
        labels = [scores.regressors[int(i)].label for i in scores.columns(span)]
        limits = dict(zip(labels, -_NEGATIVE * sigma, strict=True))
        if any(values[label] < limits[label] for label in candidate.positive):
            return 0.0
    return gain


def gumbel_quantile(maxima: Array, probability: float) -> float:
    """Return a quantile of maxima by a Gumbel distribution of their mean and spread."""
    scale = float(np.std(maxima)) * np.sqrt(6) / np.pi
    location = float(np.mean(maxima)) - 0.5772 * scale
    return float(location - scale * np.log(-np.log(probability)))


@dataclass
class Found:
    """An effect that joined: its gain in nats alone at that step, and who else could have explained it."""

    effect: str
    gain: float
    rivals: list[tuple[str, float]] = field(default_factory=list)
    ties: list[str] = field(default_factory=list)


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
    (smooth terms).
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
    start = first.scores.log_likelihood()
    found: list[Found] = []
    step = first
    failed: set[str] = set()
    while len(found) < most and len(failed) <= _MOST_FAILURES:
        named = [one for one in _named(step, found) if step.candidates[one[0]].effect not in failed]
        if not named:
            break
        leader, gain = named[0]
        need = _needed(step, leader, found)
        pair = step.best_pair(without=failed) if gain > 0.5 * step.threshold else None
        both = 0.0 if pair is None else max(_needed(step, k, found) for k in pair[1])
        numbers: tuple[int, ...] = (leader,)
        if pair is not None and leader not in pair[1] and pair[0] > gain + max(both, 0.25 * gain):
            numbers = pair[1]
        elif gain <= need:
            if pair is None or pair[0] <= 1.5 * both:
                break
            numbers = pair[1]
        need = max(_needed(step, k, found) for k in numbers)
        chosen, likelihood, next_step, next_problem = _refined(
            problem, step, numbers, leader, found, folds, further, seed, say
        )
        before = step.scores.log_likelihood()
        gain = likelihood - before
        need = max(_needed(step, k, found) for k in step.best_of(chosen))
        if gain <= need or effect_size(next_step.fit, chosen, camera) < _least_size(next_step, chosen, found):
            # what looked like it is something else: perhaps the next in line
            failed |= {step.candidates[k].effect for k in numbers}
            continue
        failed.clear()
        for name in chosen:
            rivals, ties = _rivals(step, name, need)
            found.append(Found(name, gain, rivals, ties))
        explorations.append(next_step)
        step.forget()
        step, problem = next_step, next_problem
    return Result(
        camera=step.fit.camera,
        found=found,
        explorations=explorations,
        log_likelihood=step.scores.log_likelihood(),
        start_log_likelihood=start,
        problem=problem,
        folds=folds,
    )


def _least_size(step: Exploration, chosen: Sequence[str], found: Sequence[Found]) -> float:
    """Return how far further effects must move distances [m]: more beside others of their kind."""
    rivals = [
        one.effect
        for one in found
        for name in chosen
        if any(name in kind and one.effect in kind for kind in _KINDS)
    ]
    shares = {one.effect: LEAST_SIZE_OF_ALL for one in found}
    shares |= dict.fromkeys(rivals, LEAST_SIZE_OF_KIND)
    sizes = {name: effect_size(step.fit, [name], step.fit.start) for name in shares}
    return max([LEAST_SIZE, *(share * sizes[name] for name, share in shares.items())])


def _silent(text: str) -> None:
    return None


def _needed(step: Exploration, number: int, found: Sequence[Found]) -> float:
    """Return what a candidate must gain [nats] after others were found."""
    effect = step.candidates[number].effect
    share = LEAST_SHARE_OF_POSES if effect in OF_POSES else LEAST_SHARE
    need = share * sum(one.gain for one in found)
    for one in found:
        if any(effect in kind and one.effect in kind for kind in _KINDS):
            need = max(need, LEAST_SHARE_OF_KIND * one.gain)
        if effect in _ROUGH.get(one.effect, ()):
            need = max(need, LEAST_SHARE_BESIDE_ROUGH * one.gain)
    return max(float(step.thresholds[number]), need)


def _named(step: Exploration, found: Sequence[Found]) -> list[tuple[int, float]]:
    """Return candidates and gains, those first that gain what they must, by gain."""
    order = [(k, float(step.gains[k])) for k in range(step.named)]
    return sorted(order, key=lambda one: (one[1] < _needed(step, one[0], found), -one[1]))


def _refined(
    problem: Problem,
    step: Exploration,
    numbers: tuple[int, ...],
    leader: int,
    found: Sequence[Found],
    folds: Mapping[tuple[int, int], int],
    further: Sequence[Candidate],
    seed: int,
    say: Callable[[str], None],
) -> tuple[list[str], float, Exploration, Problem]:
    """Fit the leader and its near rivals non-linearly; return the best by held-out likelihood.

    A pair must beat the leader alone by what a further effect must gain: linearly, one that bends the light
    much looks worse than it is.
    """
    trials: list[tuple[int, ...]] = [numbers]
    lead = step.joint(*numbers)
    if len(numbers) == 2 and step.gains[leader] > _needed(step, leader, found):
        trials.append((leader,))
    elif len(numbers) == 1:
        for effect, k in step.best().items():
            close = step.gains[k] > 0.6 * lead or lead - step.gains[k] < 2 * step.threshold
            possible = close and step.gains[k] > _needed(step, k, found)
            if possible and effect != step.candidates[numbers[0]].effect:
                trials.append((k,))
    best: tuple[float, list[str], Exploration, Problem] | None = None
    for trial in trials[:3]:
        names = [step.candidates[k].effect for k in trial]
        say("fitting " + " and ".join(names))
        geometry = tuple(dict.fromkeys([*problem.geometry, *(n for n in names if n in GEOMETRY)]))
        reflectance = problem.reflectance or not OF_SURFACES.isdisjoint(names)
        own = replace(problem, geometry=geometry, reflectance=reflectance)
        # first by itself: what loses need not be explored
        alone = explore(
            own,
            step.camera_with(trial),
            [],
            folds,
            views=step.fit.forward.views,
            warm=step.fit,
            seed=seed,
            replicates=0,
        )
        if "amplitude_nonlinearity" in names:
            # its one parameter first: together with a free response it would not find the way
            own = replace(own, response=_level(problem.dataset))
            alone = explore(
                own, alone.fit.camera, [], folds, views=step.fit.forward.views, warm=alone.fit, replicates=0
            )
        likelihood = alone.scores.log_likelihood()
        if len(trial) == 2:
            likelihood -= max(_needed(step, k, found) for k in trial)
        if best is None or likelihood > best[0]:
            best = (likelihood, names, alone, own)
    assert best is not None
    likelihood, names, alone, own = best
    left = [one for one in _leading_variants(step) if one.effect not in names]
    final = explored(
        further_equations(alone.fit, [*left, *further], folds, own),
        left,
        further=further,
        seed=seed,
    )
    return names, final.scores.log_likelihood(), final, own


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


def further_equations(
    fitted: Fit, found: Sequence[Candidate], folds: Mapping[tuple[int, int], int], problem: Problem
) -> Fit:
    """Return a fit with the equations of more candidates at its solution."""
    return fit(
        problem,
        fitted.camera,
        fold_of=folds,
        further=[one.block for one in found],
        views=fitted.forward.views,
        warm=fitted,
        iterations=0,
    )


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


def effect_size(fitted: Fit, names: Sequence[str], start: Camera) -> float:
    """Return how far effects move distances [m], or relative amplitudes times 0.1 m.

    RMS over the 5 % of pixel values that they move most, after the fit of all else.
    """
    parts = []
    for one in fitted.forward.predictions():
        total: Any = 0.0
        for name in names:
            total = total + contribution(one, name, start)
        parts.append(np.abs(np.broadcast_to(total, one.used.shape)[one.used]))
    values = np.concatenate(parts) if parts else np.zeros(1)
    if not values.size:
        return 0.0
    top = values[values >= np.quantile(values, 0.95)]
    return float(np.sqrt(np.mean(top**2)))


def contribution(prediction: Prediction, name: str, start: Camera) -> Array:
    """Return what an effect of the camera does to the measured distance [m] of a station, (H, W).

    For effects on the light, by leaving it out; where it only changes amplitudes, their relative change
    times 0.1 m; for the camera geometry, by the optics of ``start``.
    """
    camera = prediction.context.camera
    if name in OF_SURFACES:
        curves = prediction.light_curves
        if curves is None:
            return np.zeros(prediction.used.shape)
        return np.asarray(0.1 * np.log(curves.surfaces(prediction.view.geometry)))
    if name in GEOMETRY:
        return _geometry_contribution(prediction, name, start)
    effect = camera.effects[name]
    if hasattr(effect, "term"):
        value = effect.term(prediction.delivered.distance, prediction.amplitude, prediction.context)
        return np.broadcast_to(np.asarray(value, float), prediction.used.shape)
    if name == "amplitude_nonlinearity":
        return np.asarray(0.1 * effect.compression * prediction.amplitude)
    before = prediction.before_effect(name)
    after = effect.simulate(before, prediction.context)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(before.amplitude > 0, np.log(after.amplitude / before.amplitude), 0.0)
    by_distance = np.nan_to_num(after.distance - before.distance)
    moved, _ = prediction.reading_change(by_distance, relative)
    if name == "emission_pattern":
        return np.asarray(np.nan_to_num(np.maximum(np.abs(moved), 0.1 * np.abs(relative))))
    return np.asarray(np.nan_to_num(moved))


def _geometry_contribution(prediction: Prediction, name: str, start: Camera) -> Array:
    block = optics_block(prediction.context.camera, name)
    before, after = flatten(start.optics), flatten(prediction.context.camera.optics)
    total = np.zeros(prediction.used.shape)
    for one, (column, _) in zip(block.regressors, block.columns(prediction), strict=True):
        path = one.label.removeprefix("optics.")
        total = total + (after[path] - before[path]) * column
    return total
