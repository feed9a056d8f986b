"""Evidence of held-out poses, and of what the files state, against linear regression in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.effects.light_curves import LOBE_DIFFUSE
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.normal_equations import NormalEquations
from rim_camera_ros.select.evidence import UNSTATED, Scores

SHARED, OTHER, CANDIDATE = "common_pose.floor.offset", "radiometry.gain", "effects.distance_scale.scale"
#: 1-sigma of an error that poses share, of a number that may be any, and of a candidate.
PRIORS = {SHARED: 0.7, LOBE_DIFFUSE[2]: 0.7, OTHER: 40.0, CANDIDATE: 5.0}


def folds_of(design: np.ndarray, observed: np.ndarray, *, count: int = 5) -> list[Fold]:
    """Folds of plain regression: unit weights, no pattern, no errors of poses."""
    everything = np.column_stack([design, observed])
    parts = np.array_split(everything, count)
    size = everything.shape[1]
    return [Fold([], one.T @ one, np.zeros((1, size)), np.zeros(1), rows=len(one)) for one in parts]


def scores_of(labels: list[str], design: np.ndarray, observed: np.ndarray) -> Scores:
    regressors = [Regressor(one, "any", PRIORS[one]) for one in labels]
    return Scores(NormalEquations(regressors, folds_of(design, observed)), range(2))


def log_density(design: np.ndarray, observed: np.ndarray, sigmas: list[float]) -> float:
    """Of observations with noise 1, their coefficients integrated out."""
    covariance = np.eye(len(observed)) + (design * np.square(sigmas)) @ design.T
    return float(multivariate_normal(cov=covariance).logpdf(observed))


@pytest.fixture
def regression() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    design = rng.normal(size=(60, 3))
    # what the candidate does looks like an error that poses share, all but 3 % of it
    design[:, 2] = design[:, 0] + 0.03 * rng.normal(size=60)
    return design, design @ [0.0, 9.0, 6.0] + rng.normal(size=60)


def test_the_density_of_every_fold_given_the_others(regression: tuple[np.ndarray, np.ndarray]) -> None:
    design, observed = regression
    scores = scores_of([SHARED, OTHER, CANDIDATE], design, observed)
    sigmas = [PRIORS[one] for one in (SHARED, OTHER)]
    base = design[:, :2]
    by_fold = []
    for own in np.array_split(np.arange(60), 5):
        rest = np.setdiff1d(np.arange(60), own)
        by_fold.append(log_density(base, observed, sigmas) - log_density(base[rest], observed[rest], sigmas))
    constant = -0.5 * 12 * np.log(2 * np.pi)
    assert scores.log_likelihoods() == pytest.approx([one - constant for one in by_fold], abs=1e-6)


@pytest.mark.parametrize("shared", [SHARED, LOBE_DIFFUSE[2]])
def test_the_density_of_what_is_stated_of_shared_errors(
    regression: tuple[np.ndarray, np.ndarray], shared: str
) -> None:
    """Stated is 0, against a mean of likelihoods over sizes of 1.8 to ten times what is stated."""
    design, observed = regression
    scores = scores_of([shared, OTHER, CANDIDATE], design, observed)
    assert pytest.approx((10.0, 5.6234, 3.1623, 1.7783), rel=1e-4) == UNSTATED
    for extra in ([], [2]):
        own = [0, 1, *extra]
        of_others = [PRIORS[[shared, OTHER, CANDIDATE][i]] for i in own[1:]]
        narrow, *wide = (
            log_density(design[:, own], observed, [factor * PRIORS[shared], *of_others])
            for factor in (1.0, *UNSTATED)
        )
        expected = narrow - np.log(np.mean(np.exp(np.array(wide) - narrow))) - narrow
        assert scores.stated(extra) == pytest.approx(expected, abs=1e-6)
    assert scores.log_likelihood() == pytest.approx(sum(scores.log_likelihoods()) + scores.stated())
    assert scores.gain([2]) == pytest.approx(scores.log_likelihood([2]) - scores.log_likelihood())


def test_an_effect_that_shared_errors_imitate_gains_by_what_is_stated(
    regression: tuple[np.ndarray, np.ndarray],
) -> None:
    """Held-out poses alone hardly tell them apart: an error of 6, 8.6 times what is stated, fits as well."""
    design, observed = regression
    scores = scores_of([SHARED, OTHER, CANDIDATE], design, observed)
    of_poses = sum(scores.log_likelihoods([2])) - sum(scores.log_likelihoods())
    of_statement = scores.stated([2]) - scores.stated()
    assert of_poses < 8 < of_statement
    # where the data tell the error, the density is the normal one at its estimate
    alone = scores_of([SHARED, OTHER], design[:, :2], observed)
    error = np.sqrt(np.linalg.inv(design[:, :2].T @ design[:, :2])[0, 0])
    estimate = np.linalg.lstsq(design[:, :2], observed, rcond=None)[0][0]
    stated, *wider = (norm(scale=np.hypot(k * 0.7, error)).logpdf(estimate) for k in (1.0, *UNSTATED))
    assert alone.stated() == pytest.approx(stated - np.log(np.mean(np.exp(wider))), abs=0.05)


def test_what_is_stated_is_the_same_wherever_the_fit_stands(
    regression: tuple[np.ndarray, np.ndarray],
) -> None:
    """Equations about an error that is in the predictions already say what those about none do."""
    design, observed = regression
    labels = [SHARED, OTHER, CANDIDATE]
    at_nothing = scores_of(labels, design, observed)
    moved = scores_of(labels, design, observed - 5.0 * design[:, 0])
    moved.away = np.array([5.0, 0.0, 0.0])
    assert at_nothing.stated() < -10
    assert moved.stated() == pytest.approx(at_nothing.stated(), abs=1e-6)
    assert moved.log_likelihood() == pytest.approx(at_nothing.log_likelihood(), abs=1e-6)


def test_without_shared_errors_nothing_is_stated(regression: tuple[np.ndarray, np.ndarray]) -> None:
    design, observed = regression
    assert scores_of([OTHER, CANDIDATE], design[:, 1:], observed).stated() == pytest.approx(0.0, abs=1e-12)


def test_likelihoods_take_no_step_beyond_a_bound(regression: tuple[np.ndarray, np.ndarray]) -> None:
    """A regressor that is held is as good as absent, whatever it would gain."""
    design, observed = regression
    labels = [SHARED, OTHER, CANDIDATE]
    equations = scores_of(labels, design, observed).equations
    held = Scores(equations, [0, 1, 2], held=[1])
    absent, free = Scores(equations, [0, 2]), Scores(equations, [0, 1, 2])
    assert held.log_likelihoods() == pytest.approx(absent.log_likelihoods(), rel=1e-12)
    assert held.log_likelihood() == pytest.approx(absent.log_likelihood(), rel=1e-12)
    assert held.log_likelihood() < free.log_likelihood() - 1000
    assert Scores(equations, [0, 1], held=[1]).gain([2]) == pytest.approx(Scores(equations, [0]).gain([2]))
    assert held.values() == {**absent.values(), OTHER: 0.0}
    assert list(held.values()) == list(free.values())
    assert held.chi_square() == pytest.approx(absent.chi_square())
    assert held.chi_square(held_out=True) == pytest.approx(absent.chi_square(held_out=True))
    with_held, without = Scores(equations, [0, 1], held=[1]), Scores(equations, [0])
    assert with_held.identifiability([2]) == pytest.approx(without.identifiability([2]))
    assert with_held.conditional_on_base([2])[0] == pytest.approx(without.conditional_on_base([2])[0])
