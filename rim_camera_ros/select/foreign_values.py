"""Values of pixels that do not see the surfaces of the scene: defective pixels, and objects before surfaces.

A physical effect changes neighbouring pixels of one tile alike. A pixel that differs from its neighbours in
most of its poses, far in one, or from frame to frame, is defective: stuck, or noisier than the others. A
region that ends within a tile by a step is another object: a hand, a cable, a clamp. So is one that covers a
tile which is as it should be in nearly all other poses. Both are found in the residuals of a fit, and
excluded. What many values of a pose show is physics: such a pose is not judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.pose_errors import WIDER
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.robust_poses import PoseErrors, robust_residuals
from rim_camera_ros.fit.variance_components import WILD
from rim_camera_ros.select.thresholds import FEW, STANDARD_ERRORS, noise_limit

Array = NDArray[Any]
Mask = NDArray[np.bool_]

#: Times that a recording is fitted anew without such values: the grossest hide others.
MOST_ROUNDS = 4
#: Least number of values by which one is judged: neighbours of a pixel, poses, frames, pixels of a region.
_LEAST = 4
#: Pixels around an object that it may partly cover, and pixels between its parts, as those beside edges.
_AROUND = 2
#: Share of the deviation of a region that must end at its outline. An object ends within a pixel: outside
#: nothing deviates, to a tenth; nor do its pixels, and tiles that it covers, in nearly all other poses. What
#: follows from light, distance or amplitude goes on there.
STEP = 0.9


@dataclass(frozen=True)
class ForeignValues:
    """Values to exclude: ``masks`` (H, W) by the number of the station.

    ``pixels`` is the number of defective pixels. An object before a surface takes a ``share`` of all values
    used, at ``stamps`` (recording, [ns]).
    """

    masks: Mapping[int, Mask]
    pixels: int
    stamps: frozenset[tuple[int, int]]
    share: float

    def excluded_from(self, dataset: Dataset) -> Dataset:
        """Return the dataset without these values."""
        stations = [
            station if number not in self.masks else station.without(self.masks[number])
            for number, station in enumerate(dataset.stations)
        ]
        return replace(dataset, stations=stations)

    def kept(self, masks: Sequence[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
        """Return the pixels to fit, (H, W) each by station for distance and amplitude, without these."""
        return [
            (used & ~self.masks[number], lit & ~self.masks[number]) if number in self.masks else (used, lit)
            for number, (used, lit) in enumerate(masks)
        ]


def exclusion_notes(found: Sequence[ForeignValues]) -> list[str]:
    """Return in words what was excluded in several rounds, which may be on different grids."""
    result = []
    pixels, share = sum(each.pixels for each in found), sum(each.share for each in found)
    stamps = frozenset[tuple[int, int]]().union(*(each.stamps for each in found))
    if pixels:
        result.append(
            f"excluded: defective pixels ({pixels}), which differ from their neighbours by more than noise, "
            "from pose to pose or from frame to frame: stuck, or noisier than others"
        )
    if stamps:
        result.append(
            f"excluded: {100 * share:.2g} % of the values, in {len(stamps)} stations: something that the "
            "scene file does not describe stands before a surface there, as a hand, a cable or a clamp"
        )
    return result


def foreign_values(fitted: Fit) -> ForeignValues | None:
    """Return the values of a fit that do not see the scene; None where there are none, or too many.

    Defective pixels are judged where there are no objects: a hand moves the offsets of its pixels.
    """
    stations, poses = [], []
    for prediction in fitted.forward.predictions(slopes=False):
        stations.append(_Deviations.of(prediction, fitted))
        poses.append(PoseErrors.of(prediction, fitted.nuisances))
    count = sum(int(station.used.sum()) for station in stations)
    if not count:
        return None
    limit = noise_limit(count)
    robust = _robustly(stations, poses)
    sizes = np.stack([np.where(station.used, np.abs(station.z), np.nan) for station in robust])
    found = [
        _objects(station, _Elsewhere(number, tiles, sizes), limit)
        for number, (station, tiles) in enumerate(zip(robust, _tiles_elsewhere(robust), strict=True))
    ]
    masks = {number: mask for number, mask in enumerate(found) if mask.any()}
    objects = frozenset((stations[number].recording, stations[number].stamp) for number in masks)
    bad = np.zeros(fitted.forward.camera.shape, bool)
    if not masks:
        bad = _apart_from_neighbours(stations) | _noisy(stations)
        masks = dict.fromkeys(range(len(stations)), bad) if bad.any() else {}
    lost = sum(int((mask & stations[number].used).sum()) for number, mask in masks.items())
    if not lost or lost > FEW * count:
        return None
    return ForeignValues(masks, int(bad.sum()), objects, lost / count if objects else 0.0)


@dataclass(frozen=True)
class _Deviations:
    """Residuals of a station [m] and their ``sigma``, where ``used``, with the ``tile`` of each pixel (H, W).

    Where surfaces are ``described`` their tiles are known; elsewhere distances may end by steps where the
    brightness does. ``scatter`` (H, W) is the sum of squares of repeated frames about their mean, in
    variances of the noise model, of ``freedom`` (H, W). Where pixels are saturated (``saturates``) rows and
    columns may differ from others by steps.
    """

    recording: int
    stamp: int
    residual: Array
    sigma: Array
    used: Mask
    described: Mask
    tile: Array
    scatter: Array
    freedom: Array
    saturates: bool

    @cached_property
    def z(self) -> Array:
        """The residuals in sigmas."""
        return np.asarray(self.residual / self.sigma)

    @cached_property
    def is_judged(self) -> bool:
        """Whether few of the values deviate."""
        return float(np.mean(np.abs(self.z[self.used]) > BEYOND)) <= FEW if self.used.any() else False

    @classmethod
    def of(cls, prediction: Prediction, fitted: Fit) -> _Deviations:
        """Return those of a prediction after its nuisances."""
        station, used = prediction.station, prediction.used
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        freedom = np.maximum(station.count - 1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            scatter = freedom * station.distance_variance / (prediction.sigma**2 * station.count)
        known = used & np.isfinite(scatter)
        return cls(
            recording=station.recording,
            stamp=station.stamp,
            residual=np.where(used, rest, 0.0).astype(np.float32),
            sigma=np.where(used, prediction.sigma, 1.0).astype(np.float32),
            used=used,
            described=np.array([*(surface.is_described for surface in fitted.scene.surfaces), False])[
                prediction.view.geometry.surface
            ],
            tile=prediction.view.geometry.tile,
            scatter=np.where(known, scatter, 0.0).astype(np.float32),
            freedom=np.where(known, freedom, 0).astype(np.int32),
            saturates=bool((station.saturated > 0).any()),
        )


def _robustly(stations: Sequence[_Deviations], poses: Sequence[PoseErrors]) -> list[_Deviations]:
    """Return the deviations after robust errors of poses and offsets of pixels."""
    residuals = robust_residuals([one.residual for one in stations], [one.sigma for one in stations], poses)
    return [replace(station, residual=rest) for station, rest in zip(stations, residuals, strict=True)]


def _median_of_neighbours(image: Array, used: Mask, tile: Array) -> Array:
    """Return the median of the eight neighbours (H, W) that see the same tile; NaN where too few do."""
    rows, columns = image.shape
    around = np.full((8, rows, columns), np.nan)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    for values, (i, j) in zip(around, steps, strict=True):
        here = np.s_[max(-i, 0) : rows - max(i, 0), max(-j, 0) : columns - max(j, 0)]
        there = np.s_[max(i, 0) : rows - max(-i, 0), max(j, 0) : columns - max(-j, 0)]
        values[here] = np.where(used[there] & (tile[there] == tile[here]), image[there], np.nan)
    result = np.full(image.shape, np.nan)
    seen = used & (np.isfinite(around).sum(axis=0) >= _LEAST)
    result[seen] = np.nanmedian(around[:, seen], axis=0)
    return result


def _apart_from_neighbours(stations: Sequence[_Deviations]) -> Mask:
    """Return the pixels (H, W) that differ from their neighbours in most of their poses, or far in one.

    With independent noise a pixel does so in three of four poses less than once in 10^6 times. One that sees
    a wall in most poses, and is stuck, does in the others alone, by more than the `WILD` sigma at which
    residuals count no more.
    """
    used = np.sum([station.used for station in stations], axis=0)
    beyond, far = np.zeros(used.shape, int), np.zeros(used.shape, bool)
    for station in stations:
        if not station.is_judged:
            continue
        around = _median_of_neighbours(station.z, station.used, station.tile)
        apart = np.where(np.abs(around) < BEYOND, station.z - around, 0.0)
        beyond += np.abs(apart) > BEYOND
        far |= np.abs(apart) > WILD
    return np.asarray((used >= _LEAST) & ((2 * beyond > used) | far))


def _noisy(stations: Sequence[_Deviations]) -> Mask:
    """Return the pixels (H, W) whose frames scatter by `BEYOND` times as much as those of their neighbours.

    With normal noise and four degrees of freedom a pixel does so three times in 10^7.
    """
    freedom = np.sum([station.freedom for station in stations], axis=0)
    seen = freedom >= _LEAST
    ratio = np.sum([station.scatter for station in stations], axis=0) / np.maximum(freedom, 1)
    usual = _median_of_neighbours(ratio, seen, np.zeros(seen.shape))
    with np.errstate(invalid="ignore"):
        return np.asarray(ratio > BEYOND**2 * np.maximum(usual, 1.0))


def _tiles_elsewhere(stations: Sequence[_Deviations]) -> list[Mapping[int, float]]:
    """Return, for each station, how much each tile deviates in the others [sigma]: in nearly all, no more.

    Tiles that too few others see are not among them.
    """
    medians: list[dict[int, float]] = []
    for station in stations:
        tiles, z = station.tile[station.used], np.abs(station.z[station.used])
        order = np.argsort(tiles, kind="stable")
        numbers, starts = np.unique(tiles[order], return_index=True)
        parts = np.split(z[order], starts[1:]) if numbers.size else []
        medians.append({int(k): float(np.median(part)) for k, part in zip(numbers, parts, strict=True)})
    result: list[Mapping[int, float]] = []
    for number, own in enumerate(medians):
        others = [other for k, other in enumerate(medians) if k != number]
        known = {tile: [other[tile] for other in others if tile in other] for tile in own}
        result.append(
            {
                tile: float(np.quantile(values, 1 - FEW))
                for tile, values in known.items()
                if len(values) >= _LEAST
            }
        )
    return result


_SQUARE = np.ones((3, 3), bool)
#: Median of the size of normal noise, in sigmas.
_MEDIAN_OF_NOISE = float(ndtri(0.75))
#: Standard error of the variance that one such median gives: twice that of the sigma (1.17 / sqrt(n)).
_ERROR_OF_SQUARE = 2.33
#: Sigmas below the mean beyond which nearly all normal values lie.
_BELOW_MOST = float(ndtri(1 - FEW))
#: Size of normal noise that nearly all values do not exceed, and half as much again for few poses.
_MOST_OF_NOISE = WIDER * -float(ndtri(FEW / 2))


@dataclass(frozen=True)
class _Elsewhere:
    """How much tiles and pixels deviate in nearly all stations but one, no more [sigma].

    ``sizes`` (S, H, W) are those of all stations, NaN where a pixel is not used; ``number`` is that of the
    one.
    """

    number: int
    tiles: Mapping[int, float]
    sizes: Array

    def of(self, pixels: Mask) -> float:
        """Return it for a region, by the median of its pixels; infinite where they are seen too seldom."""
        sizes = np.delete(self.sizes[:, pixels], self.number, axis=0)
        seen = np.isfinite(sizes).sum(axis=0) >= _LEAST
        if 2 * seen.sum() < seen.size:
            return np.inf
        return float(np.median(np.nanquantile(sizes[:, seen], 1 - FEW, axis=0)))


def _objects(station: _Deviations, elsewhere: _Elsewhere, limit: float) -> Mask:
    """Return the pixels (H, W) that see an object before a surface, nearer than it, and those around it.

    Nearly all of its pixels are beyond the limit of noise. Where only those with the largest deviations are,
    they are the tail of what deviates by degrees.
    """
    result = np.zeros(station.used.shape, bool)
    if station.saturates or not station.is_judged:
        return result
    beyond = station.used & station.described & (station.z < -limit)
    if beyond.sum() < _LEAST:
        return result
    joined = ndimage.binary_dilation(beyond, _SQUARE, iterations=_AROUND)
    labels, number = ndimage.label(joined, _SQUARE)
    for part in range(1, number + 1):
        wide = labels == part
        own = beyond & wide
        if own.sum() < _LEAST:
            continue
        size = float(np.median(np.abs(station.z[own])))
        if size < limit + _BELOW_MOST:
            continue
        noise_and_tenth = np.hypot(_MOST_OF_NOISE, (1 - STEP) * size)
        if elsewhere.of(own) < noise_and_tenth and _ends_by_a_step(station, own, wide, elsewhere.tiles):
            result |= wide
    return result


def _ends_by_a_step(station: _Deviations, own: Mask, wide: Mask, usual: Mapping[int, float]) -> bool:
    """Return whether the deviation of a region ends at its outline.

    ``own`` are its pixels, ``wide`` includes those around them. Pixels outside of the same tile must scatter
    as noise does; where a tile is covered and is as it should be in other poses, those of any tile.
    """
    near = ndimage.binary_dilation(wide, _SQUARE, iterations=2 * _AROUND) & ~wide & station.used
    core = ndimage.binary_erosion(ndimage.binary_closing(own, _SQUARE), _SQUARE, iterations=_AROUND)
    border = own & ~core
    inside, outside, pixels = 0.0, 0.0, 0
    for tile in np.unique(station.tile[border]):
        a, b = border & (station.tile == tile), near & (station.tile == tile)
        here = float(np.median(np.abs(station.z[a])))
        if b.sum() < _LEAST and usual.get(int(tile), np.inf) < (1 - STEP) * here:
            b = near
        weight = int(min(a.sum(), b.sum()))
        if weight:
            inside += weight * here
            outside += weight * float(np.median(np.abs(station.z[b])))
            pixels += weight
    if pixels < _LEAST:
        return False
    beyond_noise = (outside / pixels / _MEDIAN_OF_NOISE) ** 2 - 1
    by_chance = STANDARD_ERRORS * _ERROR_OF_SQUARE / np.sqrt(pixels)
    return bool(beyond_noise < ((1 - STEP) * inside / pixels) ** 2 + by_chance)
