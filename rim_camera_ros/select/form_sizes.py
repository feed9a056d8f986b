"""Evidence conditional on changes of the forms of effects, whose size is estimated from the data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from rim_camera_ros.fit.normal_equations import NormalEquations
from rim_camera_ros.select.evidence import Scores

Array = NDArray[Any]

#: The least size of changes of form, relative to their priors (`candidates.SHARE` of an effect).
LEAST_SIZE = 0.03
#: Sizes over which likelihoods are averaged: even in their logarithm, the prior of a scale parameter.
SIZES = tuple(np.geomspace(1.0, LEAST_SIZE, 4).tolist())


class ConditionalOnForms(Scores):
    """Scores conditional on the base and on ``changes`` of forms.

    The size of the changes is a hyperparameter: likelihoods are means over `SIZES`, coefficients are those of
    the likeliest size (MacKay, Bayesian interpolation, Neural Computation 4, 1992). Were it fixed, changes by
    a third of an effect whose form is exact would absorb most of another effect.
    """

    def __init__(
        self,
        equations: NormalEquations,
        base: Iterable[int],
        changes: Sequence[int],
        *,
        held: Iterable[int] = (),
    ) -> None:
        super().__init__(equations, [*base, *changes], held=held)
        factors = np.ones((len(SIZES), len(self.regressors)))
        factors[:, list(changes)] = np.array(SIZES)[:, None]
        plain = Scores(equations, self.base.tolist(), held=held)
        self._of_sizes = [plain.with_priors(self.prior * factor) for factor in factors]

    def held_out(self, extra: Iterable[int] = ()) -> Any:
        """Return the held-out log likelihood in nats, up to a constant."""
        extra = list(extra)
        if not extra:
            return self._of_base_alone
        return logsumexp([size.held_out(extra) for size in self._of_sizes]) - np.log(len(SIZES))

    @cached_property
    def _of_base_alone(self) -> float:
        every = [float(size.held_out()) for size in self._of_sizes]
        return float(logsumexp(every) - np.log(len(SIZES)))

    def likeliest(self, extra: Iterable[int] = ()) -> Scores:
        """Return the scores with the priors of the likeliest size."""
        extra = list(extra)
        return max(self._of_sizes, key=lambda scores: float(scores.held_out(extra)))

    def relative_size(self, extra: Iterable[int] = ()) -> float:
        """Return the likeliest size of the changes, relative to their priors."""
        return float(np.min(self.likeliest(extra).prior / self.prior))

    def values(self, extra: Iterable[int] = (), *, leave_out: int | None = None) -> dict[str, float]:
        """Return the coefficients of base and extra by label, those of the likeliest size."""
        return self.likeliest(extra).values(extra, leave_out=leave_out)

    def covariance(self, columns: Array) -> Array:
        """Return the joint posterior covariance (K, K) of some regressors, by the likeliest size."""
        return self.likeliest(columns.tolist()).covariance(columns)

    def errors_and_offsets(self, extra: Iterable[int] = ()) -> tuple[dict[str, float], Array]:
        """Return the errors of poses and powers and the offsets of pixels [m], by the likeliest size."""
        return self.likeliest(extra).errors_and_offsets(extra)
