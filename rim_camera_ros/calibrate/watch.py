"""Progress of a calibration, and how it is cancelled."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from rim_camera_ros.bags import Topics
from rim_camera_ros.calibrate.reduction import reduce_recording
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import RimError
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.scene import Scene

#: What is done, how much of it, of how much (None: unknown).
Progress = Callable[[str, int | None, int | None], None]
#: Reduces the recordings to stations, in their order.
Reducer = Callable[[Sequence[Path], Camera, Topics | None, Sequence[Scene]], Sequence[Dataset]]


class Cancelled(RimError):
    """The work was cancelled; nothing was written."""


class Watch:
    """Tells progress and ends the work where it is cancelled."""

    def __init__(self, progress: Progress | None, cancelled: Callable[[], bool] | None) -> None:
        self._progress = progress
        self._cancelled = cancelled

    def tick(self) -> None:
        """Raise `Cancelled` where the work is to end."""
        if self._cancelled is not None and self._cancelled():
            raise Cancelled("cancelled; nothing was written")

    def say(self, text: str) -> None:
        """Tell what begins now. Raises `Cancelled`."""
        self.tick()
        if self._progress is not None:
            self._progress(text, None, None)

    def ticking(self, text: str) -> Callable[[], None]:
        """Tell what begins now, and return what its loop is to call."""
        self.say(text)
        return self.tick

    def reducer(self, total: int) -> Reducer:
        """Return the reduction in this process, one recording after the other."""
        done = [0]

        def watched(frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
            for frame in frames:
                self.tick()
                yield frame
                done[0] += 1
                if self._progress is not None:
                    self._progress("reading frames", done[0], total)

        def reduce_all(
            paths: Sequence[Path], camera: Camera, topics: Topics | None, scenes: Sequence[Scene]
        ) -> list[Dataset]:
            return [
                reduce_recording(path, camera, topics=topics, scene=scene, progress=watched)
                for path, scene in zip(paths, scenes, strict=True)
            ]

        return reduce_all
