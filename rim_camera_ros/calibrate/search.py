"""Forward search: which effects the recordings ask for, beyond those of the camera file.

The leaders of an exploration are fitted non-linearly in the full forward chain, and the best joins the
camera; then everything is looked at anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from rim_camera_ros.calibrate.candidate import Candidate, Facts
from rim_camera_ros.calibrate.elsewhere import quiet_pixels, shows_elsewhere
from rim_camera_ros.calibrate.exploration import Exploration, explore, explored, further_equations
from rim_camera_ros.calibrate.forms import form_blocks
from rim_camera_ros.calibrate.gauss_newton import keeps_amplitude_error
from rim_camera_ros.calibrate.leaders import (
    NOT_ELSEWHERE,
    NOT_IN_TIME,
    ONCE_FITTED,
    leaders,
    leading_variants,
    near_rivals,
    refused,
    rivals,
    smooth_says_more,
    what_it_became,
)
from rim_camera_ros.calibrate.library import GEOMETRY, OF_SURFACES, candidates
from rim_camera_ros.calibrate.needs import OF_TIME, Found, least_size, needed, own_covariates
from rim_camera_ros.calibrate.outcome import Result, Trial, as_good
from rim_camera_ros.calibrate.pixels import more_pixels
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.calibrate.selection import folds_of
from rim_camera_ros.calibrate.shuffled_times import follows_time
from rim_camera_ros.calibrate.sizes import effect_size
from rim_camera_ros.calibrate.stations import level_of
from rim_camera_ros.calibrate.views import Views
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects

MOST_EFFECTS = 4
#: Leaders that may prove wrong when they are fitted, until the search ends.
_MOST_FAILURES = 2
#: Fits that are tried for one effect.
_MOST_TRIALS = 3
#: Iterations of fits that add an effect, and shares of the sigmas at which they end.
_ITERATIONS = 12
_TOLERANCE = 0.15
#: Gain of a fit over its linear forecast above which it is looked at what gained it.
_BY_ITSELF = 2.0
#: Share of what mixed pixels beside edges must gain that they gain before the other parameters are fitted.
_AT_FIRST_SIGHT = 0.5


def search(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    *,
    effects: Sequence[str] | None = None,
    seed: int = 0,
    most: int = MOST_EFFECTS,
    further: Sequence[Candidate] = (),
    views: Views | None = None,
    progress: Callable[[str], None] | None = None,
) -> Result:
    """Add effects to a camera one after the other as long as held-out poses ask for them.

    ``effects`` restricts the candidates. ``further`` candidates are scored with the others but never join
    (smooth terms); where one of them explains far more than any effects, none joins. ``views`` are those of
    the same scene by the same rays, if there are any.
    """
    say = progress if progress is not None else _silent
    folds = folds_of(problem.dataset)
    if "amplitude_nonlinearity" in camera.effects and problem.gain:
        problem = replace(problem, response=level_of(problem.dataset))
    pool = candidates(camera, facts, effects=effects)
    say(f"baseline and {len(pool)} candidates")
    first = explore(problem, camera, pool, folds, further=further, views=views, seed=seed)
    start = first.scores.log_likelihood()
    state = Search(
        problem=replace(problem, masks=first.fit.forward.pixels_used()),
        camera=camera,
        explorations=[first],
        folds=folds,
        further=further,
        pool=pool,
        variants=leading_variants(first),
        seed=seed,
        say=say,
    )
    if smooth_says_more(first):
        most = 0
    state.add(most)
    if len(state.found) > 1:
        say("whether each is still needed")
        state.drop_needless()
    left_out = refused(state.step, state.found, state.failed)
    # masks that somebody chose may leave out pixels beside edges for good
    may_look = len(state.found) < most and problem.masks is None
    beside_edges = state.look_beside_edges() if may_look else None
    names = {one.effect for one in state.found}
    return Result(
        camera=state.step.fit.camera,
        found=state.found,
        explorations=state.explorations,
        log_likelihood=state.step.scores.log_likelihood(),
        start_log_likelihood=start,
        problem=state.problem,
        folds=folds,
        refused=[one for one in left_out if one.effect not in names],
        beside_edges=beside_edges,
    )


def _silent(text: str) -> None:
    return None


@dataclass
class Search:
    """What was found so far, and what the next steps need to know.

    ``explorations`` begin with that of the camera file; each effect found adds one. ``pool`` are all
    candidates, ``variants`` those worth their columns at first. ``failed`` are leaders that proved wrong
    since then, and why; ``settled`` the numbers of effects found at which the fit was repeated.
    """

    problem: Problem
    camera: Camera
    explorations: list[Exploration]
    folds: Mapping[tuple[int, int], int]
    further: Sequence[Candidate] = ()
    pool: Sequence[Candidate] = ()
    variants: Sequence[Candidate] = ()
    seed: int = 0
    say: Callable[[str], None] = _silent
    found: list[Found] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    settled: set[int] = field(default_factory=set)

    @property
    def step(self) -> Exploration:
        """The last exploration: what the effects found leave."""
        return self.explorations[-1]

    def add(self, most: int) -> None:
        """Add effects, ``most`` in all, until nothing gains enough or too many leaders proved wrong."""
        while len(self.found) < most and len(self.failed) <= _MOST_FAILURES:
            chosen = leaders(self.step, self.found, self.failed.keys())
            if chosen is None:
                return
            numbers, leader = chosen
            local = {self._effect(k) for k in numbers if not self._shows_elsewhere(k)}
            if local:
                self.failed |= dict.fromkeys(local, NOT_ELSEWHERE)
            else:
                self._try(numbers, leader)

    def drop_needless(self) -> None:
        """Drop effects that gain too little beside those that joined after them.

        An effect that stood in for others, found first, is needless once they are there. The last exploration
        is replaced by one without them.
        """
        for one in list(self.found[:-1]):
            if one.effect not in self.step.fit.camera.effects or len(self.found) < 2:
                continue
            others = [other for other in self.found if other is not one]
            left = {name: e for name, e in self.step.fit.camera.effects.items() if name != one.effect}
            without = self._fitted(self.problem, with_effects(self.step.fit.camera, left), self.step)
            before = self.explorations[one.step]
            gain = self.step.scores.log_likelihood() - without.scores.log_likelihood()
            if gain > needed(before, before.best()[one.effect], others):
                continue
            self.found.remove(one)
            self._replace_step(without.fit, before)
            self._judge_first_anew()

    def _judge_first_anew(self) -> None:
        """Judge what became the first effect by what the camera file alone leaves."""
        first, start = self.found[0], self.explorations[0]
        by_others = sum(one.gain for one in self.found[1:])
        gain = self.step.scores.log_likelihood() - start.scores.log_likelihood() - by_others
        number = start.best().get(first.effect)
        if number is None or first.step == 0:
            return
        gains, ties = rivals(start, first.effect, needed(start, number, []))
        self.found[0] = Found(first.effect, max(gain, first.gain), gains, ties, step=0)

    def look_beside_edges(self) -> int | None:
        """Look for mixed pixels in pixels beside edges, which are left out while other effects are sought.

        There a footprint no wider than a pixel shows, and everything else shows no better. Returns the number
        of the first exploration of those pixels, None where mixed pixels are not found in them.
        """
        own = [one for one in self.variants if one.effect == "mixed_pixels"]
        fitted = self.step.fit
        if not own or "mixed_pixels" in fitted.camera.effects:
            return None
        masks = fitted.forward.pixels_near_edges()
        if self.problem.masks is not None and not more_pixels(masks, self.problem.masks):
            return None
        self.say("pixels beside edges")
        problem = replace(self.problem, masks=masks)
        for iterations, replicates, share in ((0, 0, _AT_FIRST_SIGHT), (_ITERATIONS, 200, 1.0)):
            beside = self._fitted(problem, fitted.camera, self.step, own, replicates, iterations)
            number = beside.best()["mixed_pixels"]
            if beside.gains[number] <= share * needed(beside, number, self.found):
                return None
        names = [one.effect for one in self.found]
        step = self._explored(beside.fit, names, self.step, problem)
        kept, self.explorations = self.explorations, [*self.explorations, step]
        away, self.problem = self.problem, problem
        count = len(self.found)
        number = step.best()["mixed_pixels"]
        self._try((number,), number)
        if len(self.found) > count:
            kept[-1].forget()
            return len(kept)
        self.explorations, self.problem = kept, away
        return None

    def _effect(self, number: int) -> str:
        return self.step.candidates[number].effect

    def _shows_elsewhere(self, number: int) -> bool:
        names = [one.effect for one in self.found]
        return shows_elsewhere(self.problem, self.step, number, names, self.folds)

    def _needed(self, numbers: Sequence[int]) -> float:
        return max(needed(self.step, k, self.found) for k in numbers)

    def _try(self, numbers: tuple[int, ...], leader: int) -> None:
        """Fit candidates and what rivals them; the best joins, where it gains and moves enough."""
        trial, close = self._best_trial(numbers, leader)
        fitted = trial.fitted
        need = self._needed(self.step.best_of(trial.effects))
        gain = fitted.scores.log_likelihood() - self.step.scores.log_likelihood()
        again = self._without(trial.effects, fitted, gain)
        if again is not None:
            more = again.scores.log_likelihood() - self.step.scores.log_likelihood()
            gain -= max(more, 0.0)
            if gain <= need < more and len(self.found) not in self.settled:
                # the fit before had not come to its end: look at what is left of it
                self.settled.add(len(self.found))
                self._replace_step(again.fit, self.step)
                return
        why = self._why_not(trial, gain, need)
        if why is not None:
            # what looked like it is something else: perhaps the next in line
            self.failed |= {self._effect(k): why for k in numbers}
            return
        self.failed.clear()
        for name in trial.effects:
            gains, ties = rivals(self.step, name, need)
            # of a first one, what joins it decides
            ties += [other for other in close if self.found and other not in ties]
            self.found.append(Found(name, gain, gains, ties, step=len(self.explorations) - 1))
        self.problem = trial.problem
        if not fitted.fit.converged or keeps_amplitude_error(self.step.fit.camera, fitted.fit.camera):
            # or the next effect, whose fit goes on or estimates it anew, would gain what this one did
            fitted = self._fitted(self.problem, fitted.fit.camera, fitted)
        final = self._explored(fitted.fit, [one.effect for one in self.found], self.step, self.problem)
        self.step.forget()
        self.explorations.append(final)

    def _why_not(self, trial: Trial, gain: float, need: float) -> str | None:
        after = trial.fitted
        size = effect_size(after.fit, trial.effects, self.camera)
        if gain <= need or size < least_size(after, trial.effects, self.found):
            return ONCE_FITTED
        drifts = [name for name in trial.effects if name in OF_TIME] if self.found else []
        return None if all(self._follows_time(trial, name) for name in drifts) else NOT_IN_TIME

    def _follows_time(self, trial: Trial, name: str) -> bool:
        fitted = trial.fitted.fit
        own = [one for one in self.pool if one.effect == name]
        names = [one.effect for one in self.found]
        # a form that is not quite true leaves what changes with its own covariates, and these with time
        effects = [fitted.camera.effects[one] for one in names if one in fitted.camera.effects]
        covariates = {covariate for one in effects for covariate in own_covariates(one)}
        curves = [one.block for one in self.further if one.variant in covariates]
        beside = [*curves, *form_blocks(fitted, names, self.variants)]
        masks = quiet_pixels(fitted, [one.name for one in effects])
        problem = trial.problem if masks is None else replace(trial.problem, masks=masks)
        return follows_time(fitted, name, own, self.folds, problem, beside=beside, seed=self.seed)

    def _best_trial(self, numbers: tuple[int, ...], leader: int) -> tuple[Trial, list[str]]:
        """Fit candidates and their near rivals non-linearly; return the best, and effects that are as good.

        A pair must beat the leader alone by what a further effect must gain: linearly, one that bends the
        light much looks worse than it is.
        """
        beside = near_rivals(self.step, numbers, leader, self.found, self.failed.keys())
        choices = [numbers, *beside][:_MOST_TRIALS]
        best: Trial | None = None
        alone: dict[str, float] = {}
        for choice in choices:
            trial = self._trial(choice)
            other = what_it_became(trial.fitted, choice, self.step, self.found, self.camera)
            if other is not None:
                if other not in choices:
                    choices.append(other)
                continue
            if len(choice) == 1:
                alone[trial.effects[0]] = trial.likelihood
            if best is None or trial.likelihood > best.likelihood:
                best = trial
        assert best is not None
        return best, as_good(alone, best, self.step.scores.log_likelihood())

    def _trial(self, choice: tuple[int, ...]) -> Trial:
        step = self.step
        names = [self._effect(k) for k in choice]
        self.say("fitting " + " and ".join(names))
        geometry = tuple(dict.fromkeys([*self.problem.geometry, *(n for n in names if n in GEOMETRY)]))
        reflectance = self.problem.reflectance or not OF_SURFACES.isdisjoint(names)
        problem = replace(self.problem, geometry=geometry, reflectance=reflectance)
        # first by itself: what loses need not be explored; rays from where they are, as a linear guess of
        # them may put a texture's edges on other pixels
        start = step.camera_with([k for k in choice if self._effect(k) not in GEOMETRY])
        fitted = self._fitted(problem, start, step)
        if "amplitude_nonlinearity" in names:
            # its one parameter first: together with a free response it would not find the way
            problem = replace(problem, response=level_of(problem.dataset))
            views, camera = step.fit.forward.views, fitted.fit.camera
            fitted = explore(problem, camera, [], self.folds, views=views, warm=fitted.fit, replicates=0)
        likelihood = fitted.scores.log_likelihood()
        if len(choice) == 2:
            likelihood -= self._needed(choice)
        return Trial(names, problem, fitted, likelihood)

    def _without(self, effects: Sequence[str], after: Exploration, gain: float) -> Exploration | None:
        """Return the fit without further effects from where that with them ended, where it gained much.

        Perhaps it is the effects found before them that gained, whose fit had not come to its end.
        """
        step = self.step
        if not self.found or gain <= _BY_ITSELF * step.joint(*step.best_of(effects)):
            return None
        left = {name: e for name, e in after.fit.camera.effects.items() if name not in effects}
        return self._fitted(self.problem, with_effects(step.fit.camera, left), after)

    def _fitted(
        self,
        problem: Problem,
        camera: Camera,
        step: Exploration,
        wanted: Sequence[Candidate] = (),
        replicates: int = 0,
        iterations: int = _ITERATIONS,
    ) -> Exploration:
        """Return the fit of a camera that begins at the nuisances of a step, and scores candidates."""
        return explore(
            problem,
            camera,
            wanted,
            self.folds,
            views=step.fit.forward.views,
            warm=step.fit,
            seed=self.seed,
            replicates=replicates,
            iterations=iterations,
            tolerance=_TOLERANCE,
        )

    def _replace_step(self, fitted: Fit, before: Exploration) -> None:
        """Replace the last exploration by that of another fit, with the candidates of one before."""
        names = [one.effect for one in self.found]
        self.step.forget()
        self.explorations[-1] = self._explored(fitted, names, before, self.problem)

    def _explored(
        self, fitted: Fit, present: Sequence[str], before: Exploration, problem: Problem
    ) -> Exploration:
        """Explore what a fit leaves, beside changes of the forms of the effects that were found.

        Candidates are the leading ones of an exploration before, but those present.
        """
        left = [one for one in leading_variants(before) if one.effect not in present]
        forms = form_blocks(fitted, present, self.variants)
        blocks = [*(one.block for one in (*left, *self.further)), *forms]
        return explored(
            further_equations(fitted, blocks, self.folds, problem),
            left,
            further=self.further,
            forms=forms,
            seed=self.seed,
        )
