"""Objects that stand before a surface in all poses: furniture, a tripod, a lamp.

The offsets of pixels absorb an object before a surface that stays where it is, unless the same pixels see
another surface, too: a board that is carried past. Then an offset would be that of both. So a region is an
object before a surface if its pixels read that surface nearer, all by a step at the outline of the region
within a tile, and read others as their neighbours do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from rim_camera_ros.select.deviations import LEAST, Deviations, Mask
from rim_camera_ros.select.objects import STEP, ends_by_a_step, nearer_regions

Array = NDArray[Any]

#: Standard deviation of normal values over the median of their size.
_NORMAL = 1.0 / float(ndtri(0.75))


def objects_in_all_poses(stations: Sequence[Deviations], offsets: Array, *, limit: float) -> list[Mask]:
    """Return the pixels (H, W) of each station that see such an object.

    ``offsets`` (H, W) [m] are those of the pixels, which are in no residual; ``limit`` is that of noise
    [sigma].
    """
    found = [np.zeros(station.used.shape, bool) for station in stations]
    if any(station.saturates for station in stations):
        return found
    readings = np.stack([np.where(station.used, station.residual + offsets, np.nan) for station in stations])
    surfaces = np.stack([station.surface for station in stations])
    for number in np.unique(surfaces[np.isfinite(readings)]).tolist():
        own = np.where(surfaces == number, readings, np.nan)
        others = np.where(surfaces == number, np.nan, readings)
        region = _before(_of_surface(stations, own, surfaces == number), _medians(others, 1), limit)
        for mask, seen in zip(found, surfaces == number, strict=True):
            mask |= region & seen
    return found


def _medians(readings: Array, least: int) -> Array:
    """Return the medians over the stations (H, W); NaN where fewer than ``least`` see a pixel."""
    result = np.full(readings.shape[1:], np.nan)
    seen = np.isfinite(readings).sum(axis=0) >= least
    if seen.any():
        result[seen] = np.nanmedian(readings[:, seen], axis=0)
    return result


def _of_surface(stations: Sequence[Deviations], own: Array, sees: Array) -> Deviations:
    """Return the deviations of the pixels that see a surface, over all stations, as those of one station.

    Their sigma is that of the offsets of pixels, by the median of their size.
    """
    middle = _medians(own, LEAST)
    used = np.isfinite(middle)
    deviation = np.where(used, middle - (np.median(middle[used]) if used.any() else 0.0), 0.0)
    spread = _NORMAL * float(np.median(np.abs(deviation[used]))) if used.any() else 0.0
    first = np.argmax(sees, axis=0)[None]
    tile, described = (
        np.take_along_axis(np.stack(images), first, axis=0)[0]
        for images in ([one.tile for one in stations], [one.described for one in stations])
    )
    return Deviations(
        recording=0,
        stamp=0,
        residual=deviation,
        sigma=np.full(used.shape, max(spread, 1e-9)),
        used=used,
        described=described,
        tile=tile,
        surface=np.zeros(used.shape, int),
        amplitude=np.zeros(used.shape),
        lit=np.zeros(used.shape, bool),
        scatter=np.zeros(used.shape),
        freedom=np.zeros(used.shape, int),
        saturates=False,
    )


def _before(surface: Deviations, others: Array, limit: float) -> Mask:
    """Return the regions that are nearer than a surface, where ``others`` (H, W) [m] are not."""
    result = np.zeros(surface.used.shape, bool)
    elsewhere = others - np.nanmedian(others) if np.isfinite(others).any() else others
    for region in nearer_regions(surface, limit=limit):
        known = region.own & np.isfinite(elsewhere)
        if known.sum() < LEAST:
            continue
        tenth = (1 - STEP) * region.size * surface.sigma[0, 0]
        reads_alike = abs(float(np.median(elsewhere[known]))) < tenth
        if reads_alike and ends_by_a_step(_from_tiles(surface, region.wide), region, {}):
            result |= region.wide
    return result


def _from_tiles(surface: Deviations, region: Mask) -> Deviations:
    """Return the deviations from what each tile has in common outside of a region: that may be physics."""
    residual = surface.residual.copy()
    for tile in np.unique(surface.tile[region & surface.used]):
        own = surface.used & (surface.tile == tile)
        if (own & ~region).any():
            residual[own] -= np.median(residual[own & ~region])
    return replace(surface, residual=residual)
