"""Evidence conditional on changes of forms, against linear regression in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.normal_equations import NormalEquations
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.form_sizes import SIZES, ConditionalOnForms

COUNT, CHANGES = 120, 8


def equations_of(design: np.ndarray, observed: np.ndarray, priors: list[float]) -> NormalEquations:
    """Plain regression in five folds: unit weights, no pattern, no errors of poses."""
    everything = np.column_stack([design, observed])
    size = everything.shape[1]
    folds = [
        Fold([], one.T @ one, np.zeros((1, size)), np.zeros(1), rows=len(one))
        for one in np.array_split(everything, 5)
    ]
    labels = ["radiometry.gain", *(f"form.motion.{i}" for i in range(CHANGES)), "effects.motion.x", "other.y"]
    return NormalEquations([Regressor(*one) for one in zip(labels, labels, priors, strict=True)], folds)


def setting(seed: int) -> tuple[np.ndarray, list[float]]:
    """A candidate (second but last) of which changes of form can do nearly all, and one of its own kind."""
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(COUNT, CHANGES + 3))
    changes = design[:, 1 : 1 + CHANGES]
    design[:, -2] = changes @ rng.normal(size=CHANGES) / np.sqrt(CHANGES) + 0.05 * rng.normal(size=COUNT)
    return design, [5.0, *[0.4] * CHANGES, 2.0, 2.0]


def both(equations: NormalEquations) -> tuple[ConditionalOnForms, Scores]:
    changes = range(1, 1 + CHANGES)
    return ConditionalOnForms(equations, [0], changes), Scores(equations, [0, *changes])


def test_likelihoods_are_means_over_the_sizes_of_changes() -> None:
    design, priors = setting(1)
    observed = design[:, -2] + np.random.default_rng(2).normal(size=COUNT)
    conditional, _ = both(equations_of(design, observed, priors))

    def density(rows: np.ndarray, columns: list[int], size: float) -> float:
        sigmas = [priors[i] * (size if 1 <= i <= CHANGES else 1.0) for i in columns]
        covariance = (
            np.eye(len(rows))
            + (design[np.ix_(rows, columns)] * np.square(sigmas)) @ design[np.ix_(rows, columns)].T
        )
        return float(multivariate_normal(cov=covariance).logpdf(observed[rows]))

    def held_out(columns: list[int], size: float) -> float:
        every = np.arange(COUNT)
        return sum(
            density(every, columns, size) - density(np.setdiff1d(every, own), columns, size)
            for own in np.array_split(every, 5)
        )

    base = [*range(1 + CHANGES)]
    for extra in ([CHANGES + 1], [CHANGES + 1, CHANGES + 2]):
        with_extra = logsumexp([held_out([*base, *extra], one) for one in SIZES])
        without = logsumexp([held_out(base, one) for one in SIZES])
        assert conditional.gain(extra) == pytest.approx(with_extra - without, abs=1e-6)


def test_what_a_true_form_could_imitate_is_found_given_it() -> None:
    """Changes that nothing calls for are small, and take up nothing of the candidate."""
    gains = []
    for seed in range(12):
        design, priors = setting(seed)
        observed = 1.2 * design[:, -2] + np.random.default_rng(seed + 100).normal(size=COUNT)
        conditional, fixed = both(equations_of(design, observed, priors))
        gains.append((conditional.gain([CHANGES + 1]), fixed.gain([CHANGES + 1])))
    own, of_fixed = np.median(gains, axis=0)
    assert own > of_fixed + 5.0
    assert own > 5.0


def test_changes_that_are_there_are_no_other_effect() -> None:
    """A form that is wrong by its stated size leaves no more to a candidate than before."""
    for seed in range(12):
        design, priors = setting(seed)
        rng = np.random.default_rng(seed + 200)
        form = design[:, 1 : 1 + CHANGES] @ rng.normal(scale=0.4, size=CHANGES)
        conditional, fixed = both(equations_of(design, form + rng.normal(size=COUNT), priors))
        assert conditional.gain([CHANGES + 1]) < fixed.gain([CHANGES + 1]) + 1.0
        assert conditional.gain([CHANGES + 1]) < 4.0


def test_coefficients_are_those_of_the_likeliest_size() -> None:
    design, priors = setting(4)
    observed = 1.2 * design[:, -2] + np.random.default_rng(104).normal(size=COUNT)
    equations = equations_of(design, observed, priors)
    conditional, _ = both(equations)
    extra = [CHANGES + 1]
    likely = []
    for size in SIZES:
        scaled = np.array(priors)
        scaled[1 : 1 + CHANGES] *= size
        gram = sum(one.gram for one in equations.folds)[:-1, :-1]
        kept = [*range(1 + CHANGES), *extra]
        matrix = gram[np.ix_(kept, kept)] + np.diag(scaled[kept] ** -2)
        right = sum(one.gram for one in equations.folds)[kept, -1]
        likely.append(np.linalg.solve(matrix, right))
    found = np.array([*conditional.values(extra).values()])
    errors = [float(np.abs(found - one).max()) for one in likely]
    assert min(errors) < 1e-9
    # the smallest two: no change of form was made
    assert int(np.argmin(errors)) >= 2
