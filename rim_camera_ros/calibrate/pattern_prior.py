"""How large is the fixed pattern? Asked where pixels are seen by so few poses that it could swallow the rest.

An offset per pixel that may be anything takes all that a pixel tells which one pose sees: what a small board,
held here and there, shows within a pose is lost then, and only differences between poses are left, with
their errors. The size of the offsets that makes the recordings most likely (restricted maximum likelihood)
keeps both apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.calibrate.normal_equations import PATTERN_PRIOR, reduce_folds
from rim_camera_ros.calibrate.problem import Fit

Array = NDArray[Any]

#: Values per pixel below which the pattern's size is asked for, and the size with which that begins [m]: from
#: a large one nothing else would be seen to be wrong.
FEW_LOOKS = 5.0
FIRST_SIZE = 0.001
#: Sizes that are tried, 1-sigma of a pixel's offset [m].
SIZES = (0.0003, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.06, PATTERN_PRIOR)


def first_pattern_prior(masks: Sequence[tuple[Array, Array]]) -> float:
    """Return the 1-sigma of pixels' offsets [m] to begin with, by the pixels of each station, (H, W) each.

    `PATTERN_PRIOR`, as good as unknown, where every pixel has enough looks to tell its own.
    """
    count = np.sum([used for used, _ in masks], axis=0)
    looks = float(count[count > 0].mean()) if count.any() else FEW_LOOKS
    return FIRST_SIZE if looks < FEW_LOOKS else PATTERN_PRIOR


def log_evidence(fitted: Fit, size: float) -> float:
    """Return the log likelihood of a fit's data, up to a constant, for pixels' offsets of a ``size`` [m].

    ``size`` is their 1-sigma. Parameters, errors of poses and the offsets themselves are integrated out.
    """
    count = len(fitted.parameters)
    pixels = replace(fitted.equations.pixels, offset=size)
    reduced = reduce_folds(fitted.equations.folds, len(fitted.equations.regressors), pixels)
    matrix = reduced.gram[:count, :count] + np.diag(fitted.priors**-2)
    factor = linalg.cholesky(matrix, lower=True)
    solved = linalg.solve_triangular(factor, reduced.right[:count], lower=True)
    rest = float(reduced.square) - float(solved @ solved)
    return -0.5 * rest - reduced.log_norm - float(np.sum(np.log(np.diag(factor))))


def likely_pattern_prior(fitted: Fit) -> float:
    """Return the likeliest 1-sigma of pixels' offsets [m] of `SIZES`."""
    return max(SIZES, key=lambda size: log_evidence(fitted, size))


def pattern_prior_note(size: float) -> str:
    """Return in words how large the offsets of pixels are taken to be."""
    return (
        f"pixels are seen by few poses each: their offsets are taken to be {size * 1e3:.1f} mm (1 sigma), "
        "which makes the recordings most likely, lest they take what poses tell of the other effects"
    )
