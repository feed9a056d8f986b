"""The integral calibration (Kahlmann 2007, sec. 3.4): a table of errors by position instead of physics.

Errors of distance over column, row and distance as a tensor product of cubic B-splines with penalised second
differences (P-splines, Eilers & Marx 1996), from the same stations as the joint fit, with the errors of the
poses as random effects and an additional offset per pixel. Its smoothness is chosen by held-out poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.interpolate import BSpline

from rim_camera_ros.calibrate.solution import with_pattern
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import PositionTable
from rim_camera_ros.effects.tables import interpolate
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.parameters import ArrayFile

Array = NDArray[Any]
Key = tuple[int, int]

#: Intervals of the splines over columns and rows; over the distance, their length [m] and greatest number.
_ACROSS = (4, 3)
_ALONG = 0.25
_MOST_ALONG = 20
#: The image is averaged over patches, about so many of them.
_PATCHES = 700
#: Smoothness that is tried, relative to the data's information on a coefficient.
_PENALTIES = tuple(10.0**k for k in range(-6, 3))
#: Step of the table's knots [m], and their greatest number: the time of a correction grows with it.
_STEP = 0.05
_MOST_KNOTS = 48
_DEGREE = 3


@dataclass(frozen=True)
class Axis:
    """Cubic B-splines with equal knots over a range."""

    low: float
    high: float
    intervals: int

    @property
    def count(self) -> int:
        """Number of splines."""
        return self.intervals + _DEGREE

    def values(self, x: Array) -> Array:
        """Return the splines at x (N,), held constant outside, (N, count)."""
        step = (self.high - self.low) / self.intervals
        knots = self.low + step * np.arange(-_DEGREE, self.intervals + _DEGREE + 1)
        inside = np.clip(x, self.low, np.nextafter(self.high, -np.inf))
        return np.asarray(BSpline.design_matrix(inside, knots, _DEGREE).toarray())


@dataclass
class _Fold:
    gram: Array
    right: Array
    square: float


class IntegralFit:
    """Tables from all poses, or from all but a fold of them.

    It takes two passes over the stations: one for the equations of the splines, one for the offsets of pixels
    of each table. ``masks`` (H, W) are the pixels of each station to use; ``tick`` is called for each station
    and may raise to end the work.
    """

    def __init__(
        self,
        forward: Forward,
        folds: Mapping[Key, int],
        masks: Sequence[Array],
        *,
        tick: Callable[[], None] | None = None,
    ) -> None:
        self._forward, self._folds, self._masks = forward, folds, masks
        self._tick = tick if tick is not None else _nothing
        self._camera = with_effects(forward.camera, {})
        self._plain = Forward(forward.dataset, forward.scene, self._camera, views=forward.views)
        low, high = self._range()
        height, width = self._camera.shape
        along = int(np.clip(np.ceil((high - low) / _ALONG), 1, _MOST_ALONG))
        self.axes = (
            Axis(0.0, width - 1.0, _ACROSS[0]),
            Axis(0.0, height - 1.0, _ACROSS[1]),
            Axis(low, high, along),
        )
        self._patch = max(1, round(float(np.sqrt(width * height / _PATCHES))))
        self._accumulate()
        self._penalty = self._penalties()
        self.smoothness = self._chosen()

    def _range(self) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        for prediction, mask in zip(self._predictions(), self._masks, strict=True):
            if mask.any():
                distances = prediction.view.geometry.distance[mask]
                low, high = min(low, float(distances.min())), max(high, float(distances.max()))
        return low, max(high, low + 0.01)

    def _predictions(self) -> Any:
        return self._plain.predictions(AmplitudeModel(tau=1.0), slopes=False)

    # --- equations ------------------------------------------------------------------------------

    def _accumulate(self) -> None:
        count = int(np.prod([axis.count for axis in self.axes]))
        per_pose: dict[Key, tuple[list[Array], list[Array], list[Array], list[Array]]] = {}
        self._equations: dict[int, _Fold] = {}
        waiting: Key | None = None

        def finish(key: Key) -> None:
            number = self._folds.get(key, 0)
            fold = self._equations.setdefault(number, _Fold(np.zeros((count, count)), np.zeros(count), 0.0))
            _add_pose(fold, *(np.concatenate(part) for part in per_pose.pop(key)))

        for prediction, mask in zip(self._predictions(), self._masks, strict=True):
            self._tick()
            key = (prediction.station.recording, prediction.station.pose)
            if waiting is not None and key != waiting and waiting in per_pose:
                finish(waiting)
            waiting = key
            if not mask.any():
                continue
            parts = per_pose.setdefault(key, ([], [], [], []))
            for part, value in zip(parts, self._patches(prediction, mask), strict=True):
                part.append(value)
        for key in list(per_pose):
            finish(key)

    def _patches(self, predicted: Prediction, mask: Array) -> tuple[Array, Array, Array, Array]:
        """Return design (N, K), pose columns (N, 12; mostly 0), residuals and weights of patches."""
        width = mask.shape[1]
        v, u = np.nonzero(mask)
        cell = (v // self._patch) * (-(-width // self._patch)) + u // self._patch
        _, place = np.unique(cell, return_inverse=True)
        weight = 1.0 / predicted.sigma[mask] ** 2
        weight = np.where(np.isfinite(weight), weight, 0.0)
        total = np.bincount(place, weight)
        good = total > 0

        def mean(values: Array) -> Array:
            return np.bincount(place, weight * values)[good] / total[good]

        distance = mean(predicted.view.geometry.distance[mask])
        splines = [axis.values(x) for axis, x in zip(self.axes, (mean(u), mean(v), distance), strict=True)]
        design = np.einsum("ni,nj,nk->nijk", *splines).reshape(len(distance), -1)
        columns = [c for c in predicted.view.pose_columns if not c.path.startswith("scene.")]
        pose = np.zeros((len(distance), _POSE_COLUMNS))
        for i, column in enumerate(columns[:_POSE_COLUMNS]):
            pose[:, i] = column.prior * mean(column.distance[mask])
        return design, pose, mean(predicted.residual[mask]), total[good]

    # --- smoothness -----------------------------------------------------------------------------

    def _penalties(self) -> Array:
        """Return the penalty matrix (K, K): squared second differences along each axis."""
        total: Any = 0.0
        eyes = [np.eye(axis.count) for axis in self.axes]
        for i, axis in enumerate(self.axes):
            difference = np.diff(np.eye(axis.count), n=2, axis=0)
            parts = [*eyes]
            parts[i] = difference.T @ difference
            total = total + np.kron(np.kron(parts[0], parts[1]), parts[2])
        return np.asarray(total)

    def _solve(self, leave_out: int | None, penalty: float) -> Array:
        kept = [equation for number, equation in self._equations.items() if number != leave_out]
        gram = np.sum([fold_sums.gram for fold_sums in kept], axis=0)
        right = np.sum([fold_sums.right for fold_sums in kept], axis=0)
        scale = float(np.trace(gram)) / len(gram)
        matrix = gram + penalty * scale * self._penalty
        matrix[np.diag_indices_from(matrix)] += 1e-9 * scale
        return np.asarray(linalg.solve(matrix, right, assume_a="pos"))

    def _chosen(self) -> float:
        """Return the smoothness with the least chi-square of held-out poses."""
        if len(self._equations) < 2:
            return 1e-3
        best = (np.inf, _PENALTIES[0])
        for penalty in _PENALTIES:
            total = 0.0
            for number, fold in self._equations.items():
                self._tick()
                x = self._solve(number, penalty)
                total += fold.square - 2 * float(fold.right @ x) + float(x @ fold.gram @ x)
            best = min(best, (total, penalty))
        return best[1]

    # --- tables ---------------------------------------------------------------------------------

    def cameras(self, folds: Sequence[int | None]) -> dict[int | None, Camera]:
        """Return for each fold the camera that was made without it; None: from all poses."""
        tables = {fold: self._table(fold) for fold in folds}
        shape = self._camera.shape
        sums = {fold: np.zeros((2, *shape)) for fold in folds}
        grids = {
            fold: (table.knots, np.asarray(table.values.values, float)) for fold, table in tables.items()
        }
        v, u = np.mgrid[: shape[0], : shape[1]]
        for prediction, mask in zip(self._predictions(), self._masks, strict=True):
            self._tick()
            key = (prediction.station.recording, prediction.station.pose)
            number = self._folds.get(key, 0)
            weight = np.where(mask, 1.0 / prediction.sigma**2, 0.0)
            for fold in folds:
                if fold is not None and fold == number and len(self._equations) > 1:
                    continue
                knots, values = grids[fold]
                rest = prediction.residual - interpolate(
                    knots, values, (u, v, prediction.view.geometry.distance)
                )
                sums[fold][0] += np.where(mask, weight * np.nan_to_num(rest), 0.0)
                sums[fold][1] += weight
        result: dict[int | None, Camera] = {}
        for fold, (total, weight) in sums.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                pattern = np.where(weight > 0, total / weight, 0.0)
                # a pixel's mean over poses contains errors of the table as well as noise
                variance = np.where(weight > 0, 1.0 / weight, np.inf)
            camera = with_effects(self._camera, {PositionTable.name: tables[fold]})
            result[fold] = with_pattern(camera, pattern, variance)
        return result

    def _table(self, leave_out: int | None) -> PositionTable:
        x = self._solve(leave_out, self.smoothness).reshape([axis.count for axis in self.axes])
        counts = (2 * _ACROSS[0] + 1, 2 * _ACROSS[1] + 1, self._knots())
        knots = [np.linspace(axis.low, axis.high, n) for axis, n in zip(self.axes, counts, strict=True)]
        splines = [axis.values(knot) for axis, knot in zip(self.axes, knots, strict=True)]
        values = np.einsum("ai,bj,ck,ijk->abc", *splines, x).astype(np.float32)
        return PositionTable(
            knots=tuple(tuple(float(f"{k:.6g}") for k in knot) for knot in knots),
            values=ArrayFile(f"{PositionTable.name}.npy", values),
        )

    def _knots(self) -> int:
        axis = self.axes[2]
        return int(np.clip(np.ceil((axis.high - axis.low) / _STEP) + 1, 2, _MOST_KNOTS))


#: Most errors of poses of a station: offset and two tilts of up to four surfaces.
_POSE_COLUMNS = 12


def _add_pose(fold: _Fold, design: Array, pose: Array, residual: Array, weight: Array) -> None:
    """Add one pose to a fold's equations, its errors (in units of their priors) eliminated."""
    weighted = design * weight[:, None]
    cross = pose.T @ weighted
    inner = pose.T @ (pose * weight[:, None]) + np.eye(pose.shape[1])
    right = pose.T @ (weight * residual)
    factor = linalg.cho_factor(inner)
    solved = linalg.cho_solve(factor, cross)
    fold.gram += design.T @ weighted - cross.T @ solved
    fold.right += weighted.T @ residual - solved.T @ right
    fold.square += float(residual @ (weight * residual) - right @ linalg.cho_solve(factor, right))


def _nothing() -> None:
    return None
