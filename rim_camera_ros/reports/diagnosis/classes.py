"""Means over classes of a covariate, and the region that holds most of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.diagnosis.evidence import Samples

Array = NDArray[Any]


@dataclass(frozen=True)
class Bins:
    """Classes of a covariate: its mean in each, ``means`` of some values and their standard ``errors``."""

    x: Array
    means: tuple[Array, ...]
    errors: tuple[Array, ...]


def binned(
    x: Array,
    values: Sequence[Array],
    *,
    weight: Array,
    station: Array,
    count: int = 16,
    by_size: bool = False,
) -> Bins:
    """Return weighted means of some values over classes of a covariate of equal population.

    ``by_size`` makes the classes of equal width in the square root of the covariate's size instead, which
    separates the few large values of an effect that is small nearly everywhere. The standard errors are the
    greater of those from the scatter between stations and between pixels: the residuals of one image are not
    independent.
    """
    good = np.isfinite(x) & np.all([np.isfinite(v) for v in values], axis=0)
    x, weight, station = x[good], weight[good], station[good]
    different = np.unique(x[:: max(1, x.size // 4000)])
    if different.size <= count:
        different = np.unique(x)
    if different.size <= count:
        place = np.searchsorted(different, x)
    elif by_size:
        root = np.sign(x) * np.sqrt(np.abs(x))
        low, high = np.quantile(root, [0.001, 0.999])
        place = np.searchsorted(np.linspace(low, high, count + 1)[1:-1], root, side="right")
    else:
        edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)[1:-1]))
        place = np.searchsorted(edges, x, side="right")
    size = int(place.max()) + 1 if place.size else 0
    total = np.bincount(place, weight, size)
    own = np.bincount(place, minlength=size) >= 30
    safe = np.where(total > 0, total, 1.0)
    means, errors = [], []
    for image in values:
        v = image[good]
        mean = np.bincount(place, weight * v, size) / safe
        means.append(mean[own])
        errors.append(_standard_error(v - mean[place], place, weight, station, safe)[own])
    return Bins((np.bincount(place, weight * x, size) / safe)[own], tuple(means), tuple(errors))


def _standard_error(rest: Array, place: Array, weight: Array, station: Array, total: Array) -> Array:
    size = len(total)
    pixels = np.sqrt(np.bincount(place, weight**2 * rest**2, size)) / total
    stations = int(station.max(initial=0)) + 1
    pair = place * stations + station
    sums = np.bincount(pair, weight * rest, size * stations).reshape(size, stations)
    number = (np.bincount(pair, minlength=size * stations).reshape(size, stations) > 0).sum(axis=1)
    scatter = np.sqrt((sums**2).sum(axis=1) * number / np.maximum(number - 1, 1)) / total
    return np.asarray(np.where(number >= 3, np.maximum(pixels, scatter), pixels))


def explained(samples: Samples, values: Array) -> list[tuple[str, float]]:
    """Return the covariates by the share of the variance of some values that their classes explain."""
    found = []
    thinned = slice(None, None, max(1, values.size // 20000))
    values, weight = values[thinned], samples.weight[thinned]
    for name, everything in samples.covariates.items():
        x = everything[thinned]
        good = np.isfinite(x) & np.isfinite(values)
        if not good.any() or np.ptp(x[good]) <= 0:
            continue
        v, w, c = values[good], weight[good], x[good]
        edges = np.unique(np.quantile(c, np.linspace(0, 1, 17)[1:-1]))
        place = np.searchsorted(edges, c, side="right")
        total = np.bincount(place, w)
        means = np.bincount(place, w * v) / np.maximum(total, 1e-300)
        overall = float(np.average(v, weights=w))
        variance = float(np.average((v - overall) ** 2, weights=w))
        if variance > 0:
            found.append((name, float(np.sum(total * (means - overall) ** 2) / total.sum()) / variance))
    return sorted(found, key=lambda item: -item[1])


def region(pixels: Array, share: float = 0.9) -> NDArray[np.bool_]:
    """Return the smallest set of pixels (H, W) that holds a share of the sum."""
    flat = np.nan_to_num(np.asarray(pixels, float)).ravel()
    if flat.sum() <= 0:
        return np.zeros(np.shape(pixels), bool)
    order = np.argsort(-flat, kind="stable")
    needed = int(np.searchsorted(np.cumsum(flat[order]), share * flat.sum())) + 1
    chosen = np.zeros(flat.size, bool)
    chosen[order[:needed]] = True
    return chosen.reshape(np.shape(pixels))
