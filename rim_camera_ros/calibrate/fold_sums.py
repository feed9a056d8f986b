"""Sums of a joint fit over the stations of a fold of poses, station by station."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.prediction import Column, Prediction

Array = NDArray[Any]


@dataclass
class Fold:
    """Sums over the stations of one fold of poses.

    ``nuisances``: name, 1-sigma of the prior, and where the equations are linearised (their prior's mean is
    0).
    ``gram`` (M, M) over regressors, this fold's nuisances and the observations (last); ``pixel`` (P, M) and
    ``weight`` (P,) the sums per pixel of the distance channel; ``rows`` the number of observations,
    ``log_sigma`` the sum of their log standard deviations.
    """

    nuisances: list[tuple[str, float, float]]
    gram: Array
    pixel: Array
    weight: Array
    rows: int = 0
    log_sigma: float = 0.0


def _rows(images: Sequence[Array], pixels: Array) -> Array:
    """Return the chosen pixels of images (H, W) as rows (len(images), N), 0 where not finite."""
    rows = np.empty((len(images), pixels.size))
    for row, image in zip(rows, images, strict=True):
        np.take(image, pixels, out=row, mode="clip")
    if not np.isfinite(rows.sum()):
        np.nan_to_num(rows, copy=False, posinf=0.0, neginf=0.0)
    return rows


@dataclass(frozen=True)
class Share:
    """What one station adds to the sums of its fold.

    ``gram`` (M, M) over regressors, the station's nuisances and the observations (last); ``weighted``
    (M, N) the products with the weights of the distances ``weight`` (N,) at the pixels with the flat indices
    ``pixels``; ``nuisances``, ``rows`` and ``log_sigma`` as in `Fold`.
    """

    nuisances: list[tuple[str, float, float]]
    gram: Array
    weighted: Array
    weight: Array
    pixels: Array
    rows: int
    log_sigma: float


def share_of(
    prediction: Prediction,
    columns: Sequence[Column],
    *,
    gain_sigma: float,
    stray_light: float,
    factors: tuple[Array, Array] | None,
) -> Share:
    """Return the share of a station, whose regressors have the ``columns``.

    ``gain_sigma`` (relative) and ``stray_light`` [counts] are the 1-sigma of random effects of the station;
    ``factors`` (H, W) on the weights of both channels.
    """
    pixels, lit = (np.flatnonzero(one) for one in (prediction.used, prediction.amplitude_used))
    nuisances = _nuisances(prediction, gain_sigma, stray_light)
    weight = 1.0 / np.take(prediction.sigma, pixels) ** 2
    weight_a = 1.0 / np.take(prediction.amplitude_sigma, lit) ** 2
    if factors is not None:
        weight = weight * np.take(factors[0], pixels)
        weight_a = weight_a * np.take(factors[1], lit)
    of_distance = [distance for distance, _ in columns]
    of_distance += [distance for *_, distance, _ in nuisances]
    design = _rows([*of_distance, prediction.residual], pixels)
    # a product with its own transpose takes half the time
    root = np.sqrt(weight)
    design *= root
    gram = design @ design.T
    if lit.size:
        of_light = [(i, amplitude) for i, (_, amplitude) in enumerate(columns) if amplitude is not None]
        of_light += [(len(columns) + i, one[-1]) for i, one in enumerate(nuisances)]
        of_light.append((len(design) - 1, prediction.amplitude_residual))
        index = np.array([i for i, _ in of_light])
        light = _rows([amplitude for _, amplitude in of_light], lit)
        light *= np.sqrt(weight_a)
        gram[np.ix_(index, index)] += light @ light.T
    return Share(
        nuisances=[(name, prior, at) for name, prior, at, _, _ in nuisances],
        gram=gram,
        weighted=np.multiply(design, root, out=design),
        weight=weight,
        pixels=pixels,
        rows=len(weight) + len(weight_a),
        log_sigma=-0.5 * float(np.log(weight).sum() + np.log(weight_a).sum()),
    )


class FoldSums:
    """The sums of one fold of poses: of ``count`` regressors, and per pixel in float32 if ``single``.

    ``pattern`` asks for the sums per pixel.
    """

    def __init__(self, count: int, pixels: int, *, single: bool, pattern: bool) -> None:
        self._count = count
        self._type = np.float32 if single else np.float64
        self._with_pattern = pattern
        self._nuisances: dict[str, tuple[float, float]] = {}
        self._gram = np.zeros((count, count))
        self._right = np.zeros(count)
        self._square = 0.0
        self._rows = 0
        self._log_sigma = 0.0
        self._pixel: Array = np.zeros((count, pixels), self._type)
        self._pixel_y: Array = np.zeros(pixels, self._type)
        self._weight: Array = np.zeros(pixels)
        # of each nuisance: products with the regressors, with y, and its sums per pixel
        self._cross: dict[str, Array] = {}
        self._cross_y: dict[str, float] = {}
        self._inner: dict[tuple[str, str], float] = {}
        self._nuisance_pixel: dict[str, Array] = {}

    def add(self, share: Share) -> None:
        """Add a station's share."""
        self._rows += share.rows
        self._log_sigma += share.log_sigma
        self._sum(share.gram, share.nuisances)
        if not self._with_pattern:
            return
        pixels, weighted = share.pixels, share.weighted
        for sums, row in zip(self._pixel, weighted[: self._count], strict=True):
            sums[pixels] += row.astype(self._type, copy=False)
        self._pixel_y[pixels] += weighted[-1].astype(self._type, copy=False)
        self._weight[pixels] += share.weight
        for i, (name, *_) in enumerate(share.nuisances):
            sums = self._nuisance_pixel.setdefault(name, np.zeros(self._weight.size, self._type))
            sums[pixels] += weighted[self._count + i].astype(self._type, copy=False)

    def _sum(self, gram: Array, nuisances: Sequence[tuple[str, float, float]]) -> None:
        count = self._count
        self._gram += gram[:count, :count]
        self._right += gram[:count, -1]
        self._square += gram[-1, -1]
        for i, (name, prior, at) in enumerate(nuisances):
            self._nuisances.setdefault(name, (prior, at))
            self._cross[name] = self._cross.get(name, 0.0) + gram[:count, count + i]
            self._cross_y[name] = self._cross_y.get(name, 0.0) + float(gram[-1, count + i])
            for j, (other, *_) in enumerate(nuisances):
                both = (name, other)
                self._inner[both] = self._inner.get(both, 0.0) + float(gram[count + i, count + j])

    def fold(self) -> Fold:
        """Return the sums so far."""
        pattern = self._with_pattern
        count, names = self._count, list(self._nuisances)
        size = count + len(names) + 1
        gram = np.zeros((size, size))
        gram[:count, :count] = self._gram
        gram[:count, -1] = gram[-1, :count] = self._right
        gram[-1, -1] = self._square
        place = {name: count + i for i, name in enumerate(names)}
        for name in names:
            k = place[name]
            gram[:count, k] = gram[k, :count] = self._cross[name]
            gram[k, -1] = gram[-1, k] = self._cross_y[name]
        for (one, other), value in self._inner.items():
            gram[place[one], place[other]] = value
        pixels = len(self._weight)
        # column by column, as they were summed: turned they would take most of a pass
        pixel = np.zeros((size, pixels if pattern else 1), self._type).T
        if pattern:
            pixel[:, :count] = self._pixel.T
            pixel[:, -1] = self._pixel_y
            for name, sums in self._nuisance_pixel.items():
                pixel[:, place[name]] = sums
        weight = self._weight if pattern else np.zeros(1)
        nuisances = [(name, *self._nuisances[name]) for name in names]
        return Fold(nuisances, gram, pixel, weight, self._rows, self._log_sigma)


#: Name, 1-sigma of the prior, value at the linearisation, derivatives of both channels.
_Nuisance = tuple[str, float, float, Array, Array]


def _nuisances(prediction: Prediction, gain_sigma: float, stray_light: float) -> list[_Nuisance]:
    """Return name, prior, value and both columns of a station's random effects: errors of poses, emitted
    power.
    """
    station = prediction.station
    key = f"{station.recording}.{station.pose}"
    result = []
    for column in prediction.pose_columns:
        if column.path.startswith("scene."):
            continue
        distance, amplitude = prediction.pose_change(column)
        name = f"{station.recording}.{station.placed}.{column.path}"
        result.append((name, column.prior, 0.0, distance, amplitude))
    if gain_sigma > 0:
        distance, amplitude = prediction.gain_column()
        at = float(np.log(prediction.gain))
        result.append((f"{key}.gain", gain_sigma, at, distance, amplitude))
    if stray_light > 0:
        for part, (distance, amplitude) in zip(
            ("real", "imaginary"), prediction.light_columns(), strict=True
        ):
            result.append((f"{key}.light.{part}.{station.stamp}", stray_light, 0.0, distance, amplitude))
    return result
