"""A camera that simulates the frames of a scene."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.devices.pace import Pace
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.errors import DeviceError, InputError
from rim_camera_ros.frame import NANOSECONDS, RawFrame
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.scene import Scene

#: A frame is begun before it is due by this factor times the time that frames take.
_LEAD = 1.2
#: Factor per frame by which a long computing time is forgotten.
_FORGET = 0.9


class Simulator:
    """Simulates a scene as a `rim_camera_ros.devices.base.Device`.

    ``real_time``: a frame is delivered when it is due by ``frame_rate`` (Hz; None: as the schedule says) and
    stamped with that time. If simulating takes longer than a period, frames are skipped, not queued. Stations
    follow each other at once, and the uptime starts at that of the first station and runs with the clock.
    Without ``real_time`` frames come as fast as they can be made, and stamps advance by the rate from
    ``start`` [ns since 1970; None: now]. ``integration_time`` (device's own unit; None: as the schedule
    says) applies to all stations. ``repeat``: the schedule starts anew at its end, and unless in
    ``real_time`` the camera does, too.

    The first frame is made by ``open``, which therefore raises the error if a scene cannot be simulated.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        *,
        seed: int = 0,
        frame_rate: float | None = None,
        integration_time: float | None = None,
        real_time: bool = True,
        waveform: Waveform | None = None,
        repeat: bool = False,
        start: int | None = None,
    ) -> None:
        self.scene = scene
        self.camera = camera
        self.seed = seed
        self.real_time = real_time
        self.waveform = waveform
        self.repeat = repeat
        self._start = start
        self._given_rate = None if frame_rate is None else checked_rate(frame_rate)
        self._given_integration_time = (
            None if integration_time is None else checked_integration_time(integration_time)
        )
        self._timeline: Timeline | None = None
        self._first: RawFrame | None = None
        self._pace = Pace()
        self._lead = 0.0

    @property
    def frame_rate(self) -> float:
        """Frames per second at present."""
        if self._timeline is not None:
            return self._timeline.rate
        return self._given_rate if self._given_rate is not None else Timeline.rate_of(self.scene)

    @property
    def image_roles(self) -> tuple[str, ...]:
        """Roles of the images of its frames."""
        return measurement_of(self.camera).image_roles(self.camera)

    @property
    def skipped(self) -> int:
        """Number of frames that were skipped because they would have come too late."""
        return self._pace.skipped

    @property
    def notes(self) -> set[str]:
        """Messages for the user (a term that is off for lack of data)."""
        return self._simulation.notes if self._timeline is not None else set()

    def open(self) -> None:
        """Make the first frame; a no-op when the device is open.

        Raises `InputError` where the camera sees nothing of the scene or a surface has no pose.
        """
        if self._timeline is not None:
            return
        self._simulation = measurement_of(self.camera).simulation(
            self.camera, self.scene, seed=self.seed, waveform=self.waveform
        )
        self._begin = self._start if self._start is not None else time.time_ns()
        timeline = Timeline(
            self.scene,
            self.camera,
            start=self._begin,
            integration_time=self._given_integration_time,
            rate=self._given_rate,
            repeat=self.repeat,
            real_time=self.real_time,
        )
        exposure = timeline.next()
        assert exposure is not None  # a schedule has at least one station of at least one frame
        self._first = self._simulation.frame(exposure)
        self._pace = Pace()
        self._origin: int | None = None
        self._timeline = timeline

    def next_frame(self) -> RawFrame | None:
        """Return the next frame when it is due; None at the end of the schedule, or once closed.

        Raises `DeviceError` if the device is not open, `InputError` if no surface is in view any more.
        """
        timeline = self._timeline
        if timeline is None:
            if self._pace.interrupted:
                return None
            raise DeviceError("the simulator is not open", remedy="open it first")
        frame, self._first = self._first, None
        if not self.real_time:
            if frame is None:
                exposure = timeline.next()
                frame = None if exposure is None else self._simulation.frame(exposure)
            return frame
        due = self._pace.next(round(NANOSECONDS / timeline.rate))
        if self._origin is None:
            self._origin = due
        if frame is None:
            if not self._pace.wait(due - round(self._lead * _LEAD * NANOSECONDS)):
                return None
            begun = time.monotonic()
            exposure = timeline.next(stamp=self._begin + due - self._origin)
            if exposure is None:
                return None
            frame = self._simulation.frame(exposure)
            self._lead = max(time.monotonic() - begun, self._lead * _FORGET)
        if not self._pace.wait(due):
            return None
        # the timeline runs on a clock that is never set; only delivered frames are on the wall clock
        shift = self._pace.wall(due) - (self._begin + due - self._origin)
        return replace(frame, stamp=frame.stamp + shift, pose_stamps=shifted(frame.pose_stamps, shift))

    def set_integration_time(self, value: float | None) -> None:
        """Set the integration time (device's own unit) from the next frame on; None: as the schedule says.

        Raises `InputError` where it is not positive.
        """
        self._given_integration_time = None if value is None else checked_integration_time(value)
        if self._timeline is not None:
            self._timeline.set_integration_time(self._given_integration_time)

    def set_frame_rate(self, value: float | None) -> None:
        """Set the frame rate in Hz from the next frame on; None: as the schedule says.

        Raises `InputError` where it is not positive.
        """
        self._given_rate = None if value is None else checked_rate(value)
        if self._timeline is not None:
            self._timeline.set_rate(self._given_rate)

    def close(self) -> None:
        """End the simulation, from any thread; a pending frame does not come."""
        self._timeline = None
        self._first = None
        self._pace.interrupt()


def shifted(stamps: Mapping[str, int], shift: int) -> dict[str, int]:
    """Return stamps [ns] by name, all later by ``shift`` [ns]."""
    return {name: stamp + shift for name, stamp in stamps.items()}


def checked_rate(value: float) -> float:
    """Return a frame rate in Hz. Raises `InputError` where it is not positive and finite."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"frame rate {value:g} Hz is not positive", place="frame_rate")
    return float(value)


def checked_integration_time(value: float) -> float:
    """Return an integration time. Raises `InputError` where it is not positive and finite."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"integration time {value:g} is not positive", place="integration_time")
    return float(value)
