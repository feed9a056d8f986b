"""Model discrepancy of an effect: small changes of its contribution (Kennedy and O'Hagan 2001).

The form of an effect is never quite the true one, and the residuals of a large effect look like small other
effects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.candidate import Reading

Array = NDArray[Any]
#: Derivatives (H, W) of measured distance [m] and published amplitude [counts] (None: none).
DiscrepancyColumn = tuple[Array, Array | None]

#: Spreads along rows and along columns, as shares of the array's width.
SPREADS = (0.02, 0.07, 0.25)
#: Smooth factors that depend on the direction alone, the first of them.
DIRECTIONS = 5
#: Degree of polynomials of the direction.
_DEGREE = 4


@dataclass(frozen=True)
class Change:
    """The changes of a station by an effect: ``distance`` [m] and ``amplitude`` [counts] (H, W), None: none.

    ``factors`` (F, H, W) are smooth over direction (the first `DIRECTIONS`), light and distance.
    """

    reading: Reading
    distance: Array
    amplitude: Array | None
    factors: Array


def spread_out(change: Change) -> Iterator[DiscrepancyColumn]:
    """Yield the effect of spreading the change along rows and along columns, by several widths."""
    from scipy.ndimage import gaussian_filter1d

    nothing = np.zeros(change.distance.shape)
    for share in SPREADS:
        width = share * change.distance.shape[1]
        for axis in (0, 1):
            for image in (change.distance, change.amplitude):
                if image is not None:
                    wider = gaussian_filter1d(image, width, axis=axis, mode="nearest") - image
                    yield (wider, None) if image is change.distance else (nothing, wider)


def functions_of_direction(shape: tuple[int, ...]) -> list[Array]:
    """Return smooth functions (H, W) of the direction: a beam need not be round, nor point forwards."""
    v = np.linspace(-1.0, 1.0, shape[0])[:, None]
    u = np.linspace(-1.0, 1.0, shape[1])[None, :]
    degrees = range(_DEGREE + 1)
    return [u**i * v**j for i in degrees for j in degrees if 0 < i + j <= _DEGREE]
