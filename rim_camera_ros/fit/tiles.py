"""How far the reflectivities of a surface's tiles are from those of the scene file."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.effects.light_curves import TILES
from rim_camera_ros.fit.problem import Fit


def tile_error(fitted: Fit, surface: str) -> float:
    """Return the median over a surface's tiles of their errors in stated sigmas; 0 where none is estimated.

    By the median: a tile that few pixels see is hardly determined.
    """
    priors = {regressor.label: regressor.prior for regressor in fitted.equations.regressors}
    beginning = f"{TILES}{surface}."
    errors = [
        abs(value) / priors[label]
        for label, value in fitted.parameters.items()
        if label.startswith(beginning) and label in priors
    ]
    return float(np.median(errors)) if errors else 0.0
