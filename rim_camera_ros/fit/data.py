"""Stations: a recording reduced to sums per pixel over frames of one pose and one setting.

A station holds everything that a fit needs of its frames, so that memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.common_variation import Movement
from rim_camera_ros.fit.neighbours import Neighbours
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.scene import Scene

#: Frames of a station that are kept to find the variation which all pixels share.
KEPT_FRAMES = 8

Array = NDArray[Any]


class MissingPoses(InputError):
    """A recording lacks the poses of a surface that its scene file gives as ``pose: truth``."""


@dataclass(frozen=True)
class Station:
    """Frames of one pose, one setting and (within a long pose) one block of time.

    ``distance`` [m] and ``amplitude`` [counts] (H, W) are means over the valid frames (NaN and 0 without
    one; a wrapping camera's distances are averaged modulo L); ``distance_variance`` [m^2] and
    ``amplitude_variance`` [counts^2] of single frames (NaN below two); ``count`` the valid frames of each
    pixel; ``saturated`` how many of its frames were saturated. ``pose`` numbers the poses of the recording,
    ``placement`` only those whose stated values differ from the pose before (None: as ``pose``). ``stamp``
    [ns] and ``time`` [s since the first frame] are the middle of the block, ``duration`` [s] is from its
    first frame to its last. ``common`` is the frame-to-frame variation that all pixels share and that is not
    in proportion to their light, as chi-square per degree of freedom of the mean complex deviation (1: none;
    None for one frame). ``common_light`` [counts^2] is its power if it is the same in all pixels, less that
    of noise (negative by chance). ``movement`` says whether tilts explain it. ``neighbours`` are the
    correlations of the noise of pixels with that of others; None for one frame. ``unlike`` marks the pixels
    that see a surface of another reflectivity than the scene file's: their amplitudes are taken as measured.
    """

    recording: int
    pose: int
    frames: int
    stamp: int
    time: float
    settings: Settings
    truth: Mapping[str, Pose]
    distance: Array
    amplitude: Array
    distance_variance: Array
    amplitude_variance: Array
    count: Array
    saturated: Array
    common: float | None = None
    common_light: float | None = None
    movement: Movement | None = None
    neighbours: Neighbours | None = None
    placement: int | None = None
    duration: float = 0.0
    unlike: NDArray[np.bool_] | None = None

    def part(self, rows: slice, columns: slice) -> Station:
        """Return the station with the chosen rows and columns of its images alone."""
        names = ("distance", "amplitude", "distance_variance", "amplitude_variance", "count", "saturated")
        images: dict[str, Any] = {
            name: np.ascontiguousarray(getattr(self, name)[rows, columns]) for name in names
        }
        unlike = None if self.unlike is None else self.unlike[rows, columns]
        return replace(self, **images, unlike=unlike)

    def without(self, values: NDArray[np.bool_]) -> Station:
        """Return the station without the values of some pixels (H, W)."""
        nothing = {"distance": np.nan, "distance_variance": np.nan, "amplitude_variance": np.nan}
        images: dict[str, Any] = {
            name: np.where(values, nothing.get(name, 0), getattr(self, name)).astype(
                getattr(self, name).dtype
            )
            for name in (*nothing, "amplitude", "count")
        }
        return replace(self, **images)

    def with_unlike(self, pixels: NDArray[np.bool_]) -> Station:
        """Return the station in which further pixels (H, W) see a surface of another reflectivity."""
        return replace(self, unlike=pixels if self.unlike is None else self.unlike | pixels)

    @property
    def placed(self) -> int:
        """Number of the placement, within which errors of the reference instrument are the same."""
        return self.pose if self.placement is None else self.placement


@dataclass
class Dataset:
    """Stations of one or more recordings, in order; ``notes`` say what was assumed or excluded.

    ``codes`` (65536,) counts how often each raw distance count occurred; None for distances in metres.
    ``decimation`` is the step of its pixels on the sensor, along rows and columns.
    """

    stations: list[Station]
    files: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    frames: int = 0
    codes: Array | None = None
    decimation: int = 1

    @property
    def poses(self) -> int:
        """Number of different poses over all recordings."""
        return len({(station.recording, station.pose) for station in self.stations})

    @cached_property
    def measured(self) -> dict[tuple[int, int], tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
        """The rows (H,) and columns (W,) that have a measurement, by recording and placement."""
        found: dict[tuple[int, int], NDArray[np.bool_]] = {}
        for station in self.stations:
            key, seen = (station.recording, station.placed), station.count > 0
            found[key] = seen | found[key] if key in found else seen
        return {key: (seen.any(axis=1), seen.any(axis=0)) for key, seen in found.items()}

    @property
    def placements(self) -> int:
        """Number of placements: successive poses with the same stated values are one placement."""
        return len({(station.recording, station.placed) for station in self.stations})

    def with_poses(self, scene: Scene, path: str | PathLike[str] | None = None) -> None:
        """Exclude stations before the first pose of a surface with ``pose: truth``, with a note.

        Raises `MissingPoses` where no station has all poses, `InputError` where there is no station.
        """
        needed = scene.needs_truth
        if not self.stations:
            raise InputError(
                "holds no frame with settings", file=path, remedy="record frame_info beside the images"
            )
        kept = [station for station in self.stations if all(name in station.truth for name in needed)]
        lost = sum(station.frames for station in self.stations) - sum(station.frames for station in kept)
        if not kept:
            present = {name for station in self.stations for name in station.truth}
            absent = [name for name in needed if name not in present]
            raise MissingPoses(
                f"holds no pose of {', '.join(absent) or 'all surfaces together'}",
                file=path,
                place="scene with pose: truth",
                remedy=f"record /ground_truth/{(absent or list(needed))[0]}/pose, "
                "state the pose in the scene file, or give one recording for each station of its schedule",
            )
        if lost:
            self.notes.append(f"excluded: {lost} frames before the first pose of every surface")
        self.stations, self.frames = kept, self.frames - lost

    def without(self, poses: Set[tuple[int, int]]) -> Dataset:
        """Return the dataset without poses, given by the numbers of their recording and their own."""
        kept = [station for station in self.stations if (station.recording, station.pose) not in poses]
        lost = sum(station.frames for station in self.stations) - sum(station.frames for station in kept)
        return replace(self, stations=kept, frames=self.frames - lost)

    @property
    def integration_times(self) -> list[float]:
        """The settings that occur, sorted."""
        return sorted(
            {
                station.settings.integration_time
                for station in self.stations
                if station.settings.integration_time is not None
            }
        )


def merged(parts: Iterable[Dataset]) -> Dataset:
    """Return the stations of several recordings as one dataset, numbered in their order."""
    result = Dataset([])
    for number, part in enumerate(parts):
        result.stations += [replace(station, recording=number) for station in part.stations]
        result.files += part.files
        result.notes += part.notes
        result.frames += part.frames
        if part.codes is not None:
            result.codes = part.codes if result.codes is None else result.codes + part.codes
    return result


def with_stated_errors(scene: Scene, dataset: Dataset) -> Scene:
    """Return the scene in which ``pose_sigma`` is the RMS of the covariances that poses bring with them.

    Only of surfaces whose poses bring a covariance. It is then the size of the errors that all poses share
    (``pose_common``), and that of the instrument with which errors are compared.
    """
    surfaces = []
    for surface in scene.surfaces:
        poses = {
            (station.recording, station.placed): station.truth[surface.name]
            for station in dataset.stations
            if surface.pose == "truth" and surface.name in station.truth
        }
        if any(pose.covariance is not None for pose in poses.values()):
            stated = [np.diag(surface.pose_covariance(pose)) for pose in poses.values()]
            offset, *tilts = np.mean(stated, axis=0)
            sigma = (float(np.sqrt(offset)), float(np.sqrt(np.mean(tilts))))
            surface = replace(surface, pose_sigma=sigma)
        surfaces.append(surface)
    return replace(scene, surfaces=tuple(surfaces))


def level_of(dataset: Dataset) -> float:
    """Return the median amplitude of a dataset [counts]."""
    values = np.concatenate([station.amplitude[station.count > 0][::17] for station in dataset.stations])
    return max(float(np.median(values)), 1.0) if values.size else 1000.0


def pixels_seen(
    dataset: Dataset, masks: Sequence[tuple[Array, Array]] | None, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return which pixels (H W,) hold a value that may be fitted, in any station, within its ``masks``."""
    seen = np.zeros(shape, bool)
    for number, station in enumerate(dataset.stations):
        mine = station.count > 0
        if masks is not None:
            mine &= masks[number][0] | masks[number][1]
        seen |= mine
    return seen.ravel()
