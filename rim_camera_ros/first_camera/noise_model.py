"""The noise model of a camera file from variances by amplitude, with the uncertainty of its parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rim_camera_ros.first_camera.repeated import NoiseClass
from rim_camera_ros.noise import Noise

Array = NDArray[np.float64]

#: Least number of classes, and least range of amplitudes (greatest over least), to fit all three parameters.
_LEAST_CLASSES, _LEAST_RANGE = 4, 2.0
#: Number of draws (bootstrap) for the uncertainty.
_DRAWS = 200
#: Least relative error of a class's variance, with any number of values, as pixels differ.
_FLOOR = 0.02


@dataclass(frozen=True)
class NoiseEstimate:
    """The model, 1-sigma of its parameters (floor, shot, amplitude), and the relative RMS of sigma about it.

    ``whole``: all three parameters were fitted. Otherwise the range of amplitudes is too small, and only
    ``amplitude`` was fitted.
    """

    noise: Noise
    sigma: Noise
    misfit: float
    whole: bool


def fit_noise_model(classes: tuple[NoiseClass, ...], *, seed: int = 0) -> NoiseEstimate | None:
    """Fit sigma^2 = floor^2 + shot^2 / A + (amplitude / A)^2 by non-negative least squares.

    The uncertainty comes from fits to classes drawn anew within their errors, which are enlarged where the
    model does not describe them. Returns None without a class.
    """
    if not classes:
        return None
    a = np.array([group.amplitude for group in classes])
    level = np.array([group.variance for group in classes])
    error = np.hypot([group.error for group in classes], _FLOOR * level)
    whole = len(classes) >= _LEAST_CLASSES and a.max() / a.min() >= _LEAST_RANGE
    columns = np.stack([np.ones_like(a), 1 / a, 1 / a**2], axis=1)
    if not whole:
        columns[:, :2] = 0.0
    best = _solved(columns, level, error)
    model = columns @ best
    freedom = max(len(a) - int((best > 0).sum()), 1)
    widened = error * max(1.0, float(np.sqrt(np.sum(((level - model) / error) ** 2) / freedom)))
    rng = np.random.default_rng(seed)
    drawn = [_solved(columns, model + widened * rng.standard_normal(len(a)), error) for _ in range(_DRAWS)]
    spread = np.std(np.sqrt(np.array(drawn)), axis=0)
    misfit = float(np.sqrt(np.mean((np.sqrt(level / np.maximum(model, 1e-30)) - 1) ** 2)))
    floor, shot, slope = (float(one) for one in np.sqrt(best))
    return NoiseEstimate(
        Noise(floor=floor, shot=shot, amplitude=slope),
        Noise(floor=float(spread[0]), shot=float(spread[1]), amplitude=float(spread[2])),
        misfit,
        whole,
    )


def _solved(columns: Array, level: Array, error: Array) -> Array:
    scaled = columns / error[:, None]
    size = np.maximum(np.linalg.norm(scaled, axis=0), 1e-300)
    solution, _ = nnls(scaled / size, level / error)
    result: Array = solution / size
    return np.where(np.linalg.norm(columns, axis=0) > 0, result, 0.0)
