"""Frames: raw ones as the camera delivers them, and corrected ones."""

from __future__ import annotations

import enum
from bisect import bisect_left
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError

NANOSECONDS = 1_000_000_000

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Flag(enum.IntFlag):
    """Bits of the flags image."""

    LOW_AMPLITUDE = 1
    SATURATED = 2
    MIXED_PIXEL = 4
    OUTSIDE_CALIBRATION = 8
    NO_MEASUREMENT = 16
    AMBIGUOUS = 32


#: Bits with which a pixel has no corrected distance and no point.
INVALID = Flag.LOW_AMPLITUDE | Flag.SATURATED | Flag.NO_MEASUREMENT | Flag.AMBIGUOUS


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a surface frame in the camera optical frame (x right, y down, z forward).

    ``position`` in metres, ``orientation`` as the unit quaternion x y z w. ``covariance``: the 36 numbers of
    the matrix of geometry_msgs/PoseWithCovariance, row by row: x y z [m], then rotations about the x y z axes
    of the optical frame [rad]; None where the pose comes without its own uncertainty.
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    covariance: tuple[float, ...] | None = None


@dataclass(eq=False, slots=True)
class Readings:
    """The readings of a sensor in order: ``stamps`` in nanoseconds, ``values`` in its unit.

    They grow while a recording is read; users of past readings only take those up to their own stamp.
    """

    stamps: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def add(self, stamp: int, value: float) -> None:
        """Add a reading in its place; of two with the same stamp the later one counts."""
        place = bisect_left(self.stamps, stamp)
        if place < len(self.stamps) and self.stamps[place] == stamp:
            self.values[place] = value
        else:
            self.stamps.insert(place, stamp)
            self.values.insert(place, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The camera's settings and state with one frame; None where unknown.

    ``integration_time`` in the device's own unit, ``modulation_frequency`` in Hz, ``uptime`` in s
    since power-on, temperatures in degC, ``reference_distance`` (internal reference path) in m.
    ``ambient_readings`` are all readings of the ambient temperature in the recording, where available.
    ``extra`` contains the further key/value pairs of the frame_info message.
    """

    integration_time: float | None = None
    modulation_frequency: float | None = None
    uptime: float | None = None
    body_temperature: float | None = None
    ambient_temperature: float | None = None
    reference_distance: float | None = None
    extra: Mapping[str, str] = _NOTHING
    ambient_readings: Readings | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """The geometry in a camera_info message: size in pixels, focal lengths, principal point, plumb_bob."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    d: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RawFrame:
    """One exposure as the camera delivers it.

    ``distance`` (H, W): uint16 counts (one count = ``distance_lsb``; 0 = no measurement) or float32
    metres (NaN or 0 = no measurement). ``amplitude`` (H, W): uint16 or float32 counts.
    ``sigma`` (H, W): 1-sigma of the distance in metres where it is known for this very frame, else None.
    ``images``: further images of the device by role (see `rim_camera_ros.bags.topics`). If there is a
    ``distance_1`` but no ``distance_0``, distance and amplitude are those of the first frequency.
    ``stamp`` in nanoseconds. ``truth`` holds the poses of scene surfaces that are valid for this
    frame (the last message of each surface at or before the stamp); ``pose_stamps`` their stamps.
    """

    stamp: int
    distance: NDArray[Any]
    amplitude: NDArray[Any]
    settings: Settings = field(default_factory=Settings)
    truth: Mapping[str, Pose] = _NOTHING
    pose_stamps: Mapping[str, int] = _NOTHING
    intrinsics: Intrinsics | None = None
    device: str = ""
    images: Mapping[str, NDArray[Any]] = _NOTHING
    sigma: NDArray[Any] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return (int(self.distance.shape[0]), int(self.distance.shape[1]))

    @property
    def by_role(self) -> dict[str, NDArray[Any]]:
        """Every image by the role of its topic."""
        first = "_0" if "distance_1" in self.images and "distance_0" not in self.images else ""
        return {f"distance{first}": self.distance, f"amplitude{first}": self.amplitude, **self.images}

    def require_one_distance(self) -> None:
        """Raise `InputError` where distance and amplitude are those of one of several frequencies."""
        if "distance" not in self.by_role:
            raise InputError(
                "it holds the images of several modulation frequencies, the camera file has one",
                place="sensor.modulation_frequency",
                remedy="give the camera file of these frequencies",
            )

    def with_truth_of(self, surfaces: Set[str]) -> RawFrame:
        """Return the frame without the poses of other surfaces; itself if there are no others."""
        if self.truth.keys() <= surfaces and self.pose_stamps.keys() <= surfaces:
            return self
        return replace(
            self,
            truth={name: pose for name, pose in self.truth.items() if name in surfaces},
            pose_stamps={name: stamp for name, stamp in self.pose_stamps.items() if name in surfaces},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedDistance:
    """Distances and amplitudes of one exposure after the correction, all (H, W).

    ``distance`` float32: corrected radial distance in metres, NaN where invalid. ``amplitude``
    float32: counts after undoing compression and scattering.
    """

    stamp: int
    distance: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedFrame(CorrectedDistance):
    """One exposure after the correction with its precision and flags, all (H, W).

    ``sigma`` float32: standard deviation of the distance in metres, NaN where invalid. ``flags``
    uint8, see `Flag`.
    """

    sigma: NDArray[np.float32]
    flags: NDArray[np.uint8]
