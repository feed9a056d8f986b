"""Regions of a surface that reflect otherwise than their tiles: a label, a stain, a cable close before it.

Such a region ends within a tile by a step of the amplitude, while its distances are as they should be. So
its amplitudes are taken as measured. The offset that every pixel of a tile shares is an error of the tile's
reflectivity, which is a parameter of every fit.
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
    of_light = [_of_light(station) for station in stations]
    darker = objects_in_poses(of_light, limit=limit)
    opposite = [replace(station, residual=-station.residual) for station in of_light]
    return [a | b for a, b in zip(darker, objects_in_poses(opposite, limit=limit), strict=True)]


def _of_light(station: Deviations) -> Deviations:
    """Return the deviations of the amplitudes of a station from the medians of their tiles, in sigmas.

    Pixels are judged away from the edges of tiles, across which a lens and neighbours mix the light.
    """
    side = 2 * AROUND + 1
    inner = ndimage.minimum_filter(station.tile, side) == ndimage.maximum_filter(station.tile, side)
    lit = station.lit & inner
    deviation = np.where(lit, station.amplitude, 0.0)
    for tile in np.unique(station.tile[lit]):
        own = lit & (station.tile == tile)
        deviation[own] -= np.median(deviation[own])
    return replace(
        station,
        residual=deviation,
        sigma=np.ones(deviation.shape),
        used=lit,
        amplitude=np.zeros(deviation.shape),
    )
