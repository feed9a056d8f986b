"""Values of pixels that do not see the surfaces of the scene: defective pixels, and objects before surfaces.

They are found in the residuals of a fit, and excluded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.amplitudes import AMPLITUDE_MODEL
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.robust_poses import PoseErrors
from rim_camera_ros.select.defective_pixels import defective_pixels
from rim_camera_ros.select.deviations import Deviations, Mask, robustly
from rim_camera_ros.select.objects import objects_in_poses
from rim_camera_ros.select.standing_objects import objects_in_all_poses
from rim_camera_ros.select.thresholds import FEW, noise_limit
from rim_camera_ros.select.unlike_regions import unlike_regions

Array = NDArray[Any]

#: Times that a recording is fitted anew without such values: the grossest hide others.
MOST_ROUNDS = 4


@dataclass(frozen=True)
class ForeignValues:
    """Values to exclude: ``masks`` (H, W) by the number of the station.

    ``pixels`` is the number of defective pixels. An object before a surface takes a ``share`` of all values
    used, at ``stamps`` (recording, [ns]). ``unlike`` are masks (H, W) of amplitudes alone, by the number of
    the station: those of a label or a stain, a share ``unlike_share`` of all.
    """

    masks: Mapping[int, Mask]
    pixels: int = 0
    stamps: frozenset[tuple[int, int]] = frozenset()
    share: float = 0.0
    unlike: Mapping[int, Mask] = field(default_factory=dict)
    unlike_share: float = 0.0

    def excluded_from(self, dataset: Dataset) -> Dataset:
        """Return the dataset without these values."""
        stations = list(dataset.stations)
        for number, mask in self.masks.items():
            stations[number] = stations[number].without(mask)
        return self.marked_in(replace(dataset, stations=stations))

    def marked_in(self, dataset: Dataset) -> Dataset:
        """Return the dataset with the pixels marked whose light is not that of the scene."""
        stations = list(dataset.stations)
        for number, mask in self.unlike.items():
            stations[number] = stations[number].with_unlike(mask)
        return replace(dataset, stations=stations)

    def kept(self, masks: Sequence[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
        """Return the pixels to fit, (H, W) each by station for distance and amplitude, without these."""
        result = []
        for number, (used, lit) in enumerate(masks):
            foreign, unlike = (
                mask.get(number, np.zeros(used.shape, bool)) for mask in (self.masks, self.unlike)
            )
            result.append((used & ~foreign, lit & ~foreign & ~unlike))
        return result


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
    unlike = sum(each.unlike_share for each in found)
    if unlike:
        result.append(
            f"excluded: {100 * unlike:.2g} % of the amplitudes: a part of a surface reflects otherwise than "
            "the scene file says, as a label, a stain or a cable close before it; its distances are used"
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
    used, lit = (
        sum(int(mask.sum()) for mask in masks)
        for masks in ([one.used for one in stations], [one.lit for one in stations])
    )
    if not used:
        return None
    limit = noise_limit(used)
    robust = robustly(stations, poses)
    standing = objects_in_all_poses(stations, fitted.pattern, limit=limit)
    single = objects_in_poses(robust, limit=limit)
    objects = [a | b for a, b in zip(standing, single, strict=True)]
    masks = _any(objects)
    unlike: Mapping[int, Mask] = {}
    if _predicts_amplitudes(fitted):
        parts = unlike_regions(robust, limit=limit)
        unlike = _any([own & ~mask for own, mask in zip(parts, objects, strict=True)])
    stamps = frozenset((stations[number].recording, stations[number].stamp) for number in masks)
    bad = np.zeros(fitted.forward.camera.shape, bool)
    if not masks:
        bad = defective_pixels(stations)
        masks = dict.fromkeys(range(len(stations)), bad) if bad.any() else {}
    lost = sum(int((mask & stations[number].used).sum()) for number, mask in masks.items())
    dark = sum(int((mask & stations[number].lit).sum()) for number, mask in unlike.items())
    if not lost + dark or lost > FEW * used or dark > FEW * lit:
        return None
    return ForeignValues(
        masks=masks,
        pixels=int(bad.sum()),
        stamps=stamps,
        share=lost / used if stamps else 0.0,
        unlike=unlike,
        unlike_share=dark / max(lit, 1),
    )


def _predicts_amplitudes(fitted: Fit) -> bool:
    """Whether amplitudes are those of the scene: before another board every part is unlike its tile.

    Their errors must be within three times what the scene file states of its reflectivities.
    """
    stated = max(AMPLITUDE_MODEL, *(surface.reflectivity_sigma for surface in fitted.scene.surfaces))
    return fitted.forward.amplitude_model.tau <= BEYOND * stated


def _any(found: Sequence[Mask]) -> dict[int, Mask]:
    return {number: mask for number, mask in enumerate(found) if mask.any()}
