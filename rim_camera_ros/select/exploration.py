"""One exploration: all candidates linearised at a fit and scored, alone and in pairs, against nulls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import in_order
from rim_camera_ros.effects.candidate import MANY_PIXELS, Block, Candidate
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.bounds import BEYOND_POSSIBLE
from rim_camera_ros.fit.design import is_linear
from rim_camera_ros.fit.linearised import TOLERANCE
from rim_camera_ros.fit.problem import Fit, Point, Problem, blocks_of
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.form_sizes import ConditionalOnForms
from rim_camera_ros.select.null_replicates import error_size, null_scores
from rim_camera_ros.select.thresholds import (
    WITHOUT_REPLICATES,
    least_threshold,
    rate_of_each,
    thresholds_at,
)

Array = NDArray[Any]


#: Least share of the strengths by a linear fit at which the fit of an effect may begin.
_LEAST_SHARE = 1e-3


@dataclass
class Exploration:
    """Scores of all candidates at one fit.

    ``gains`` [nats of held-out log likelihood] and ``thresholds`` are per candidate. A threshold comes from
    the candidate's gains in null replicates, in which no effect is missing and noise and errors are as
    stated; ``null_maxima`` is the greatest gain in each of them. The first ``named`` candidates are of the
    vocabulary, the others stand for unknown physics. ``conditional`` scores the named ones conditional on
    changes of the ``forms`` of effects found before them, where there are any.
    """

    fit: Fit
    candidates: Sequence[Candidate]
    scores: Scores
    spans: list[list[int]]
    gains: Array
    null_maxima: Array
    thresholds: Array
    named: int
    conditional: Scores
    forms: Sequence[Block] = ()

    @property
    def threshold(self) -> float:
        """Threshold in nats of the best named candidate."""
        leader = int(np.argmax(self.gains[: self.named])) if self.named else 0
        return float(self.thresholds[leader]) if self.thresholds.size else WITHOUT_REPLICATES

    def threshold_of(self, numbers: Sequence[int]) -> float:
        """Return the highest threshold of some candidates in nats."""
        return max(float(self.thresholds[k]) for k in numbers)

    @property
    def unexplained(self) -> float:
        """Excess of chi-square of held-out poses over its expected value, in nats; 0 at least."""
        chi_square, rows = self.scores.chi_square(held_out=True)
        return max(0.5 * (chi_square - rows), 0.0)

    def forget(self) -> None:
        """Free the sums per pixel, which only the last exploration still needs."""
        for fold in self.fit.equations.folds:
            # a view would keep them
            fold.pixel = fold.pixel[:, :0].copy()
            fold.gain = None if fold.gain is None else fold.gain[:, :0].copy()

    def recalled(self, problem: Problem, folds: Mapping[tuple[int, int], int]) -> Exploration:
        """Return the exploration with the sums per pixel of its parameters, again where they were freed."""
        folded = self.fit.equations.folds
        if all(fold.pixel.shape[1] for fold in folded):
            return self
        return replace(self, fit=further_equations(self.fit, [], folds, problem))

    def conditional_fit(self, problem: Problem, numbers: Sequence[int] = ()) -> Fit:
        """Return the fit conditional on changes of the ``forms``, and on some candidates.

        Its residuals and errors of poses are those that neither explains. The changes, and the changes of the
        parameters that go with them, are added to the predictions linearly.
        """
        fitted, forward = self.fit, copy(self.fit.forward)
        columns = [i for k in numbers for i in self.spans[k]]
        values = self.conditional.values(columns)
        errors, pattern = self.conditional.errors_and_offsets(columns)
        own = blocks_of(problem, fitted.camera, fitted.scene)
        stepped = [block for block in own if not is_linear(block.regressors[0].label)]
        changes = [*stepped, *self.forms, *(self.candidates[k].block for k in numbers)]
        forward.linear = [*forward.linear, *changes]
        return replace(
            fitted,
            forward=forward,
            pattern=pattern.reshape(fitted.pattern.shape) if problem.pattern else fitted.pattern,
            parameters=fitted.parameters
            | {parameter: values[parameter] for parameter in fitted.parameters if is_linear(parameter)},
            nuisances=fitted.nuisances | errors | values,
        )

    def best(self) -> dict[str, int]:
        """Return the best variant of each named effect by its name, the best effect first."""
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
        return float(self.conditional.gain([i for k in numbers for i in self.spans[k]]))

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
        """Return the fitted camera with candidates at the strengths by the linear fit.

        The strengths are halved until the camera is a valid one: a linear fit does not know the bounds of an
        effect. Raises `InputError` or `ValueError` where not even a thousandth of them is valid.
        """
        values = self.scores.values([i for k in numbers for i in self.spans[k]])
        share = 1.0
        while True:
            camera = self.fit.camera
            try:
                for k in numbers:
                    weaker = {label: share * value for label, value in values.items()}
                    camera = in_order(self.candidates[k].build(camera, weaker))
                return camera
            except (InputError, ValueError):
                share /= 2
                if share < _LEAST_SHARE:
                    raise


def explore(
    problem: Problem,
    camera: Camera,
    found: Sequence[Candidate],
    folds: Mapping[tuple[int, int], int],
    *,
    further: Sequence[Candidate] = (),
    views: Any = None,
    warm: Fit | Point | None = None,
    seed: int = 0,
    replicates: int = 200,
    iterations: int = 8,
    tolerance: float = TOLERANCE,
    near: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Exploration:
    """Fit the camera to ``tolerance`` of each sigma and score all candidates at the solution.

    The other parameters are those of `solver.fit`.
    """
    blocks: list[Block] = [candidate.block for candidate in (*found, *further)]
    fitted = fit(
        problem,
        camera,
        fold_of=folds,
        further=blocks,
        views=views,
        warm=warm,
        iterations=iterations,
        tolerance=tolerance,
        near=near,
        progress=progress,
    )
    return explored(fitted, found, further=further, seed=seed, replicates=replicates)


def explored(
    fitted: Fit,
    named: Sequence[Candidate],
    *,
    further: Sequence[Candidate] = (),
    forms: Sequence[Block] = (),
    seed: int = 0,
    replicates: int = 200,
) -> Exploration:
    """Score the candidates whose columns follow the parameters in a fit's equations.

    The last columns of the equations are ``forms``, changes of the forms of the camera's effects: the named
    candidates are scored conditional on them. Thresholds are not conditional on them.
    """
    count = len(fitted.parameters)
    found = [*named, *further]
    spans: list[list[int]] = []
    start = count
    for candidate in found:
        width = len(candidate.block.regressors)
        spans.append(list(range(start, start + width)))
        start += width
    held = fitted.at_bounds
    scores = Scores(fitted.equations, range(count), held=held)
    changes = range(start, start + sum(len(form.regressors) for form in forms))
    conditional = ConditionalOnForms(fitted.equations, range(count), changes, held=held) if forms else scores
    gains = np.array(
        [
            _gain(conditional if k < len(named) else scores, candidate, span)
            for k, (candidate, span) in enumerate(zip(found, spans, strict=True))
        ]
    )
    maxima = np.zeros(0)
    thresholds = np.full(len(found), WITHOUT_REPLICATES)
    if fitted.camera.sensor.width * fitted.camera.sensor.height > MANY_PIXELS:
        # limits the memory
        replicates = min(replicates, 60)
    if replicates and scores.trained and found:
        nulls = null_scores(scores, replicates=replicates, seed=seed, errors=fitted.nuisances)
        drawn = _gains_by_chance(nulls, spans)
        widths = [len(span) for span in spans]
        # where there are effects, terms that are not of the vocabulary do not count in the alarm rate
        family = len(named) or len(found)
        maxima = drawn[:family].max(axis=0)
        rate = rate_of_each(drawn[:family], widths[:family])
        thresholds = thresholds_at(rate, drawn, widths)
        names = [candidate.effect for candidate in named]
        thresholds[: len(named)] = _given_candidate(
            scores, names, spans, gains, thresholds[: len(named)], rate=rate, replicates=replicates, seed=seed
        )
    return Exploration(
        fitted, found, scores, spans, gains, maxima, thresholds, len(named), conditional, forms
    )


def _gains_by_chance(nulls: Scores, spans: Sequence[Sequence[int]]) -> Array:
    """Return the gains (C, R) of candidates in replicates."""
    base = nulls.held_out()
    return np.array([nulls.held_out(span) - base for span in spans])


def _given_candidate(
    scores: Scores,
    names: Sequence[str],
    spans: Sequence[Sequence[int]],
    gains: Array,
    thresholds: Array,
    *,
    rate: float,
    replicates: int,
    seed: int,
) -> Array:
    """Return the thresholds at a rate; that of the leading effect by errors of poses conditional on it.

    A missing effect inflates the estimated errors of poses, and replicates with inflated errors hide it. So
    the replicates draw from the errors of the model with the effect under test (permutation of residuals of
    the full model, ter Braak 1992), scaled up for the degrees of freedom that the effect takes.
    """
    held_back = [k for k in range(len(names)) if least_threshold(rate) < gains[k] <= thresholds[k]]
    equations = scores.equations
    whole = error_size(equations, scores.errors())
    if not held_back or whole <= 1.0:
        return thresholds
    leader = max(held_back, key=lambda k: float(gains[k]))
    errors = scores.errors(spans[leader])
    count = len({tuple(name.split(".", 2)[:2]) for name in errors})
    width = min(len(spans[leader]), count - 1)
    larger = {name: error * float(np.sqrt(count / (count - width))) for name, error in errors.items()}
    if error_size(equations, larger) >= whole:
        return thresholds
    nulls = null_scores(scores, replicates=replicates, seed=seed, errors=larger)
    result = thresholds.copy()
    own = [k for k, name in enumerate(names) if name == names[leader]]
    by_chance = _gains_by_chance(nulls, [spans[k] for k in own])
    result[own] = np.minimum(thresholds[own], thresholds_at(rate, by_chance, [len(spans[k]) for k in own]))
    return result


def further_equations(
    fitted: Fit, blocks: Sequence[Block], folds: Mapping[tuple[int, int], int], problem: Problem
) -> Fit:
    """Return a fit, at its solution, with further regressors in its equations."""
    return fit(
        problem,
        fitted.camera,
        fold_of=folds,
        further=blocks,
        views=fitted.forward.views,
        warm=fitted,
        iterations=0,
    )


def _gain(scores: Scores, candidate: Candidate, span: Sequence[int]) -> float:
    """Return the gain of a candidate within the bounds of its parameters.

    Parameters that must be positive and are negative within their errors are held at zero. The gain is 0
    where one is negative by more than that.
    """
    gain = float(scores.gain(span))
    if not candidate.positive or gain <= 0:
        return gain
    values = scores.values(span)
    labels = {scores.regressors[i].label: i for i in span}
    below = [labels[label] for label in candidate.positive if values[label] < 0]
    if not below:
        return gain
    columns = scores.columns(span)
    sigma = dict(zip(columns.tolist(), np.sqrt(np.diag(scores.covariance(columns))), strict=True))
    if any(values[scores.regressors[i].label] < -BEYOND_POSSIBLE * sigma[i] for i in below):
        return 0.0
    possible = [i for i in span if i not in below]
    return float(scores.gain(possible)) if possible else 0.0
