"""Limits of the parameters of an adjustment: their bounds, and the longest step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import lsq_linear

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.effects import Effect, known_effects
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import GAIN

Array = NDArray[Any]

#: Sigmas by which the data exceed the bound of a parameter above which this is not due to noise.
BEYOND_POSSIBLE = 3.0
#: Relative change of a width or a lag in one step.
_SHAPE_STEP = 0.25
#: Share of a station's values below whose amplitude a pole of a term may lie.
_DARKEST = 0.01
#: Share by which a parameter stays inside a bound greater than 0 that it may not reach, and the rounding
#: error of a value that is the sum of its start and a step, as a share of a bound.
_INSIDE, _ROUNDING = 1e-9, 1e-12


@dataclass(frozen=True)
class Bounds:
    """The least and the greatest possible values of parameters, by path; ``shape`` (H, W) of the array."""

    lows: Mapping[str, float]
    highs: Mapping[str, float]
    shape: tuple[int, int]

    @classmethod
    def of(cls, camera: Camera) -> Bounds:
        """Return the bounds that the effects of a camera state."""
        lows: dict[str, float] = {}
        highs: dict[str, float] = {}
        for name, effect in camera.effects.items():
            for path, (low, high) in effect.bounds().items():
                lows[f"effects.{name}.{path}"], highs[f"effects.{name}.{path}"] = low, high
        return cls(lows, highs, camera.shape)

    @classmethod
    def of_data(cls, dataset: Dataset, masks: Sequence[tuple[Array, Array]] | None, camera: Camera) -> Bounds:
        """Return the bounds of a camera's effects that the amplitudes in use allow."""
        stated = cls.of(camera)
        if masks is None:
            return stated
        darkest = [
            (
                camera.integration_time(station.settings),
                float(np.quantile(station.amplitude[used], _DARKEST)),
            )
            for station, (used, _) in zip(dataset.stations, masks, strict=True)
            if used.any()
        ]
        greatest = {
            f"effects.{name}.{path}": value
            for name, effect in camera.effects.items()
            for path, value in effect.greatest(darkest).items()
        }
        return replace(stated, highs={**stated.highs, **greatest})

    def range_of(self, path: str, begun: float) -> tuple[float, float]:
        """Return the least and the greatest value that a parameter may take in a fit that ``begun`` there."""
        low, high = self.lows.get(path, -np.inf), self.highs.get(path, np.inf)
        owner, inner = _owner(path)
        if owner is not None:
            least, most = owner.reach(inner, begun, self.shape)
            low, high = max(low, least), min(high, most)
        return low + _margin(low), high

    def step_limits(
        self,
        labels: Sequence[str],
        offsets: Mapping[str, float],
        numbers: Mapping[str, float],
        shape: tuple[int, int],
    ) -> tuple[Array, Array]:
        """Return how far parameters may go down (not above 0) and up in one step, (K,) each.

        ``offsets`` are those of the parameters from the ``numbers`` that the fit began with.
        """
        up = longest_steps(labels, offsets, numbers, shape)
        down = -up
        for i, path in enumerate(labels):
            if path in numbers and path != GAIN:
                at = numbers[path] + offsets.get(path, 0.0)
                low, high = self.range_of(path, numbers[path])
                down[i], up[i] = max(down[i], min(low - at, 0.0)), min(up[i], max(high - at, 0.0))
        return down, up

    def open_sides(self, labels: Sequence[str], camera: Camera) -> tuple[Array, Array]:
        """Return how far parameters (K,) of a camera may go down and up: 0 where they are at a bound."""
        values = camera_numbers(camera)
        down, up = np.full(len(labels), -np.inf), np.full(len(labels), np.inf)
        for i, label in enumerate(labels):
            if label in values:
                low, high = self.lows.get(label, -np.inf), self.highs.get(label, np.inf)
                down[i] = 0.0 if values[label] <= low + 2 * _margin(low) + _rounding(low) else -np.inf
                up[i] = 0.0 if values[label] >= high - _rounding(high) else np.inf
        return down, up


def least_within(matrix: Array, right: Array, down: Array, up: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Minimise x' matrix x / 2 - right' x within ``down`` and ``up``: return x (K,), and which are at bounds.

    The other parameters are optimal given those at a bound (Stark & Parker 1995). Raises `LinAlgError` for a
    matrix (K, K) that is not positive definite.
    """
    if not len(right):  # scipy 1.11 solves no empty equations
        return right, np.zeros(0, bool)
    # in units in which the diagonal is 1: parameters differ by many orders of magnitude
    unit = np.sqrt(np.diag(matrix))
    factor = linalg.cholesky(matrix / np.outer(unit, unit), lower=True, check_finite=False)
    side = linalg.solve_triangular(factor, right / unit, lower=True, check_finite=False)
    step = linalg.solve_triangular(factor, side, lower=True, trans="T", check_finite=False) / unit
    inside = (down <= step) & (step <= up)
    if inside.all() or not np.all(np.isfinite(step)):
        return step, np.zeros(len(step), bool)
    found = lsq_linear(factor.T, side, bounds=(down * unit, up * unit), method="bvls")
    return np.clip(found.x / unit, down, up), found.active_mask != 0


def sigmas_beyond(matrix: Array, right: Array, step: Array, held: NDArray[np.bool_]) -> dict[int, float]:
    """Return by how many sigmas each held parameter would move if it were free jointly with the free ones.

    The square of it is the decrease of chi-square by this parameter.
    """
    free = np.flatnonzero(~held)
    result = {}
    for i in np.flatnonzero(held):
        own = np.r_[free, i]
        unit = np.sqrt(np.diag(matrix)[own])
        among = linalg.inv(matrix[np.ix_(own, own)] / np.outer(unit, unit), check_finite=False)
        sigma = np.sqrt(among[-1, -1]) / unit[-1]
        result[int(i)] = float(abs(right[i] - matrix[i] @ step) * sigma)
    return result


def longest_steps(
    labels: Sequence[str],
    offsets: Mapping[str, float],
    numbers: Mapping[str, float],
    shape: tuple[int, int],
) -> Array:
    """Return how far parameters may go in one step: shapes by a quarter, others as their effects state.

    ``shape`` (H, W) of the array.
    """

    def longest(path: str) -> float:
        owner, inner = _owner(path)
        if owner is None:
            return np.inf
        if owner.is_shape(inner):
            return _SHAPE_STEP * max(abs(numbers[path] + offsets.get(path, 0.0)), 1e-9)
        return owner.longest_step(inner, shape)

    return np.array([longest(path) for path in labels], float)


def of_shape(path: str) -> bool:
    """Whether a parameter is a shape: a width or a lag, in which readings are far from linear."""
    owner, inner = _owner(path)
    return owner is not None and owner.is_shape(inner)


def _owner(path: str) -> tuple[type[Effect] | None, str]:
    """Return the effect (None: none) to which a dotted path of a camera file belongs, and its inner path."""
    name, _, inner = path.removeprefix("effects.").partition(".")
    return (known_effects().get(name) if path.startswith("effects.") else None), inner


def _margin(low: float) -> float:
    """Return by how much a parameter stays above its lower bound; 0 where that is not above 0."""
    return _INSIDE * max(low, 1.0) if np.isfinite(low) and low > 0 else 0.0


def _rounding(bound: float) -> float:
    return _ROUNDING * abs(bound) if np.isfinite(bound) else 0.0
