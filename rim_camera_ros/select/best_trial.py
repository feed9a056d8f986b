"""Non-linear fits of the candidates of one step of a search, compared with each other: which is the best."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import Physics, vocabulary
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.compare import Trial, as_good, near_rivals, what_it_became
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.subsample import dominated, subsample_of
from rim_camera_ros.select.trials import Workers, fitted_trials, onwards, silent, trial_fit

#: Fits that are tried for one effect.
_MOST_TRIALS = 3
#: Share of the gain of the best candidate within which others may be as good.
_NEARLY = 0.15


#: The last trials by choice, and the step at which they were fitted.
Known = dict[tuple[int, ...], tuple[Exploration, Trial]]


@dataclass(frozen=True)
class Trials:
    """The fits of candidates of a ``step`` of a search, each jointly with the effects found before it.

    ``camera`` is that before the search. ``failed`` effects are no rivals; ``is_first`` says that no effect
    was found before; ``with_edges`` that pixels beside edges take part. ``workers`` fit candidates in
    parallel. ``known`` trials of the same step are not fitted again where another candidate leads.
    """

    problem: Problem
    camera: Camera
    step: Exploration
    folds: Mapping[tuple[int, int], int]
    seed: int = 0
    failed: Set[str] = frozenset()
    is_first: bool = True
    with_edges: bool = False
    say: Callable[[str], None] = silent
    workers: Workers = map
    known: Known = field(default_factory=dict)

    def best(self, numbers: tuple[int, ...], leader: int) -> tuple[Trial, list[str]]:
        """Fit candidates and their near rivals non-linearly; return the best, and effects that are as good.

        A pair must exceed its leader alone by the threshold of a further effect: in a linearised fit, a
        single effect that changes the light strongly looks worse than it is.
        """
        rivals = near_rivals(self.step, numbers, leader, self.failed)
        choices, starts = self._ahead([numbers, *rivals][:_MOST_TRIALS])
        trials: dict[tuple[int, ...], Trial] = {}
        became: dict[tuple[int, ...], tuple[int, ...] | None] = {}
        while len(trials) < len(choices):
            new = [choice for choice in choices if choice not in trials]
            trials |= self._known_of(new)
            trials |= self.fitted([choice for choice in new if choice not in trials], starts=starts)
            for choice in new:
                other = what_it_became(trials[choice].fitted, choice, self.step, self.camera)
                became[choice] = other
                if other is not None and other not in choices:
                    choices.append(other)
        stay = {choice: trial for choice, trial in trials.items() if became[choice] is None}
        alone = {trial.effects[0]: trial for choice, trial in stay.items() if len(choice) == 1}
        best = max(stay.values(), key=lambda trial: trial.likelihood)
        self.known.clear()
        self.known.update({choice: (self.step, trial) for choice, trial in trials.items()})
        return best, as_good(alone, best)

    def _known_of(self, choices: Sequence[tuple[int, ...]]) -> dict[tuple[int, ...], Trial]:
        found = {choice: self.known[choice] for choice in choices if choice in self.known}
        return {choice: trial for choice, (step, trial) in found.items() if step is self.step}

    def _ahead(
        self, choices: Sequence[tuple[int, ...]]
    ) -> tuple[list[tuple[int, ...]], dict[tuple[int, ...], Camera]]:
        """Fit choices to a few poses where there are many values, before they are fitted to all.

        Returns the choices that may still be the best, and the cameras at which their fits to all poses
        begin. Effects that move rays and effects that follow time are not fitted to a few poses.
        """
        few = subsample_of(self.problem, seed=self.seed)
        if few is None:
            return list(choices), {}
        able = [
            choice
            for choice in choices
            if not any(one.moves_rays or one.in_time for one in map(self._physics, choice))
        ]
        trials = self.fitted(able, few=few)
        lost: set[tuple[int, ...]] = set()
        if all(len(choice) == 1 for choice in choices):
            # given effects found before, the result names those that are nearly as good as the best
            joint = [self.step.joint(*choice) for choice in able]
            gain = 0.0 if self.is_first else max(joint, default=0.0)
            least = _NEARLY * gain * len(few) / len(self.problem.dataset.stations)
            by_fold = {choice: trial.fitted.scores.log_likelihoods() for choice, trial in trials.items()}
            lost = dominated(by_fold, least=least)
        # such fits cost little: the nearer they are to convergence, the fewer steps remain with all poses
        left = [choice for choice in able if choice not in lost]
        further = [onwards(trials[choice], self.folds, self.seed) for choice in left]
        ends = fitted_trials(further, self.workers, self.say, to="a few poses")
        starts = {choice: end.fit.camera for choice, end in zip(left, ends, strict=True)}
        return [choice for choice in choices if choice not in lost], starts

    def fitted(
        self,
        choices: Sequence[tuple[int, ...]],
        *,
        few: Sequence[int] | None = None,
        starts: Mapping[tuple[int, ...], Camera] | None = None,
    ) -> dict[tuple[int, ...], Trial]:
        """Fit candidates, each by itself."""
        requests = [
            trial_fit(
                self.problem,
                self.step,
                choice,
                self.folds,
                self.seed,
                few,
                (starts or {}).get(choice),
                with_edges=self.with_edges,
            )
            for choice in choices
        ]
        result = {}
        poses = "all poses" if few is None else "a few poses"
        fits = fitted_trials(requests, self.workers, self.say, to=poses)
        for choice, request, fitted in zip(choices, requests, fits, strict=True):
            likelihood = fitted.scores.log_likelihood()
            if len(choice) == 2:
                likelihood -= self.step.threshold_of(choice)
            solved = replace(request.problem, response=fitted.fit.response)
            result[choice] = Trial([*request.effects], solved, fitted, likelihood)
        return result

    def _physics(self, number: int) -> type[Physics]:
        return vocabulary()[self.step.candidates[number].effect]
