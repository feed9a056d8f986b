"""Sums of a joint fit over the stations of a fold of poses, station by station."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.candidate import Column, Groups
from rim_camera_ros.fit.channels import Channel, Products, channel_of
from rim_camera_ros.fit.pixel_sums import PixelSums
from rim_camera_ros.fit.prediction import Prediction, random_effects
from rim_camera_ros.fit.residuals import beyond_limit

Array = NDArray[Any]


@dataclass
class Fold:
    """Sums over the stations of one fold of poses.

    ``nuisances`` are name, 1-sigma of the prior (its mean is 0), and the point of linearisation of each.
    ``gram`` (M, M) are the products over regressors, this fold's nuisances and the observations (last).
    The others are sums for each of the P pixels that were seen: ``pixel`` (P, M) of the products with its
    offset, ``weight`` (P,) of the offset with itself; ``gain`` (P, M) of those with its relative gain, in
    both channels (None: gains are known), ``gain_weight`` (P,) of the gain with itself, ``cross`` (P,) of
    gain and offset. ``rows`` is the number of observations, ``expected`` the expected sum of their squares
    (None: as many), ``log_sigma`` the sum of the logarithms of their standard deviations, ``robust`` the
    excess of a robust loss over the squares and these logarithms.
    """

    nuisances: list[tuple[str, float, float]]
    gram: Array
    pixel: Array
    weight: Array
    rows: int = 0
    log_sigma: float = 0.0
    gain: Array | None = None
    gain_weight: Array | None = None
    cross: Array | None = None
    expected: float | None = None
    robust: float = 0.0

    def errors_given(self, values: Array, offsets: Array, gains: Array | None) -> dict[str, float]:
        """Return the nuisances given regressors (K,), offsets and gains of pixels (P,) from another fit.

        Errors that poses share and offsets of pixels can compensate each other: errors from a fit with other
        offsets would leave the difference of the two in the residuals.
        """
        own = slice(len(values), len(values) + len(self.nuisances))
        prior = np.array([sigma**-2 for _, sigma, _ in self.nuisances])
        at = np.array([start for *_, start in self.nuisances])
        right = self.gram[own, -1] - self.gram[own, : len(values)] @ values - prior * at
        right -= self.pixel[:, own].T @ offsets
        if gains is not None and self.gain is not None:
            right -= self.gain[:, own].T @ gains
        found = np.linalg.solve(self.gram[own, own] + np.diag(prior), right)
        return {name: float(e) for (name, *_), e in zip(self.nuisances, found, strict=True)}


@dataclass(frozen=True)
class Share:
    """The contribution of one station to the sums of its fold.

    ``gram`` (M, M) is over regressors, the station's nuisances and the observations (last); ``offsets`` are
    the products with offsets of pixels, whose weights are ``weight`` (N,) at ``pixels``; ``nuisances``,
    ``rows`` and ``log_sigma`` as in `Fold`. ``gain`` are the sums with gains of pixels, None where they are
    known.
    """

    nuisances: list[tuple[str, float, float]]
    gram: Array
    offsets: Products
    weight: Array
    pixels: Array
    rows: int
    expected: float
    log_sigma: float
    gain: GainShare | None = None
    robust: float = 0.0


@dataclass(frozen=True)
class GainShare:
    """Products of a station's columns with the relative gain of each pixel, in each channel.

    ``weight`` (N,) and ``light_weight`` (N',) of the gain itself, ``cross`` (N,) of gain and offset.
    """

    distance: Products
    weight: Array
    cross: Array
    light: Products
    light_weight: Array


def share_of(
    prediction: Prediction,
    columns: Sequence[Column | None],
    *,
    gain_sigma: float,
    stray_light: float,
    factors: tuple[Array, Array] | None,
    gains: bool = False,
    groups: tuple[int, Groups] | None = None,
) -> Share:
    """Return the contribution of a station; regressors have the ``columns``, or are in ``groups`` (None).

    ``gain_sigma`` (relative) and ``stray_light`` [counts] are the 1-sigma of random effects of the station;
    ``factors`` (H, W) multiply the weights of both channels. With ``gains`` the gain of each pixel is
    unknown.
    """
    pixels, lit = (np.flatnonzero(mask) for mask in (prediction.used, prediction.amplitude_used))
    nuisances = random_effects(prediction, gain_sigma=gain_sigma, stray_light=stray_light)
    weight = 1.0 / np.take(prediction.sigma, pixels) ** 2
    weight_a = 1.0 / np.take(prediction.amplitude_sigma, lit) ** 2
    shared = (prediction.amplitude_share, prediction.amplitude_freedom)
    share, freedom = (np.take(image, lit) for image in shared)
    # noise within patches, as a response scales it (no response may gain by that), less its expected squares
    log_within = (1.0 - share) * freedom @ (np.log(np.take(prediction.slope_published, lit)) - 0.5)
    robust = 0.0
    if factors is not None:
        factor, factor_a = np.take(factors[0], pixels), np.take(factors[1], lit)
        weight, weight_a = weight * factor, weight_a * factor_a
        # the factors are of a robust loss: they do not change the standard deviations
        robust = beyond_limit(factor) + beyond_limit(factor_a)
        robust += float(np.log(factor).sum() + (share * np.log(factor_a)).sum())
    size = len(columns) + len(nuisances) + 1
    own = [(i, *column) for i, column in enumerate(columns) if column is not None]
    own += [(len(columns) + i, nuisance[3], nuisance[4]) for i, nuisance in enumerate(nuisances)]
    of_distance = [(i, distance) for i, distance, _ in own]
    of_light = [(i, amplitude) for i, _, amplitude in own if amplitude is not None]
    of_distance.append((size - 1, prediction.residual))
    of_light.append((size - 1, prediction.amplitude_residual))
    distances = channel_of(prediction.places(pixels), weight, of_distance, groups, light=False)
    light = channel_of(prediction.places(lit), weight_a, of_light, groups, light=True)
    gram = np.zeros((size, size))
    for channel in (distances, light):
        channel.add_to(gram)
    return Share(
        nuisances=[(name, prior, at) for name, prior, at, _, _ in nuisances],
        gram=gram,
        offsets=distances.times(np.ones(pixels.size)),
        weight=weight,
        pixels=pixels,
        rows=len(weight) + round(float(share.sum())),
        expected=len(weight) + float(freedom.sum()),
        log_sigma=float(log_within - 0.5 * (np.log(weight).sum() + share @ np.log(weight_a))),
        gain=_gain_share(prediction, distances, light) if gains else None,
        robust=robust,
    )


def _gain_share(prediction: Prediction, distances: Channel, light: Channel) -> GainShare:
    by_distance, by_amplitude = prediction.inner.pixel_gain_column()
    slope = np.nan_to_num(prediction.places(distances.pixels).take(by_distance))
    factor = np.nan_to_num(prediction.places(light.pixels).take(by_amplitude))
    weight = distances.root**2
    return GainShare(
        distance=distances.times(slope),
        weight=weight * slope**2,
        cross=weight * slope,
        light=light.times(factor),
        light_weight=(light.root * factor) ** 2,
    )


class FoldSums:
    """Accumulates the sums of one fold of poses, over ``count`` regressors.

    ``pattern`` requests the sums per pixel, ``gains`` those with the gains of pixels. ``rows`` (H W,) is the
    row of each pixel in these sums (-1: none), which have ``pixels`` rows. ``stations`` is the expected
    number of stations.
    """

    def __init__(
        self,
        count: int,
        pixels: int,
        *,
        rows: Array,
        pattern: bool,
        gains: bool = False,
        stations: int = 1,
    ) -> None:
        self._count, self._rows_of, self._stations = count, rows, stations
        self._nuisances: dict[str, tuple[float, float]] = {}
        self._gram = np.zeros((count, count))
        self._right = np.zeros(count)
        self._square = 0.0
        self._rows, self._expected = 0, 0.0
        self._log_sigma = self._robust = 0.0
        self._pixel = PixelSums(count, pixels, rows) if pattern else None
        self._weight: Array = np.zeros(pixels if pattern else 1)
        self._gain = PixelSums(count, pixels, rows) if pattern and gains else None
        self._gain_weight: Array = np.zeros(pixels)
        self._gain_cross: Array = np.zeros(pixels)
        # for each nuisance the products with the regressors, and with the observations y
        self._cross: dict[str, Array] = {}
        self._cross_y: dict[str, float] = {}
        self._inner: dict[tuple[str, str], float] = {}

    def add(self, share: Share) -> None:
        """Add a station's share."""
        self._rows += share.rows
        self._expected += share.expected
        self._log_sigma += share.log_sigma
        self._robust += share.robust
        self._sum(share.gram, share.nuisances)
        if self._pixel is None:
            return
        number = {name: self._count + i for i, name in enumerate(self._nuisances)}
        places = [*range(self._count), *(number[name] for name, *_ in share.nuisances)]
        rows = self._rows_of[share.pixels]
        most = self._count + len(share.nuisances) * self._stations + 1
        for sums in (self._pixel, self._gain):
            if sums is not None:
                sums.make_room(most)
        self._weight[rows] += share.weight
        self._pixel.add(share.offsets, places)
        if share.gain is not None and self._gain is not None:
            gain = share.gain
            for part in (gain.distance, gain.light):
                self._gain.add(part, places)
            self._gain_weight[rows] += gain.weight
            self._gain_weight[self._rows_of[gain.light.channel.pixels]] += gain.light_weight
            self._gain_cross[rows] += gain.cross

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
        """Return the sums; no station may be added after this."""
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
        for (name, other), value in self._inner.items():
            gram[place[name], place[other]] = value
        pixel = np.zeros((1, size)) if self._pixel is None else self._pixel.all(size)
        nuisances = [(name, *self._nuisances[name]) for name in names]
        fold = Fold(
            nuisances,
            gram,
            pixel,
            self._weight,
            self._rows,
            self._log_sigma,
            expected=self._expected,
            robust=self._robust,
        )
        if self._gain is not None:
            fold.gain = self._gain.all(size)
            fold.gain_weight, fold.cross = self._gain_weight, self._gain_cross
        return fold
