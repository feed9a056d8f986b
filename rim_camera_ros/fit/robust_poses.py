"""Robust residuals: after errors of poses and offsets of pixels by a loss that gross values hardly pull.

In the adjustment a value beyond `fit.residuals.ROBUST_LIMIT` sigmas still counts as one of so many. A hand
over a tenth of a board has hundreds of them: they tilt the board's pose and move the offsets of pixels that
see the hand in several poses. Here Huber's loss (1964) is linear beyond one sigma, nearly least absolute
deviations. Weights are those of iteratively reweighted least squares (Holland and Welsch, 1977).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.prediction import Prediction

Array = NDArray[Any]

#: Times that poses and offsets are estimated in turn, and weights computed anew in each.
_TURNS, _WEIGHTINGS = 3, 10
#: Least number of stations by which the offset of a pixel is estimated.
_LEAST_STATIONS = 4


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a station's pose (K,) as estimated, their 1-sigma priors, and derivatives [1/unit].

    ``columns`` (K, N) are those of the distances of the N pixels ``used`` (H, W), in their sigmas.
    """

    used: NDArray[np.bool_]
    columns: Array
    values: Array
    priors: Array

    @classmethod
    def of(cls, prediction: Prediction, nuisances: Mapping[str, float]) -> PoseErrors:
        """Return those of a prediction, with their values among the nuisances of its fit."""
        station, inner, used = prediction.station, prediction.inner, prediction.used
        window: Any = ... if inner.context.window is None else inner.context.window
        columns = []
        for column in inner.pose_columns:
            image = np.zeros(used.shape)
            image[window] = inner.pose_change(column)[0]
            columns.append((image[used] / prediction.sigma[used]).astype(np.float32))
        keys = [f"{station.recording}.{station.placed}.{column.path}" for column in inner.pose_columns]
        return cls(
            used=used,
            columns=np.array(columns, np.float32).reshape(len(columns), int(used.sum())),
            values=np.array([nuisances.get(key, 0.0) for key in keys]),
            priors=np.array([column.prior for column in inner.pose_columns]),
        )

    def changes(self, z: Array) -> Array:
        """Return the robust changes (K,) of the errors by residuals (N,) in sigmas."""
        result = np.zeros(len(self.values))
        weight = self.priors**-2.0
        for _ in range(_WEIGHTINGS if result.size else 0):
            weighted = self.columns / np.maximum(1.0, np.abs(z - result @ self.columns))
            normal = weighted @ self.columns.T + np.diag(weight)
            result = np.linalg.lstsq(normal, weighted @ z - weight * self.values, rcond=None)[0]
        return result


def robust_residuals(
    residuals: Sequence[Array], sigmas: Sequence[Array], poses: Sequence[PoseErrors]
) -> list[Array]:
    """Return the residuals (H, W) [m] of stations after robust errors of poses and offsets of pixels.

    ``residuals`` are those after the errors and offsets of a fit; where a pixel is not used they are kept.
    """
    if not residuals:
        return []
    offset = np.zeros_like(residuals[0])
    for _ in range(_TURNS):
        moved = [np.array(image) for image in residuals]
        for image, sigma, errors in zip(moved, sigmas, poses, strict=True):
            used = errors.used
            image[used] -= errors.changes((image - offset)[used] / sigma[used]) @ errors.columns * sigma[used]
        offset = _offsets(moved, sigmas, [errors.used for errors in poses]).astype(offset.dtype)
    return [
        np.where(errors.used, image - offset, image).astype(image.dtype)
        for image, errors in zip(moved, poses, strict=True)
    ]


def _offsets(residuals: Sequence[Array], sigmas: Sequence[Array], used: Sequence[Array]) -> Array:
    """Return the robust offset [m] of each pixel (H, W); zero where too few stations see it."""
    result = np.zeros(residuals[0].shape)
    enough = np.sum(used, axis=0) >= _LEAST_STATIONS
    seen = np.stack([mask[enough] for mask in used])
    values, sigma = (np.stack([image[enough] for image in images]) for images in (residuals, sigmas))
    found = np.nanmedian(np.where(seen, values, np.nan), axis=0) if seen.size else np.zeros(0)
    for _ in range(_WEIGHTINGS):
        weight = seen / sigma**2 / np.maximum(1.0, np.abs(values - found) / sigma)
        found = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    result[enough] = found
    return result
