"""The steps of a forward search: leaders are fitted, the best one enters, needless effects are dropped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import lean_camera, with_effects
from rim_camera_ros.effects import vocabulary
from rim_camera_ros.effects.candidate import Candidate
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.problem import Fit, Problem, clean_by
from rim_camera_ros.select.best_trial import Known, Trials
from rim_camera_ros.select.candidates import form_blocks
from rim_camera_ros.select.compare import (
    LEAST_SIZE,
    NOT_IN_ALL_POSES,
    NOT_IN_QUIET_PIXELS,
    NOT_IN_TIME,
    ONCE_FITTED,
    SAME_PHYSICS,
    Found,
    Trial,
    discrepancy,
    entry_gain,
    is_form_of_another,
    leaders,
    leading_variants,
    tied,
)
from rim_camera_ros.select.confounding import follows_time_in_quiet_pixels, shows_in_quiet_pixels
from rim_camera_ros.select.edge_pixels import Look, promising, refined, sharper, where_clean, with_edges
from rim_camera_ros.select.effect_sizes import effect_size
from rim_camera_ros.select.exploration import Exploration, explore, explored, further_equations
from rim_camera_ros.select.trials import (
    ITERATIONS,
    TOLERANCE,
    Workers,
    silent,
    without_effect,
)

#: Leaders that may be refused once they are fitted, before the search ends.
_MOST_FAILURES = 2
#: Gain of a fit over its linear forecast above which its cause is examined.
_BY_ITSELF = 2.0


@dataclass
class Search:
    """The state of a search: what was found so far, and what the next steps need.

    ``explorations`` begin with that of the camera file; each effect found adds one. ``pool`` are all
    candidates, ``variants`` the leading ones at first. ``failed`` are leaders that were refused since the
    last effect was found, with the reason; ``settled`` the numbers of effects found at which the fit was
    repeated. ``may_look`` allows pixels beside edges; explorations from number ``beside_edges`` on include
    them. With ``may_narrow`` a search ends where an effect moves rays; ``narrowed`` is then the problem with
    the pixels that are clean by both cameras, by which to search again. ``curves`` are those ``further``
    candidates that entered as discrepancies of effects found. ``workers`` and ``known`` as in `Trials`.
    """

    problem: Problem
    camera: Camera
    explorations: list[Exploration]
    folds: Mapping[tuple[int, int], int]
    further: Sequence[Candidate] = ()
    pool: Sequence[Candidate] = ()
    variants: Sequence[Candidate] = ()
    seed: int = 0
    say: Callable[[str], None] = silent
    found: list[Found] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    settled: set[int] = field(default_factory=set)
    may_look: bool = True
    may_narrow: bool = False
    narrowed: Problem | None = None
    beside_edges: int | None = None
    curves: list[Candidate] = field(default_factory=list)
    workers: Workers = map
    known: Known = field(default_factory=dict)

    @property
    def step(self) -> Exploration:
        """The last exploration, conditional on the effects found."""
        return self.explorations[-1]

    @property
    def at_bounds(self) -> frozenset[str]:
        """The effects found that have a parameter at a bound which the data would exceed."""
        fitted = self.step.fit
        labels = list(fitted.parameters)
        owners = {labels[i].split(".")[1] for i in fitted.at_bounds}
        return frozenset(finding.effect for finding in self.found if finding.effect in owners)

    def add(self, most: int) -> None:
        """Add effects, ``most`` in all, until nothing gains enough or too many leaders were refused."""
        while len(self.found) < most and len(self.failed) <= _MOST_FAILURES and self.narrowed is None:
            curve = discrepancy(self.step, self.found, self.failed.keys())
            if curve is not None:
                self._enter(self.step.candidates[curve])
                continue
            chosen = leaders(self.step, self.failed.keys())
            if chosen is None:
                return
            numbers, leader = chosen
            local = {self._effect(k) for k in numbers if not self._shows_in_quiet_pixels(k)}
            if local:
                self.failed |= dict.fromkeys(local, NOT_IN_QUIET_PIXELS)
            else:
                self._try(numbers, leader)
                if any(self.failed.get(name) == ONCE_FITTED for name in self.at_edges):
                    # perhaps of another form, which only the pixels beside edges determine
                    self.look_beside_edges()

    def drop_needless(self) -> None:
        """Drop effects that gain too little conditional on those found after them.

        An effect that was found first in place of others is needless once these are found, and one that
        ended at a bound may be none. The last exploration is replaced by one without them.
        """
        at_bounds = self.at_bounds
        ahead = {finding.effect for finding in self.found[:-1]}
        for name in [finding.effect for finding in self.found if finding.effect in ahead | at_bounds]:
            # the finding that has become the first is judged anew: its gain was relative to others
            finding = next(each for each in self.found if each.effect == name)
            left = without_effect(name, self.problem, self.step.fit.camera, self.camera)
            if left is None or (len(self.found) < 2 and name not in at_bounds):
                continue
            problem, camera = left
            alike = replace(problem, amplitude_error=self.step.fit.forward.amplitude_model.tau)
            without = self._fitted(alike, camera, self.step)
            before = self.explorations[finding.step]
            own = Trial([name], self.problem, self.step, 0.0)
            compared = where_clean(own, without, problem, self.folds)
            is_alone = len(self.found) < 2
            if self._gain(*compared) > (
                finding.threshold if is_alone else self._entry(finding.threshold, *compared)
            ):
                continue
            if is_alone:
                self.failed[name] = ONCE_FITTED
            self.problem = problem
            self.found.remove(finding)
            self._replace_step(without.fit, before)
            if self.found:
                self._judge_first_anew()

    def _judge_first_anew(self) -> None:
        """Judge the effect that has become the first by the exploration of the camera file alone."""
        first, start = self.found[0], self.explorations[0]
        by_others = sum(finding.gain for finding in self.found[1:])
        gain = self.step.scores.log_likelihood() - start.scores.log_likelihood() - by_others
        number = start.best().get(first.effect)
        if number is None or first.step == 0:
            return
        threshold = float(start.thresholds[number])
        ties = tied(start, first.effect, threshold)
        self.found[0] = Found(first.effect, max(gain, first.gain), ties, step=0, threshold=threshold)

    def look_beside_edges(self) -> None:
        """Look for effects at edges in the pixels beside them, which are excluded in the search for others.

        A footprint no wider than a pixel shows only there; other effects show no better there.
        """
        own = [variant for variant in self.variants if variant.effect in self.at_edges]
        if not self.may_look or self.beside_edges is not None or not own:
            return
        problem = with_edges(self.problem, self.step.fit)
        if problem is self.problem:
            return
        self.say("pixels beside edges")
        at_edges = [effect for effect in self.step.fit.camera.effects.values() if effect.at_edges]
        if at_edges:
            if any(effect.finest() != effect for effect in at_edges):
                self._sharpen(problem)
            return
        # the residuals of one form look like the other
        for with_footprints in (True, False):
            look = promising(problem, self.step, own, self._fitted, footprint=with_footprints)
            if look is None or self._joins(look):
                return

    def _joins(self, look: Look) -> bool:
        """Try the leading effect at edges in the pixels beside them; return whether it entered."""
        names = [finding.effect for finding in self.found]
        step = self._explored(look.fitted.fit, names, self.step, look.problem, mixed=look.variants)
        kept, self.explorations = self.explorations, [*self.explorations, step]
        away, self.problem = self.problem, look.problem
        number = next(k for name, k in step.best().items() if name in self.at_edges)
        self._try((number,), number)
        if len(self.found) > len(names):
            kept[-1].forget()
            self.beside_edges = len(kept)
            return True
        self.explorations, self.problem = kept, away
        return False

    def _sharpen(self, problem: Problem) -> None:
        """Replace a blur that was found by a footprint, where this fits pixels beside edges better."""
        fits = sharper(problem, self.step, self._fitted)
        if fits is None:
            return
        blur, footprint = fits
        names = [finding.effect for finding in self.found]
        sharp = self._explored(footprint.fit, names, self.step, problem)
        for exploration in (self.step, blur):
            exploration.forget()
        self.beside_edges = len(self.explorations)
        self.explorations += [blur, sharp]
        self.problem = problem

    @cached_property
    def at_edges(self) -> frozenset[str]:
        """The names of effects that act at edges."""
        return frozenset(name for name, effect in vocabulary().items() if effect.at_edges)

    def _effect(self, number: int) -> str:
        return self.step.candidates[number].effect

    def _shows_in_quiet_pixels(self, number: int) -> bool:
        names = [finding.effect for finding in self.found]
        return shows_in_quiet_pixels(self.problem, self.step, number, names, self.folds)

    def _gain(self, after: Exploration, before: Exploration) -> float:
        return after.scores.log_likelihood() - before.scores.log_likelihood()

    def _entry(self, threshold: float, after: Exploration, before: Exploration) -> float:
        """Return the entry threshold [nats]; conditional on others, also over the poses' disagreement."""
        if not self.found:
            return threshold
        return entry_gain(after.scores.log_likelihoods(), before.scores.log_likelihoods(), threshold)

    def _enter(self, curve: Candidate) -> None:
        """Score all that follows conditional on a curve of a covariate of an effect found."""
        self.say(f"another form of what is found, over {curve.variant}")
        self.curves.append(curve)
        self._replace_step(self.step.fit, self.step)

    def _try(self, numbers: tuple[int, ...], leader: int) -> None:
        """Fit candidates and their rivals; the best enters where it gains and moves distances enough."""
        trial, close = self._trials().best(numbers, leader)
        fitted = trial.fitted
        threshold = self.step.threshold_of(self.step.best_of(trial.effects))
        compared = where_clean(trial, self.step, self.problem, self.folds)
        need = self._entry(threshold, *compared)
        gain = self._gain(*compared)
        again = self._without(trial.effects, fitted, gain)
        if again is not None:
            more = self._gain(again, self.step)
            gain -= max(more, 0.0)
            if gain <= need < more and len(self.found) not in self.settled:
                # the fit before had not converged: explore it again
                self.settled.add(len(self.found))
                self._replace_step(again.fit, self.step)
                return
        why = self._why_not(trial, gain, threshold, need)
        if why is not None:
            # the residuals have another cause: perhaps the next in line
            self.failed |= {self._effect(k): why for k in numbers}
            return
        if self.may_narrow and any(vocabulary()[name].moves_rays for name in trial.effects):
            fit = fitted.fit
            self.narrowed = clean_by(fit.camera, self.problem, fit.scene, views=fit.forward.views)
            return
        self.failed.clear()
        self.known.clear()
        for name in trial.effects:
            ties = tied(self.step, name, threshold)
            # ties of a first effect are decided by the effects that enter after it
            ties += [other for other in close if self.found and other not in ties]
            own_threshold = float(self.step.thresholds[self.step.best()[name]])
            joined = Found(name, gain, ties, step=len(self.explorations) - 1, threshold=own_threshold)
            self.found.append(joined)
        self.problem = trial.problem
        # otherwise the next effect's fit, which goes on and estimates amplitude errors anew, gained that part
        fitted = self._fitted(self.problem, lean_camera(fitted.fit.camera), fitted)
        fitted = refined(fitted, trial.effects, self.problem, self._fitted)
        # the largest arrays of a search: not twice at once
        self.step.forget()
        final = self._explored(
            fitted.fit, [finding.effect for finding in self.found], self.step, self.problem
        )
        self.explorations.append(final)

    def _why_not(self, trial: Trial, gain: float, threshold: float, need: float) -> str | None:
        if gain <= threshold or effect_size(trial.fitted.fit, trial.effects, self.camera) < LEAST_SIZE:
            return ONCE_FITTED
        if gain <= need:
            return NOT_IN_ALL_POSES
        if is_form_of_another(trial, [finding.effect for finding in self.found]):
            return SAME_PHYSICS
        drifts = [name for name in trial.effects if vocabulary()[name].in_time] if self.found else []
        return None if all(self._follows_time(trial, name) for name in drifts) else NOT_IN_TIME

    def _follows_time(self, trial: Trial, name: str) -> bool:
        return follows_time_in_quiet_pixels(
            trial.fitted.fit,
            name,
            trial.problem,
            self.folds,
            found=[finding.effect for finding in self.found],
            drifts=[candidate for candidate in self.pool if candidate.effect == name],
            curves=self.further,
            variants=self.variants,
            seed=self.seed,
        )

    def _trials(self) -> Trials:
        return Trials(
            problem=self.problem,
            camera=self.camera,
            step=self.step,
            folds=self.folds,
            seed=self.seed,
            failed=self.failed.keys(),
            is_first=not self.found,
            with_edges=self.beside_edges is not None,
            say=self.say,
            workers=self.workers,
            known=self.known,
        )

    def _without(self, effects: Sequence[str], after: Exploration, gain: float) -> Exploration | None:
        """Return the fit without further effects from where that with them ended, where that gained much.

        Perhaps the gain is due to the effects found before, whose fit had not converged.
        """
        step = self.step
        if not self.found or gain <= _BY_ITSELF * step.joint(*step.best_of(effects)):
            return None
        left = {name: e for name, e in after.fit.camera.effects.items() if name not in effects}
        try:
            start = with_effects(step.fit.camera, left)
        except InputError:
            # the remaining effects are invalid with the rays of the camera without the further ones
            start = step.fit.camera
        alike = replace(self.problem, amplitude_error=after.fit.forward.amplitude_model.tau)
        return self._fitted(alike, start, after)

    def _fitted(
        self,
        problem: Problem,
        camera: Camera,
        step: Exploration,
        wanted: Sequence[Candidate] = (),
        replicates: int = 0,
        iterations: int = ITERATIONS,
        *,
        near: bool = False,
    ) -> Exploration:
        """Fit a camera, beginning at the nuisances of a step, and score candidates."""
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
            tolerance=TOLERANCE,
            near=near,
        )

    def _replace_step(self, fitted: Fit, before: Exploration) -> None:
        """Replace the last exploration by that of another fit, with the candidates of an earlier one."""
        names = [finding.effect for finding in self.found]
        self.step.forget()
        self.explorations[-1] = self._explored(fitted, names, before, self.problem)

    def _explored(
        self,
        fitted: Fit,
        present: Sequence[str],
        before: Exploration,
        problem: Problem,
        *,
        mixed: Sequence[Candidate] = (),
    ) -> Exploration:
        """Explore a fit conditional on changes of the forms of the effects that were found.

        Candidates are the leading ones of an earlier exploration, except those present.
        """
        left = [variant for variant in leading_variants(before) if variant.effect not in present]
        if mixed:
            left = [*(candidate for candidate in left if candidate.effect not in self.at_edges), *mixed]
        forms = form_blocks(fitted, present, self.variants)
        forms += [curve.block for curve in self.curves]
        further = [candidate for candidate in self.further if candidate not in self.curves]
        blocks = [*(candidate.block for candidate in (*left, *further)), *forms]
        return explored(
            further_equations(fitted, blocks, self.folds, problem),
            left,
            further=further,
            forms=forms,
            seed=self.seed,
        )
