"""The smallest visible size of each effect: logistic curves of seen and named over strength."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, log_expit

#: Scatter of the effects' 50 % points about their mean, in ln(strength), and of ln(slope): weak priors that
#: keep the fit finite where all cases are seen, or none.
POINT_SCATTER, SLOPE_SCATTER = 1.0, 0.7
SLOPE = 3.0
#: Mean of the 50 % points [multiples of sigma] before any case is looked at, and the scatter of ln of it.
MIDDLE, MIDDLE_SCATTER = 0.1, 2.0


@dataclass(frozen=True)
class Curves:
    """P(yes) = 1 / (1 + (strength / point)^-slope): one point per effect, one slope for all."""

    points: dict[str, float]
    slope: float

    def probability(self, effect: str, strength: Any) -> Any:
        """The probability at a strength."""
        return expit(self.slope * np.log(np.asarray(strength, float) / self.points[effect]))


def fit_curves(data: Mapping[str, Sequence[tuple[float, bool]]]) -> Curves:
    """Fit the curves to (strength, yes) of every effect by maximum posterior probability.

    Raises
    ------
    ValueError: a strength is not positive.
    """
    names = [name for name, values in data.items() if values]
    if not names:
        return Curves({}, SLOPE)
    which = np.concatenate([np.full(len(data[name]), i) for i, name in enumerate(names)])
    pairs = np.array([pair for name in names for pair in data[name]], float)
    if np.any(pairs[:, 0] <= 0.0):
        raise ValueError("strengths must be positive")
    strength, sign = np.log(pairs[:, 0]), np.where(pairs[:, 1] > 0.5, 1.0, -1.0)

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        middle, log_slope, points = values[0], values[1], values[2:]
        slope = SLOPE * np.exp(log_slope)
        distance = strength - points[which]
        logit = sign * slope * distance
        rest = -sign * expit(-logit)
        gradient = np.zeros_like(values)
        gradient[0] = (middle - np.log(MIDDLE)) / MIDDLE_SCATTER**2 - np.sum(
            points - middle
        ) / POINT_SCATTER**2
        gradient[1] = np.sum(rest * slope * distance) + log_slope / SLOPE_SCATTER**2
        gradient[2:] = (points - middle) / POINT_SCATTER**2
        np.subtract.at(gradient[2:], which, rest * slope)
        total = -np.sum(log_expit(logit)) + 0.5 * (
            ((middle - np.log(MIDDLE)) / MIDDLE_SCATTER) ** 2
            + np.sum((points - middle) ** 2) / POINT_SCATTER**2
            + (log_slope / SLOPE_SCATTER) ** 2
        )
        return float(total), gradient

    start = np.concatenate([[np.log(MIDDLE), 0.0], np.full(len(names), np.log(MIDDLE))])
    found = minimize(loss, start, jac=True, method="L-BFGS-B").x
    points = {name: float(np.exp(found[2 + i])) for i, name in enumerate(names)}
    return Curves(points, float(SLOPE * np.exp(found[1])))
