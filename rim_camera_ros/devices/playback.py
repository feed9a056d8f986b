"""A recording that is played back as if the camera delivered it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.bags.topics import SAMPLES
from rim_camera_ros.devices.pace import Pace
from rim_camera_ros.devices.simulator import checked_rate
from rim_camera_ros.errors import DeviceError, InputError, RimError
from rim_camera_ros.frame import NANOSECONDS, RawFrame

#: Frame rate in Hz of a recording whose stamps state none.
DEFAULT_RATE = 25.0


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A recorded frame: ``interval`` [ns] since the last; ``carried``: stamp [ns] that grows over rounds."""

    frame: RawFrame
    interval: int
    carried: int


class Playback:
    """Plays a recording back as a `rim_camera_ros.devices.base.Device`.

    ``real_time``: frames come at the intervals of their stamps divided by ``rate``, or at the constant rate
    ``frame_rate`` [Hz]. None is dropped: if playback is late, all further frames come later. Without
    ``real_time`` frames come as fast as they can be read. ``loop``: at its end the recording begins anew.

    ``stamps``: ``now``, the time at which a frame is due (default in real time), or ``recorded``. In a loop
    stamps keep increasing, in each round by the recording's duration and one period. Settings, temperatures
    and poses are the recorded ones; pose stamps are shifted like that of the first frame with the pose.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        topics: Topics | None = None,
        real_time: bool = True,
        loop: bool = False,
        rate: float = 1.0,
        frame_rate: float | None = None,
        stamps: Literal["now", "recorded"] | None = None,
    ) -> None:
        self.path = Path(path)
        self.topics = topics
        self.real_time = real_time
        self.loop = loop
        self.rate = checked_rate(rate)
        self.stamps = stamps if stamps is not None else ("now" if real_time else "recorded")
        self._given_rate = None if frame_rate is None else checked_rate(frame_rate)
        self._recorded_rate = DEFAULT_RATE
        self._pace = Pace()
        self._stream: Iterator[_Recorded] | None = None
        self._roles: tuple[str, ...] = ("distance", "amplitude")
        self.assumptions: list[str] = []

    @property
    def frame_rate(self) -> float:
        """Frames per second: as set, or the recording's mean times ``rate``."""
        return self._given_rate if self._given_rate is not None else self._recorded_rate * self.rate

    @property
    def image_roles(self) -> tuple[str, ...]:
        """Roles of the images of its frames, by the first frame."""
        return self._roles

    def open(self) -> None:
        """Open the recording and read its first frame; a no-op when it is open.

        Raises `InputError` where it cannot be read or holds no frame.
        """
        if self._stream is not None:
            return
        self._pace = Pace()
        self._poses: dict[str, tuple[int, int]] = {}
        stream = self._rounds()
        self._first = next(stream, None)
        if self._first is not None:
            self._roles = tuple(one for one in self._first.frame.by_role if one not in SAMPLES)
        self._stream = stream

    def next_frame(self) -> RawFrame | None:
        """Return the next frame when it is due; None at the end, or once closed.

        Raises `DeviceError` where the recording cannot be read further, after all readable frames have come.
        """
        stream = self._stream
        if stream is None:
            if self._pace.interrupted:
                return None
            raise DeviceError("the recording is not open", file=self.path, remedy="open it first")
        recorded, self._first = self._first, None
        try:
            recorded = recorded or next(stream, None)
        except RimError as error:
            file = error.file or self.path
            raise DeviceError(error.problem, file=file, place=error.place, remedy=error.remedy) from error
        except Exception as error:  # whatever happens if the file changes while it is read
            problem = f"cannot be read on: {type(error).__name__} {error}"
            raise DeviceError(problem, file=self.path, remedy="check the file") from error
        if recorded is None:
            return None
        now = time.time_ns()
        if self.real_time:
            given = self._given_rate
            interval = recorded.interval / self.rate if given is None else NANOSECONDS / given
            due = self._pace.next(max(round(interval), 1), skip=False)
            if not self._pace.wait(due):
                return None
            now = self._pace.wall(due)
        return self._restamped(recorded.frame, recorded.carried if self.stamps == "recorded" else now)

    def set_integration_time(self, value: float | None) -> None:
        """Raise `InputError`, as a recorded integration time cannot be changed (None is accepted)."""
        if value is not None:
            raise InputError(
                "the integration time of a recording cannot be changed",
                place="integration_time",
                remedy="leave it at 0",
            )

    def set_frame_rate(self, value: float | None) -> None:
        """Set a constant frame rate in Hz from the next frame on; None: as recorded.

        Raises `InputError` where it is not positive.
        """
        self._given_rate = None if value is None else checked_rate(value)

    def close(self) -> None:
        """Close the recording, from any thread; a pending frame does not come."""
        self._pace.interrupt()
        self._stream = None
        self._first = None

    def _rounds(self) -> Iterator[_Recorded]:
        """Read the recording once, or repeatedly in a loop."""
        offset = 0
        last: int | None = None
        with Recording(self.path, topics=self.topics) as recording:
            duration = recording.summary().duration
            if recording.frame_count > 1 and duration > 0:
                self._recorded_rate = (recording.frame_count - 1) / duration
            period = round(NANOSECONDS / self._recorded_rate)
            while True:
                first, count = None, 0
                for frame in recording.frames(on_backwards="count"):
                    if first is None:
                        first = frame.stamp
                        if last is not None:
                            offset += last + period - first
                    step = 0 if last is None or not count else frame.stamp - last
                    last, count = frame.stamp, count + 1
                    yield _Recorded(frame, step if step > 0 else period, frame.stamp + offset)
                    self.assumptions = list(recording.assumptions)
                if not self.loop:
                    return

    def _restamped(self, frame: RawFrame, stamp: int) -> RawFrame:
        if stamp == frame.stamp:
            return frame
        poses: dict[str, int] = {}
        for surface, recorded in frame.pose_stamps.items():
            known = self._poses.get(surface)
            if known is None or known[0] != recorded:
                self._poses[surface] = known = (recorded, stamp)
            poses[surface] = known[1]
        return replace(frame, stamp=stamp, pose_stamps=poses)
