"""Stations of a recorded board: where it is in each frame, and which frames show it at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.photogrammetry.board_detection import FoundBoard, find_board
from rim_camera_ros.photogrammetry.texture_targets import TextureTargets, targets_of
from rim_camera_ros.scene import TRUTH, Scene, Surface

Array = NDArray[np.float64]

#: The board rests as long as the RMS of the common (affine) motion of its points is less than this [px].
_REST = 0.12
_WINDOW = 3
#: ... and as long as the correlation of the images there is above this: where a board has left, no corners
#: are found nearby, and the points stay where they were looked for, as if at rest. Noise lowers the
#: correlation of such contrasts little.
_ALIKE = 0.8
#: Most frames without the board in which boards of other descriptions are looked for.
_MOST_MISSED = 8


@dataclass
class BoardStations:
    """Frames of a recording sorted to stations of a board; filled while `frames` is iterated.

    ``station``: the station by a frame's stamp; ``first``: the first stamp of each station; ``unseen``:
    number of frames without the board, ``ambiguous``: of those in which it looks alike when turned by 180
    degrees.
    """

    surface: Surface
    camera: Camera
    station: dict[int, int] = field(default_factory=dict)
    first: list[int] = field(default_factory=list)
    unseen: int = 0
    ambiguous: int = 0
    _missed: list[NDArray[np.float32]] = field(default_factory=list)
    _every: int = 1

    def __post_init__(self) -> None:
        found = targets_of(self.surface)
        assert found is not None
        self.targets: TextureTargets = found

    def frames(self, recorded: Iterable[RawFrame]) -> Iterator[RawFrame]:
        """Yield the frames that show the board, with its approximate pose as their only truth."""
        reference: tuple[NDArray[np.float32], FoundBoard, Any] | None = None
        last: Pose | None = None
        for frame in recorded:
            if frame.shape != self.camera.shape:
                raise InputError(
                    f"its images have {frame.shape[1]} x {frame.shape[0]} px, "
                    f"the camera {self.camera.shape[1]} x {self.camera.shape[0]}",
                    remedy="give the camera file that belongs to the recording",
                )
            image = np.nan_to_num(np.asarray(frame.amplitude, np.float32))
            pose_stamp = frame.pose_stamps.get(self.surface.name)
            if not (reference is not None and reference[2] == pose_stamp and self._rests(reference, image)):
                found = find_board(image, self.surface, self.targets, self.camera.optics, near=last)
                if found is None:
                    self._miss(image)
                    reference = None
                    continue
                self.ambiguous += found.ambiguous
                reference = (image, found, pose_stamp)
                self.first.append(frame.stamp)
            assert reference is not None
            last = reference[1].pose
            self.station[frame.stamp] = len(self.first) - 1
            name = self.surface.name
            yield replace(frame, truth={name: last}, pose_stamps={name: self.first[-1]})

    def _miss(self, image: NDArray[np.float32]) -> None:
        """Count a frame without the board, and keep some of them, spread over all."""
        if self.unseen % self._every == 0:
            self._missed.append(image)
        self.unseen += 1
        if len(self._missed) > _MOST_MISSED:
            self._missed, self._every = self._missed[::2], 2 * self._every

    def described_otherwise(self) -> str | None:
        """Return the other descriptions with which the board is found in frames where it was not; None: none.

        Tried are: width and height exchanged, bright and dark exchanged, a row and a column of tiles more or
        fewer.
        """
        found: dict[str, int] = {}
        for words, surface in _other_descriptions(self.surface):
            targets = targets_of(surface)
            if targets is not None:
                seen = [find_board(one, surface, targets, self.camera.optics) for one in self._missed]
                found[words] = sum(found_board is not None for found_board in seen)
        most = max(found.values(), default=0)
        if not most:
            return None
        words = ", or ".join(name for name, count in found.items() if count == most)
        return f"{words}, it is found in {most} of {len(self._missed)} that were looked at again"

    def _rests(
        self, reference: tuple[NDArray[np.float32], FoundBoard, Any], image: NDArray[np.float32]
    ) -> bool:
        before, found, _ = reference
        if not _alike(before, image, found.points):
            return False
        if self.targets.circles:
            again = find_board(image, self.surface, self.targets, self.camera.optics, near=found.pose)
            if again is None or again.points.shape != found.points.shape:
                return False
            return _common_motion(found.points, again.points - found.points) < _REST
        moved = [_settled(one, found.points) for one in (before, image)]
        return _common_motion(found.points, moved[1] - moved[0]) < _REST


def _other_descriptions(surface: Surface) -> Iterator[tuple[str, Surface]]:
    """Yield other surfaces that the board may be, each with the change of the scene file in words."""
    texture, size = surface.texture, surface.size
    if texture is None or size is None:
        return
    values = texture.values.values
    exchanged = (size[1], size[0])
    yield f"with size: [{exchanged[0]:g}, {exchanged[1]:g}]", replace(surface, size=exchanged)
    opposite = replace(texture, values=NestedList(values.max() + values.min() - values))
    yield "with bright and dark tiles exchanged", replace(surface, texture=opposite)
    for step in (1, -1):
        other = (size[0] + step * texture.cell[0], size[1] + step * texture.cell[1])
        if min(other) > 0:
            stated = f"with size: [{other[0]:g}, {other[1]:g}], which counts tiles and not corners"
            yield stated, replace(surface, size=other)


def _alike(before: NDArray[np.float32], image: NDArray[np.float32], points: Array) -> bool:
    """Whether two images look the same in and around the rectangle of points (n, 2)."""
    height, width = image.shape
    u0, v0 = (max(int(one) - _WINDOW, 0) for one in points.min(axis=0))
    u1, v1 = (int(one) + _WINDOW + 2 for one in points.max(axis=0))
    own, other = (one[v0 : min(v1, height), u0 : min(u1, width)].ravel() for one in (before, image))
    if np.ptp(own) == 0 or np.ptp(other) == 0:
        return False
    return float(np.corrcoef(own, other)[0, 1]) > _ALIKE


def _settled(image: NDArray[np.float32], points: Array) -> Array:
    height, width = image.shape
    room = _WINDOW + 2
    inside = (points > room).all(axis=1) & (points < (width - room, height - room)).all(axis=1)
    result = points.copy()
    if inside.any():
        start = points[inside].astype(np.float32).reshape(-1, 1, 2).copy()
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        moved = cv2.cornerSubPix(image, start, (_WINDOW, _WINDOW), (-1, -1), criteria)
        result[inside] = np.asarray(moved, float).reshape(-1, 2)
    return result


def _common_motion(points: Array, shifts: Array) -> float:
    """Return the RMS [px] of the affine motion that points (n, 2) have in common, less that of noise."""
    centred = (points - points.mean(axis=0)) / float(np.ptp(points) + 1e-9)
    design = np.column_stack([np.ones(len(points)), centred])
    # the median first: single points that were lost say nothing about the board
    size = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    good = size <= 4 * float(np.median(size)) + 1e-6
    if good.sum() < 4:
        return float("inf")
    fitted = design[good] @ np.linalg.lstsq(design[good], shifts[good], rcond=None)[0]
    count = int(good.sum())
    noise = float(np.sum((shifts[good] - fitted) ** 2)) / max(2 * count - 6, 1)
    common = float(np.mean(np.sum(fitted**2, axis=1)))
    return float(np.sqrt(max(common - 4 * noise * 3 / count, 0.0)))


def board_of(scene: Scene) -> Surface:
    """Return the surface of a scene that is a board whose poses are to be found.

    Raises `InputError` where there is none, or more than one.
    """
    boards = [
        surface for surface in scene.surfaces if surface.pose == TRUTH and targets_of(surface) is not None
    ]
    if len(boards) == 1:
        return boards[0]
    if boards:
        raise InputError(
            f"the scene has {len(boards)} boards: {', '.join(board.name for board in boards)}",
            place="surfaces",
            remedy="give a scene file with one of them",
        )
    raise InputError(
        "the scene has no board with pose: truth",
        place="surfaces",
        remedy="a rectangle with the texture of a checkerboard, markers or circles: rim board writes one",
    )
