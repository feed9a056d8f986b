"""The equations of an adjustment at one point, and their solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.bounds import least_within
from rim_camera_ros.fit.design import is_linear
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, Reduced
from rim_camera_ros.fit.steps import linear_of

Array = NDArray[Any]

NO_SOLUTION = "the adjustment found no finite solution"
#: Step of a parameter in units of its sigma, or of all together (squared, the decrement), and change of
#: chi-square between two iterations (for that tolerance), below which the adjustment has converged: all with
#: the variance of unit weight. Of inexact models, smaller steps do not lower the objective (robust weights).
TOLERANCE = 0.05
_LEVEL = 0.5


@dataclass(frozen=True)
class Linearised:
    """The equations at the current point of an adjustment, and their solution.

    ``matrix``, ``right``, ``step`` and ``covariance`` are those of the ``regressors`` with their ``prior``
    (1-sigma). Parameters whose numbers are in ``at_bounds`` stay at a bound, which the data would exceed by
    so many of their sigmas.
    ``square`` is chi-square with the priors' terms, linear nuisances at their optimum; ``objective`` is twice
    the negative log likelihood; ``decrement`` is the forecast decrease of either by an undamped step.
    """

    forward: Forward
    equations: NormalEquations
    reduced: Reduced
    regressors: Sequence[Regressor]
    prior: Array
    matrix: Array
    right: Array
    step: Array
    covariance: Array
    square: float
    objective: float
    decrement: float
    at_bounds: Mapping[int, float]

    @property
    def labels(self) -> list[str]:
        """Labels of the regressors."""
        return [regressor.label for regressor in self.regressors]

    @property
    def unit_variance(self) -> float:
        """Variance of unit weight, 1 at least: chi-square over its expected value."""
        return max(float(self.square) / max(float(self.reduced.expected), 1.0), 1.0)

    def level(self, tolerance: float) -> float:
        """Return the change of chi-square that is none, for a ``tolerance`` of the parameters."""
        return float(_LEVEL * self.unit_variance * (tolerance / TOLERANCE) ** 2)

    def moves_little(self, tolerance: float) -> bool:
        """Return whether the step is below ``tolerance`` of each sigma, with the variance of unit weight."""
        linear = np.array([is_linear(label) for label in self.labels], bool)
        within = tolerance * np.sqrt(self.unit_variance) * self.sigma
        return bool(np.all(linear | (np.abs(self.step) <= within)))

    @property
    def sigma(self) -> Array:
        """1-sigma of each parameter."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def errors_and_offsets(self) -> tuple[dict[str, float], Array]:
        """Return nuisances by name and offsets of pixels [m], given the parameters at the point."""
        values, linear = np.zeros(len(self.equations.regressors)), linear_of(self.labels)
        values[linear] = self.step[linear]
        found, offsets, _ = self.reduced.recover(values)
        return found | {self.labels[i]: float(values[i]) for i in linear}, offsets


def solution(
    matrix: Array, right: Array, sides: tuple[Array, Array]
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Solve equations: return the step (K,), which parameters stay at a bound, and the covariance (K, K).

    ``sides`` are how far parameters may go down and up. Raises `RimError` where there is no solution.
    """
    count = len(right)
    if not count:  # scipy 1.11 solves no empty equations
        return right, np.zeros(0, bool), matrix
    try:
        covariance = linalg.cho_solve(linalg.cho_factor(matrix), np.eye(count))
        step, stay = least_within(matrix, right, *sides)
    except (linalg.LinAlgError, ValueError):
        raise RimError(NO_SOLUTION, remedy="check scene and camera file") from None
    return step, stay, covariance
