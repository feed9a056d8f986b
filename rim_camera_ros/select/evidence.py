"""The evidence for effects: marginal likelihood of held-out poses, from reduced normal equations.

With all nuisance parameters eliminated, a set of regressors is scored by the logarithm of the probability of
every fold of poses given the others: log p(all) - log p(all but the fold), summed over the folds. The values
that files state for errors which poses share count as one more observation, given all poses. Everything is
computed from (K, K) matrices, so that thousands of sets take a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import logsumexp

from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.effects.light_curves import LOBE_PREFIX
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import COMMON_POSE
from rim_camera_ros.fit.normal_equations import NormalEquations, Reduced
from rim_camera_ros.fit.surface_shape import SHAPE
from rim_camera_ros.threads import in_order

Array = NDArray[Any]
Key = tuple[int, int]

#: Beginnings of the labels of errors that poses share, whose stated size is held out.
STATED = (COMMON_POSE, SHAPE, LOBE_PREFIX)
#: Factors on their stated 1-sigma where it is held out: then hardly known.
UNSTATED = tuple(np.geomspace(10.0, 10.0**0.25, 4).tolist())


def folds_of(dataset: Dataset, count: int = 5) -> dict[Key, int]:
    """Deal poses to folds, evenly within each integration time.

    Raises nothing: with fewer poses than folds there are fewer folds.
    """
    first: dict[Key, tuple[float, float]] = {}
    for station in dataset.stations:
        setting = station.settings.integration_time or 0.0
        first.setdefault((station.recording, station.placed), (setting, station.time))
    ordered = sorted(first, key=lambda key: (first[key][0], key))
    count = max(1, min(count, len(ordered)))
    # neighbours in time go to different folds, and each setting to all of them
    dealt = {key: i % count for i, key in enumerate(ordered)}
    return {
        (station.recording, station.pose): dealt[station.recording, station.placed]
        for station in dataset.stations
    }


def _scaled(
    reduced: Reduced, columns: Array, scale: Array, temper: float, away: Array
) -> tuple[Array, Array]:
    matrix = reduced.gram[np.ix_(columns, columns)] * scale[:, None] * scale[None, :] / temper
    matrix[np.diag_indices_from(matrix)] += 1.0
    right = reduced.right[columns]
    return matrix, ((right.T * scale) / temper - away[columns] / scale).T


@dataclass(frozen=True)
class _Base:
    """The evidence of a base; its Cholesky factor serves all regressors that are scored conditional on it.

    ``factor`` (B, B) is that of its equations in units of the priors ``scale`` (B,); ``solved``, (B,) or
    (B, R), are their right-hand sides solved by it.
    """

    reduced: Reduced
    columns: Array
    scale: Array
    temper: float
    away: Array
    factor: Array
    solved: Array
    evidence: Any

    @classmethod
    def of(cls, reduced: Reduced, columns: Array, scale: Array, temper: float, away: Array) -> _Base:
        matrix, right = _scaled(reduced, columns, scale, temper, away)
        if not len(columns):  # scipy 1.11 solves no empty equations
            nothing = np.zeros(right.shape[1:])
            return cls(reduced, columns, scale, temper, away, matrix, right, nothing)
        factor, solved, evidence = _evidence(matrix, right)
        # the prior's density at the linearisation point: needed to compare priors of several widths
        evidence = evidence - 0.5 * float(np.sum((away[columns] / scale) ** 2))
        return cls(reduced, columns, scale, temper, away, factor, solved, evidence)

    def of_further(self, own: Array, scale: Array) -> Any:
        """Return what further columns (E,) with priors ``scale`` (E,) add to the evidence."""
        matrix, right = _scaled(self.reduced, own, scale, self.temper, self.away)
        if len(self.columns):
            cross = self.reduced.gram[np.ix_(self.columns, own)] * self.scale[:, None] * scale / self.temper
            by_base = linalg.solve_triangular(self.factor, cross, lower=True, check_finite=False)
            matrix = matrix - by_base.T @ by_base
            right = right - by_base.T @ self.solved
        return _evidence(matrix, right)[2]


def _evidence(matrix: Array, right: Array) -> tuple[Array, Array, Any]:
    """Return the Cholesky factor of equations, their right sides solved by it, and their log evidence."""
    factor = linalg.cholesky(matrix, lower=True, check_finite=False)
    solved = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    return factor, solved, 0.5 * np.sum(solved * solved, axis=0) - np.sum(np.log(np.diag(factor)))


class Scores:
    """Scores of sets of regressors conditional on a base that is part of every model.

    ``base`` are the indices of the regressors of the baseline. ``held`` are those of them at a bound that
    the data would exceed: they stay at it, and likelihoods, coefficients and errors are those of the others.
    """

    def __init__(
        self,
        equations: NormalEquations,
        base: Iterable[int],
        *,
        temper: float = 1.0,
        held: Iterable[int] = (),
    ) -> None:
        self.equations, self.regressors = equations, equations.regressors
        self.base = np.array(sorted(base), int)
        self._held = frozenset(held)
        self._in_base = frozenset(self.base.tolist())
        self._bases: dict[tuple[int | None, float], _Base] = {}
        self.prior = priors_of(equations.regressors)
        folds = range(len(equations.folds)) if len(equations.folds) > 1 else ()
        self.full, *self.trained = in_order(equations.reduced, (None, *folds), threads=equations.threads)
        self.temper = temper
        self.away = equations.away_from_prior()
        count = len(equations.regressors)
        self._energy = sum((fold.gram[:count, :count] for fold in equations.folds), np.zeros((count, count)))

    def of_replicates(self, full: Reduced, trained: Sequence[Reduced]) -> Scores:
        """Return the scores of replicates: right-hand sides (K, R) drawn about the middle of the priors."""
        result = copy(self)
        result.temper, result.away = 1.0, np.zeros(len(self.regressors))
        result.full, result.trained, result._bases = full, list(trained), {}
        return result

    def with_priors(self, prior: Array) -> Scores:
        """Return the scores with other 1-sigmas of the priors (K,), about the same middles."""
        result = copy(self)
        result.prior, result._bases = prior, {}
        return result

    def likeliest(self, extra: Iterable[int] = ()) -> Scores:
        """Return the scores with priors of the likeliest size: these scores, without a hyperparameter."""
        return self

    def relative_size(self, extra: Iterable[int] = ()) -> float:
        """Return the likeliest value of the hyperparameter, relative to the prior: 1, as there is none."""
        return 1.0

    def columns(self, extra: Iterable[int]) -> Array:
        """Return the indices of base and extra regressors that are not held."""
        return np.array(sorted({*self.base.tolist(), *extra} - self._held), int)

    def _scaled(self, reduced: Reduced, columns: Array) -> tuple[Array, Array]:
        """Return the equations in units of the priors, which keeps them well conditioned."""
        return _scaled(reduced, columns, self.prior[columns], self.temper, self.away)

    def _of_base(self, number: int | None, unstated: float) -> _Base:
        """Return the evidence of the base by all folds (None), or by all but one."""
        if (number, unstated) not in self._bases:
            reduced = self.full if number is None else self.trained[number]
            columns = self.columns([])
            labels = [self.regressors[i].label for i in columns]
            stated = np.array([label.startswith(STATED) for label in labels], bool)
            scale = np.where(stated, unstated, 1.0) * self.prior[columns]
            self._bases[number, unstated] = _Base.of(reduced, columns, scale, self.temper, self.away)
        return self._bases[number, unstated]

    def _evidence(self, number: int | None, extra: Iterable[int] = (), *, unstated: float = 1.0) -> Any:
        """Return the log evidence of all folds (None) or all but one; stated sizes ``unstated`` times."""
        base = self._of_base(number, unstated)
        own = np.array(sorted({*extra} - self._held - self._in_base), int)
        return base.evidence if not own.size else base.evidence + base.of_further(own, self.prior[own])

    def held_out(self, extra: Iterable[int] = ()) -> Any:
        """Return the held-out log likelihood in nats, up to a constant; (R,) for replicates."""
        extra = list(extra)
        everything = self._evidence(None, extra)
        if not self.trained:
            return everything
        of_folds = sum(everything - self._evidence(i, extra) for i in range(len(self.trained)))
        return of_folds + self.stated(extra)

    def stated(self, extra: Iterable[int] = ()) -> Any:
        """Return the log evidence [nats] for the stated size of errors that poses share, given all poses.

        It is relative to the mean evidence for sizes `UNSTATED` times as large (an unknown size; MacKay,
        Neural Computation 4, 1992); (R,) for replicates. An effect that such errors imitate gains here; a
        fit that needs larger errors than stated loses.
        """
        extra = list(extra)
        larger = [self._evidence(None, extra, unstated=factor) for factor in UNSTATED]
        return self._evidence(None, extra) - logsumexp(larger, axis=0) + np.log(len(larger))

    def log_likelihood(self, extra: Iterable[int] = ()) -> float:
        """Return the held-out log likelihood in nats with all its constants but the number of values.

        Comparable between fits of the same pixels at different parameters.
        """
        if not self.trained:
            return float(self.held_out(extra))
        return sum(self.log_likelihoods(extra)) + float(self.stated(extra))

    def log_likelihoods(self, extra: Iterable[int] = ()) -> list[float]:
        """Return what each fold adds to `log_likelihood`, given the others."""
        extra = list(extra)
        everything = float(self._evidence(None, extra))
        return [
            everything
            - float(self._evidence(i, extra))
            - 0.5 * float(self.full.square - reduced.square) / self.temper
            - (self.full.log_norm - reduced.log_norm)
            for i, reduced in enumerate(self.trained)
        ]

    def gain(self, extra: Iterable[int]) -> Any:
        """Return the gain of a set of regressors over the base alone, in nats."""
        return self.held_out(extra) - self.held_out()

    def values(self, extra: Iterable[int] = (), *, leave_out: int | None = None) -> dict[str, float]:
        """Return the coefficients of base and extra by label, in their order; 0 of those that are held."""
        reduced = self.full if leave_out is None else self.trained[leave_out]
        columns = self.columns(extra)
        solution = dict(zip(columns.tolist(), self._solve(reduced, columns).tolist(), strict=True))
        every = sorted({*self.base.tolist(), *extra})
        return {self.regressors[i].label: solution.get(i, 0.0) for i in every}

    def errors(self, extra: Iterable[int] = ()) -> dict[str, float]:
        """Return the estimated errors of poses and powers, given the coefficients of base and extra."""
        return self.errors_and_offsets(extra)[0]

    def errors_and_offsets(self, extra: Iterable[int] = ()) -> tuple[dict[str, float], Array]:
        """Return the estimated errors of poses and powers, and the offsets of all pixels (P,) [m]."""
        columns = self.columns(extra)
        values = np.zeros(len(self.regressors))
        values[columns] = self._solve(self.full, columns)
        return self.full.recover(values)[:2]

    def _solve(self, reduced: Reduced, columns: Array) -> Array:
        matrix, right = self._scaled(reduced, columns)
        if not len(columns):
            return np.asarray(right)
        return np.asarray(self.prior[columns] * linalg.cho_solve(linalg.cho_factor(matrix), right))

    def covariance(self, columns: Array) -> Array:
        """Return the posterior covariance (K, K) of some regressors together."""
        matrix, _ = self._scaled(self.full, columns)
        scale = self.prior[columns]
        return np.asarray(linalg.inv(matrix) * scale[:, None] * scale[None, :])

    def chi_square(self, extra: Iterable[int] = (), *, held_out: bool = False) -> tuple[float, int]:
        """Return chi-square of the residuals and its expected value: of the fit, or of held-out poses.

        Of held-out poses it is that of the predictive distribution. The expected value is less than the
        number of values: variances of amplitudes include the error of predictions, squares only the noise.
        """
        columns = self.columns(extra)

        def minimum(reduced: Reduced) -> float:
            solution = self._solve(reduced, columns)
            pulled = self.away[columns] / self.prior[columns] ** 2
            return float(reduced.square - (reduced.right[columns] - pulled) @ solution)

        if not held_out or not self.trained:
            return minimum(self.full), round(self.full.expected)
        total, expected = 0.0, 0.0
        for reduced in self.trained:
            total += minimum(self.full) - minimum(reduced)
            expected += self.full.expected - reduced.expected
        return total, round(expected)

    def information(self, extra: Sequence[int]) -> float:
        """Return the information of the data about regressors, conditional on the base [nats].

        Half the logarithm of the ratio of the determinants of their prior and posterior covariances.
        """
        sign_and_log = np.linalg.slogdet(self._conditional(list(extra)))
        return float(0.5 * sign_and_log[1])

    def identifiability(self, extra: Sequence[int]) -> tuple[float, float]:
        """Return how identifiable an effect of the estimated strength is, given everything else.

        The share of its energy (sum of its squared contributions over the variances) that remains after
        projecting out all that is fitted jointly with it, 0 to 1; and the expected gain of that [nats].
        """
        values = self.values(extra)
        strength = np.array([values[self.regressors[i].label] for i in extra])
        energy = float(strength @ self._energy[np.ix_(extra, extra)] @ strength)
        expected = self.expected_gain(extra, strength)
        if not energy > 0:
            return 0.0, 0.0
        return float(np.clip(2 * expected * self.temper / energy, 0.0, 1.0)), max(expected, 0.0)

    def expected_gain(self, extra: Sequence[int], strength: Array) -> float:
        """Return the expected gain [nats] of regressors of this strength (K,), conditional on the base."""
        scaled = strength / self.prior[list(extra)]
        return float(0.5 * scaled @ (self._conditional(extra) - np.eye(len(scaled))) @ scaled)

    def conditional_on_base(self, extra: Sequence[int]) -> tuple[Array, Array]:
        """Return normal matrix (K, K) and right side (K,) of some regressors after the base is eliminated.

        The regressors' own priors are not in them.
        """
        base = self.columns([])
        columns = np.array([*base, *extra], int)
        matrix, right = self._scaled(self.full, columns)
        n = len(base)
        solved = linalg.solve(matrix[:n, :n], np.column_stack([matrix[:n, n:], right[:n]]), assume_a="pos")
        scale = self.prior[list(extra)]
        gram = matrix[n:, n:] - np.eye(len(extra)) - matrix[n:, :n] @ solved[:, :-1]
        side = right[n:] - matrix[n:, :n] @ solved[:, -1]
        return np.asarray(gram / scale[:, None] / scale[None, :]), np.asarray(side / scale)

    def _conditional(self, extra: Sequence[int]) -> Array:
        """Return the posterior precision of some regressors, base eliminated, in units of their priors."""
        base = [i for i in self.columns([]) if i not in set(extra)]
        columns = np.array([*base, *extra], int)
        matrix, _ = self._scaled(self.full, columns)
        n = len(base)
        cross = matrix[:n, n:]
        return np.asarray(matrix[n:, n:] - cross.T @ linalg.solve(matrix[:n, :n], cross, assume_a="pos"))
