"""Robust estimates of scatter."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Array = NDArray[Any]


def excess(deviations: Array, variances: Array) -> float:
    """Return the robust standard deviation of deviations in excess of their known variances."""

    def spread(tau: float) -> float:
        return float(1.4826 * np.median(np.abs(deviations) / np.sqrt(variances + tau**2)))

    if spread(0.0) <= 1.03:
        return 0.0
    high = 1.4826 * float(np.median(np.abs(deviations))) + 1e-9
    return float(brentq(lambda tau: spread(tau) - 1.0, 0.0, 2 * high)) if spread(2 * high) < 1.0 else high
