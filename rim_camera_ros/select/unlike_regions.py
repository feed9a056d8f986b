"""Regions of a surface that reflect otherwise than their tiles: a label, a stain, a cable close before it.

Such a region ends within a tile by a step of the amplitude, while its distances are as they should be. So
its amplitudes are taken as measured. What the pixels of a tile have in common in most poses is an error of
the tile's reflectivity, which is a parameter of every fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rim_camera_ros.select.deviations import Deviations, Mask
from rim_camera_ros.select.objects import AROUND, objects_in_poses

Array = NDArray[Any]


def unlike_regions(stations: Sequence[Deviations], *, limit: float) -> list[Mask]:
    """Return the pixels (H, W) of each station in such regions; ``limit`` is that of noise [sigma]."""
    lit = [station.lit & _is_inner(station.tile) for station in stations]
    tiles = np.concatenate([station.tile[mask] for station, mask in zip(stations, lit, strict=True)])
    values = np.concatenate([station.amplitude[mask] for station, mask in zip(stations, lit, strict=True)])
    if not tiles.size:
        return [np.zeros(station.used.shape, bool) for station in stations]
    usual = np.zeros(max(int(station.tile.max()) for station in stations) + 1)
    for tile in np.unique(tiles):
        usual[tile] = np.median(values[tiles == tile])
    of_light = [_of_light(station, mask, usual) for station, mask in zip(stations, lit, strict=True)]
    darker = objects_in_poses(of_light, limit=limit)
    opposite = [replace(station, residual=-station.residual) for station in of_light]
    return [a | b for a, b in zip(darker, objects_in_poses(opposite, limit=limit), strict=True)]


def _is_inner(tile: Array) -> Mask:
    """Return the pixels (H, W) away from the edges of tiles, across which a lens and neighbours mix light."""
    side = 2 * AROUND + 1
    return np.asarray(ndimage.minimum_filter(tile, side) == ndimage.maximum_filter(tile, side))


def _of_light(station: Deviations, lit: Mask, usual: Array) -> Deviations:
    """Return the deviations of the amplitudes of a station from the ``usual`` ones of tiles (N,) [sigma]."""
    return replace(
        station,
        residual=np.where(lit, station.amplitude - usual[station.tile], 0.0),
        sigma=np.ones(lit.shape),
        used=lit,
        amplitude=np.zeros(lit.shape),
    )
