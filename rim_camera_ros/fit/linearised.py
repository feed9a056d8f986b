"""The equations of an adjustment at one point, and their solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, Reduced

Array = NDArray[Any]


@dataclass(frozen=True)
class Linearised:
    """The equations where an adjustment stands, and their solution.

    ``matrix``, ``right``, ``step`` and ``covariance`` of the ``regressors`` with their ``prior`` (1-sigma).
    Those numbered in ``at_bounds`` stay at the end of what is possible: the data would take them beyond, by
    so many of their sigmas.
    ``square`` is chi-square with the priors' terms, linear nuisances where they fit best; ``objective`` twice
    the negative log likelihood; ``decrement`` by how much an undamped step should lower either.
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
    def sigma(self) -> Array:
        """1-sigma of each parameter."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))
