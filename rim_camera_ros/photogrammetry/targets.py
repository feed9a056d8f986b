"""Targets of a calibration field, and where they were seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose

_NO_POSES: Mapping[int, Pose] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Target:
    """A point of the target field, in the field's frame.

    ``position`` in m. A circle has a ``radius`` in m and a ``normal`` (its sign is of no importance); a point
    without extent, such as the corner of a checkerboard, has radius 0.
    """

    position: tuple[float, float, float]
    radius: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class TargetField:
    """A rigid field of targets by their ids."""

    targets: Mapping[str, Target]

    @property
    def positions(self) -> NDArray[np.float64]:
        """Positions (targets, 3) in m, in the order of the ids."""
        return np.array([target.position for target in self.targets.values()], dtype=float).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class ImagePoint:
    """A target as seen from one station: (u, v) = (column, row) in px and the 1-sigma of each, in px.

    For a circle this is the centre of the ellipse that is its image, which is not the image of its centre.
    ``shifts`` (frequencies, 2) px: errors by the sampling of the image, see `sampling`, which the targets of
    a station share, in addition to their own ``sigma``. None: errors of the targets are independent.
    """

    target: str
    station: int
    u: float
    v: float
    sigma: float
    shifts: NDArray[np.float64] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Distance:
    """A known distance between two targets, with its 1-sigma, both in m."""

    first: str
    second: str
    length: float
    sigma: float


@dataclass(frozen=True)
class Observations:
    """Observations of a target field.

    ``poses``: approximate poses of the field's frame in the optical frame by station; the pose of a station
    without one is found by resection. ``notes``: what was excluded while reading, and why.
    """

    field: TargetField
    points: tuple[ImagePoint, ...]
    poses: Mapping[int, Pose] = _NO_POSES
    notes: tuple[str, ...] = ()
