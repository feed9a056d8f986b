"""The noise model from repeated frames: variances of single pixels against their amplitude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import response_of
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.frame import Settings
from rim_camera_ros.noise import Noise

Array = NDArray[Any]

#: Number of classes of amplitude, least number of values in a class, and least number of classes for a fit.
CLASSES = 32
LEAST_VALUES = 200
LEAST_CLASSES = 4
#: Ratio of an amplitude to its noise above which the noise of the distance is normally distributed.
LEAST_RATIO = 8.0
#: Relative RMS of the classes about the model above which the form of the model is in doubt.
POOR = 0.10
#: ... and below which the model of the file is kept.
CLOSE = 0.015


@dataclass(frozen=True)
class NoiseClass:
    """Pixels of similar amplitude [counts]: 1-sigma of one distance [m], its error, and the model's value."""

    amplitude: float
    sigma: float
    error: float
    model: float
    values: int


@dataclass(frozen=True)
class NoiseFit:
    """The fitted model, its classes, how well it describes them (relative RMS), and what it was before.

    ``confirmed``: the model of the file describes the variances within their errors, and is kept. ``common``
    is the variation from frame to frame that all pixels share, chi-square per degree of freedom (1: none;
    None: unknown).
    """

    noise: Noise
    before: Noise
    classes: tuple[NoiseClass, ...]
    misfit: float
    confirmed: bool
    common: float | None


def fit_noise(dataset: Dataset, camera: Camera) -> NoiseFit | None:
    """Fit sigma^2 = floor^2 + shot^2 / A + (amplitude / A)^2 to the variances of repeated frames.

    A pixel's variance over n frames scatters by a chi-square distribution of n - 1 degrees of freedom. In
    each class of amplitude the median variance, divided by that distribution's median, estimates the
    variance: half of the pixels may be outliers. The classes are weighted by that estimator's error. The
    variance by rounding to counts is subtracted.

    Returns None without repeated frames, or where there are too few values or classes.
    """
    amplitude, variance, freedom = _variances(dataset, camera)
    if amplitude.size < LEAST_VALUES * LEAST_CLASSES:
        return None
    edges = np.quantile(np.log(amplitude), np.linspace(0, 1, CLASSES + 1))
    number = np.clip(np.searchsorted(edges, np.log(amplitude), side="right") - 1, 0, CLASSES - 1)
    rounding = camera.sensor.lsb**2 / 12
    found = []
    for k in range(CLASSES):
        mine = number == k
        if mine.sum() < LEAST_VALUES:
            continue
        medians, errors = _medians(freedom[mine])
        level = float(np.median(variance[mine] / medians)) - rounding
        error = level * float(np.sqrt(np.mean(errors**2) / mine.sum()))
        found.append((float(np.exp(np.mean(np.log(amplitude[mine])))), level, error, int(mine.sum())))
    found = [values for values in found if values[1] > 0]
    if len(found) < LEAST_CLASSES:
        return None
    a, level, error = np.array([values[:3] for values in found]).T
    old = camera.sigma_distance(a) ** 2
    deviation = float(np.sum(((level - old) / error) ** 2))
    departs = float(np.sqrt(np.mean((np.sqrt(level / old) - 1) ** 2)))
    confirmed = deviation < len(a) + 3 * float(np.sqrt(2 * len(a))) or departs < CLOSE
    noise = camera.noise if confirmed else _fitted(a, level, error, camera)
    model = noise.sigma_distance(a, background=camera.background) ** 2
    common = [station.common for station in dataset.stations if station.common is not None]
    return NoiseFit(
        noise=noise,
        before=camera.noise,
        classes=tuple(
            NoiseClass(x, float(np.sqrt(y)), float(e / (2 * np.sqrt(y))), float(np.sqrt(m)), n)
            for (x, y, e, n), m in zip(found, model, strict=True)
        ),
        misfit=float(np.sqrt(np.mean((np.sqrt(level / model) - 1) ** 2))),
        confirmed=confirmed,
        common=float(np.median(common)) if common else None,
    )


def relative_variance(camera: Camera, amplitude: Array, distance: Array, settings: Settings) -> Array:
    """Return the ratio [-] of the variance of distances to that by the noise section (amplitudes alone)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        plain = camera.sigma_distance(amplitude)
        whole = camera.sigma_distance(amplitude, distance=distance, settings=settings)
        return np.asarray((whole / plain) ** 2)


def _variances(dataset: Dataset, camera: Camera) -> tuple[Array, Array, Array]:
    """Return amplitudes, variances and degrees of freedom of the pixels that were valid in every frame."""
    threshold = max(camera.sensor.amplitude_threshold, camera.minimum_amplitude or 0.0)
    response = response_of(camera)
    parts: list[tuple[Array, Array, Array]] = []
    for station in dataset.stations:
        if station.frames < 2:
            continue
        good = (
            (station.count == station.frames)
            & (station.saturated == 0)
            & np.isfinite(station.distance_variance)
        )
        level = station.amplitude.astype(float)
        spread = np.sqrt(np.maximum(station.amplitude_variance, 0))
        good &= (level > 0) & (level > threshold + LEAST_RATIO * np.nan_to_num(spread))
        if response is not None:
            level = np.asarray(response.expanded(level))
        relative = relative_variance(camera, level, station.distance, station.settings)
        variance = station.distance_variance[good].astype(float) / relative[good]
        parts.append((level[good], variance, (station.count[good] - 1.0)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    amplitude, variance, freedom = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return amplitude, variance, freedom


def _medians(freedom: Array) -> tuple[Array, Array]:
    """Return the median of chi-square over its degrees of freedom, and the relative error of a sample median.

    The error is that for a sample of one: 1 / (2 f(m) m) with the density f at the median m.
    """
    kinds, place = np.unique(freedom, return_inverse=True)
    median = np.asarray(chi2.median(kinds), float)
    return (median / kinds)[place], (0.5 / (chi2.pdf(median, kinds) * median))[place]


def _fitted(amplitude: Array, level: Array, error: Array, camera: Camera) -> Noise:
    """Fit the squares of the three parameters by weighted non-negative least squares.

    Where the terms are not distinguishable (over a narrow range of amplitudes), the old model is scaled as a
    whole.
    """
    columns = np.stack([np.ones_like(amplitude), 1 / amplitude, 1 / amplitude**2], axis=1)
    weight = 1 / np.maximum(error, 1e-3 * level)
    shape = camera.sigma_distance(amplitude) ** 2
    if np.ptp(np.log(amplitude)) < np.log(2.0):
        factor = float(np.sqrt(np.average(level / shape, weights=(shape * weight) ** 2)))
        old = camera.noise
        return replace(
            old, floor=old.floor * factor, shot=old.shot * factor, amplitude=old.amplitude * factor
        )
    for _ in range(5):
        scaled = columns * weight[:, None]
        size = np.linalg.norm(scaled, axis=0)
        solution, _ = nnls(scaled / size, level * weight)
        solution = solution / size
        # an outlying class is due to something else than noise
        z = np.abs(columns @ solution - level) * weight
        limit = 3 * max(float(np.median(z)) * 1.4826, 1.0)
        weight = weight * np.where(z > limit, limit / np.maximum(z, 1e-12), 1.0)
    floor, shot, slope = np.sqrt(np.maximum(solution, 0.0))
    slope = float(np.sqrt(max(slope**2 - shot**2 * camera.background, 0.0)))
    return replace(camera.noise, floor=float(floor), shot=float(shot), amplitude=slope)
