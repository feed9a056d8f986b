"""Objects before surfaces in single poses: a hand, a cable, a clamp.

A region that ends within a tile by a step is another object. So is one that covers a tile which is as it
should be in nearly all other poses. What many values of a pose show is physics: such a pose is not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from rim_camera_ros.fit.pose_errors import WIDER
from rim_camera_ros.select.deviations import LEAST, Deviations, Mask
from rim_camera_ros.select.thresholds import FEW, STANDARD_ERRORS

Array = NDArray[Any]

#: Pixels around an object that it may partly cover, and pixels between its parts, as those beside edges.
AROUND = 2
#: Share of the deviation of a region that must end at its outline. An object ends within a pixel: outside
#: nothing deviates, to a tenth; nor do its pixels, and tiles that it covers, in nearly all other poses. What
#: follows from light, distance or amplitude goes on there.
STEP = 0.9
#: Least number of pixels of an object: noise alone has two beyond its limit side by side in no recording.
_LEAST_REGION = 2


def objects_in_poses(stations: Sequence[Deviations], *, limit: float) -> list[Mask]:
    """Return the pixels (H, W) of each station that see an object; ``limit`` is that of noise [sigma]."""
    sizes = np.stack([np.where(station.used, np.abs(station.z), np.nan) for station in stations])
    return [
        _objects(station, _Elsewhere(number, tiles, sizes), limit)
        for number, (station, tiles) in enumerate(zip(stations, _tiles_elsewhere(stations), strict=True))
    ]


def _tiles_elsewhere(stations: Sequence[Deviations]) -> list[Mapping[int, float]]:
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
                if len(values) >= LEAST
            }
        )
    return result


_SQUARE = np.ones((3, 3), bool)
#: Median of the size of normal noise, in sigmas.
_MEDIAN_OF_NOISE = float(ndtri(0.75))
#: Standard error of the variance that one such median gives: twice that of the sigma (1.17 / sqrt(n)).
_ERROR_OF_SQUARE = 2.33
#: Sigmas below the mean beyond which nearly all normal values lie.
BELOW_MOST = float(ndtri(1 - FEW))
#: Size of normal noise that nearly all values do not exceed, and half as much again for few poses.
MOST_OF_NOISE = WIDER * -float(ndtri(FEW / 2))


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
        seen = np.isfinite(sizes).sum(axis=0) >= LEAST
        if 2 * seen.sum() < seen.size:
            return np.inf
        return float(np.median(np.nanquantile(sizes[:, seen], 1 - FEW, axis=0)))


@dataclass(frozen=True)
class _Region:
    """A region nearer than its surface: its pixels ``own`` (H, W), and those with the pixels around them.

    ``size`` is the median of its deviations [sigma]. ``by_light`` says that its amplitudes deviate, too, and
    must end by a step as well: it is small, or not far beyond the limit of noise.
    """

    own: Mask
    wide: Mask
    size: float
    by_light: bool


def _objects(station: Deviations, elsewhere: _Elsewhere, limit: float) -> Mask:
    """Return the pixels (H, W) that see an object before a surface, nearer than it, and those around it."""
    result = np.zeros(station.used.shape, bool)
    if station.saturates or not station.is_judged:
        return result
    for region in nearer_regions(station, limit=limit):
        noise_and_tenth = np.hypot(MOST_OF_NOISE, (1 - STEP) * region.size)
        if elsewhere.of(region.own) < noise_and_tenth and ends_by_a_step(station, region, elsewhere.tiles):
            result |= region.wide
    return result


def nearer_regions(station: Deviations, *, limit: float) -> Iterator[_Region]:
    """Yield the regions that are nearer than their surfaces, beyond the ``limit`` of noise.

    Nearly all pixels of an object are beyond it. Where only those with the largest deviations are, or fewer
    than four, they may be the tail of what deviates by degrees, unless their amplitudes are beyond it, too.
    """
    beyond = station.used & station.described & (station.z < -limit)
    if beyond.sum() < _LEAST_REGION:
        return
    joined = ndimage.binary_dilation(beyond, _SQUARE, iterations=AROUND)
    labels, number = ndimage.label(joined, _SQUARE)
    for part in range(1, number + 1):
        wide = labels == part
        own = beyond & wide
        if own.sum() < _LEAST_REGION:
            continue
        size = float(np.median(np.abs(station.z[own])))
        is_tail = own.sum() < LEAST or size < limit + BELOW_MOST
        if not is_tail or float(np.median(np.abs(station.amplitude[own]))) > limit:
            yield _Region(own, wide, size, by_light=is_tail)


def ends_by_a_step(station: Deviations, region: _Region, usual: Mapping[int, float]) -> bool:
    """Return whether the deviation of a region ends at its outline.

    Pixels outside of the same tile must scatter as noise does; where a tile is covered and is as it should be
    in other poses, those of any tile.
    """
    channels = [station.z, station.amplitude] if region.by_light else [station.z]
    return all(_is_step(np.abs(channel), station, region, usual) for channel in channels)


def _is_step(sizes: Array, station: Deviations, region: _Region, usual: Mapping[int, float]) -> bool:
    own, wide = region.own, region.wide
    near = ndimage.binary_dilation(wide, _SQUARE, iterations=2 * AROUND) & ~wide & station.used
    core = ndimage.binary_erosion(ndimage.binary_closing(own, _SQUARE), _SQUARE, iterations=AROUND)
    border = own & ~core
    inside, outside, pixels = 0.0, 0.0, 0
    for tile in np.unique(station.tile[border]):
        a, b = border & (station.tile == tile), near & (station.tile == tile)
        here = float(np.median(sizes[a]))
        if b.sum() < LEAST and usual.get(int(tile), np.inf) < (1 - STEP) * here:
            b = near
        weight = int(min(a.sum(), b.sum()))
        if weight:
            inside += weight * here
            outside += weight * float(np.median(sizes[b]))
            pixels += weight
    if pixels < _LEAST_REGION:
        return False
    beyond_noise = (outside / pixels / _MEDIAN_OF_NOISE) ** 2 - 1
    by_chance = STANDARD_ERRORS * _ERROR_OF_SQUARE / np.sqrt(pixels)
    return bool(beyond_noise < ((1 - STEP) * inside / pixels) ** 2 + by_chance)
