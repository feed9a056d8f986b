"""Values of pixels that do not see the surfaces of the scene: defective pixels, and objects before surfaces.

They are found in the residuals of a fit, and excluded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.robust_poses import PoseErrors
from rim_camera_ros.select.defective_pixels import defective_pixels
from rim_camera_ros.select.deviations import Deviations, Mask, robustly
from rim_camera_ros.select.objects import objects_in_poses
from rim_camera_ros.select.standing_objects import objects_in_all_poses
from rim_camera_ros.select.thresholds import FEW, noise_limit

Array = NDArray[Any]

#: Times that a recording is fitted anew without such values: the grossest hide others.
MOST_ROUNDS = 4


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
        stations.append(Deviations.of(prediction, fitted))
        poses.append(PoseErrors.of(prediction, fitted.nuisances))
    count = sum(int(station.used.sum()) for station in stations)
    if not count:
        return None
    limit = noise_limit(count)
    robust = robustly(stations, poses)
    found = [
        standing | single
        for standing, single in zip(
            objects_in_all_poses(stations, fitted.pattern, limit=limit),
            objects_in_poses(robust, limit=limit),
            strict=True,
        )
    ]
    masks = {number: mask for number, mask in enumerate(found) if mask.any()}
    objects = frozenset((stations[number].recording, stations[number].stamp) for number in masks)
    bad = np.zeros(fitted.forward.camera.shape, bool)
    if not masks:
        bad = defective_pixels(stations)
        masks = dict.fromkeys(range(len(stations)), bad) if bad.any() else {}
    lost = sum(int((mask & stations[number].used).sum()) for number, mask in masks.items())
    if not lost or lost > FEW * count:
        return None
    return ForeignValues(masks, int(bad.sum()), objects, lost / count if objects else 0.0)
