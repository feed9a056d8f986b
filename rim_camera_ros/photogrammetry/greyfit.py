"""Least squares fit of a model of a target to the grey values of an image, with a covariance by residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]


class GreyModel(Protocol):
    """Grey values at n pixels by p parameters."""

    def values(self, parameters: Array) -> Array:
        """Return the grey values (n,)."""

    def slopes(self, parameters: Array) -> Array:
        """Return their derivatives (n, p)."""


@dataclass(frozen=True)
class WithDifferences:
    """A model whose derivatives are central differences.

    ``at`` returns grey values (k, n) for k rows of parameters (k, p), whose ``steps`` are (p,).
    """

    at: Callable[[Array], Array]
    steps: Array

    def values(self, parameters: Array) -> Array:
        """Return the grey values (n,)."""
        return np.asarray(self.at(parameters[None])[0])

    def slopes(self, parameters: Array) -> Array:
        """Return their derivatives (n, p)."""
        steps = np.diag(self.steps)
        values = self.at(np.concatenate([parameters + steps, parameters - steps]))
        count = len(self.steps)
        result: Array = ((values[:count] - values[count:]) / (2 * self.steps)[:, None]).T
        return result


@dataclass(frozen=True)
class GreyFit:
    """Parameters (p,), their covariance (p, p) and the RMS of the residuals in grey values.

    ``squares`` (n,): squared residuals, corrected for the pull (leverage) of each grey value on the fit.
    """

    parameters: Array
    covariance: Array
    residual_rms: float
    squares: Array


def fit_grey_values(model: GreyModel, start: Array, grey: Array) -> GreyFit | None:
    """Fit ``model`` to the grey values (n,) from ``start`` (p,); None where it does not converge.

    The covariance is the heteroscedasticity-consistent one (MacKinnon & White 1985, HC3). The model fits
    worst at the edges of a target, which determine its position; one variance for all pixels would hide that.
    """
    count, unknowns = len(grey), len(start)
    if count <= unknowns + 2:
        return None

    def residuals(parameters: Array) -> Array:
        return model.values(parameters) - grey

    found: Any = least_squares(residuals, start, jac=model.slopes, method="lm", x_scale="jac", max_nfev=60)
    if found.status <= 0 or not np.isfinite(found.x).all():
        return None
    scale = np.linalg.norm(found.jac, axis=0)
    # a parameter without effect, such as a blur of zero, stays as it is
    moving = scale > 1e-9 * scale.max()
    q, r = np.linalg.qr(found.jac[:, moving] / scale[moving])
    if np.abs(np.diag(r)).min() < 1e-7:
        return None
    leverage = np.minimum(np.sum(q**2, axis=1), 0.99)
    to_parameters = np.zeros((unknowns, count))
    to_parameters[moving] = np.linalg.solve(r, q.T) / scale[moving, None]
    spread = to_parameters * (found.fun / (1 - leverage))
    rms = float(np.sqrt(np.sum(found.fun**2) / (count - unknowns)))
    return GreyFit(found.x, spread @ spread.T, rms, found.fun**2 / (1 - leverage))
