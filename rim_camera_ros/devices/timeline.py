"""Exposures over time: a scene's schedule, or the stamps, settings and poses of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import NANOSECONDS, Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure
from rim_camera_ros.scene import Scene, Station

#: Integration time where neither scene nor camera file states one.
DEFAULT_INTEGRATION_TIME = 100.0
#: Ambient temperature in degC where the scene states none.
DEFAULT_AMBIENT = 20.0
#: The camera body warms by this many degC above ambient, with this time constant in seconds.
SELF_HEATING = 18.0
SELF_HEATING_TIME = 120.0


def body_temperature(*, ambient: float, uptime: float) -> float:
    """Return the simulated temperature of the camera body in degC, ``uptime`` seconds after power-on."""
    return ambient + SELF_HEATING * (1.0 - math.exp(-uptime / SELF_HEATING_TIME))


class Timeline:
    """The exposures of a scene's schedule, one after the other, with the state that they carry on.

    Without a schedule there is one station without end (`Scene`'s default is 100 frames at 25 Hz: see
    ``length``). If the ``uptime`` of a station lies ahead, time passes until then; if it lies in the past the
    camera was switched off and on. With ``real_time`` there is no waiting or switching: the uptime starts at
    that of the first station and runs on through all stations and repetitions. ``rate`` [Hz] and
    ``integration_time`` (device's own unit), where given, override the schedule. ``repeat``: at its end the
    schedule starts anew, and everything else is as at the beginning (also for a moving camera without a
    schedule, after 100 frames).

    Raises `InputError` where a surface has no pose.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        *,
        start: int = 0,
        uptime: float = 0.0,
        integration_time: float | None = None,
        rate: float | None = None,
        repeat: bool = False,
        real_time: bool = False,
    ) -> None:
        self.scene = scene
        self.camera = camera
        self.repeat = repeat
        self._real_time = real_time
        self._stations = scene.schedule or (Station(),)
        self._endless = not scene.schedule and not (repeat and scene.camera_motion.moves)
        self._station = 0
        self._count = 0
        self._done_stations = 0
        self._uptime = uptime
        self._stamp = start
        self._first = True
        self._entered = start
        scene.poses_for({name: pose.pose for name, pose in self._stations[0].poses.items()})
        self._given_rate = rate
        self._given_integration_time = integration_time
        self._restart()

    @staticmethod
    def rate_of(scene: Scene) -> float:
        """Return the frame rate in Hz with which a scene's schedule begins."""
        return (scene.schedule or (Station(),))[0].rate

    @property
    def rate(self) -> float:
        """Frames per second at present."""
        return self._given_rate if self._given_rate is not None else self._station_rate

    @property
    def integration_time(self) -> float:
        """Integration time at present, in the device's own unit."""
        given = self._given_integration_time
        return given if given is not None else self._station_integration_time

    def set_rate(self, value: float | None) -> None:
        """Override the schedule's rate [Hz] from the next exposure on; None: as the schedule says."""
        self._given_rate = value

    def set_integration_time(self, value: float | None) -> None:
        """Override the schedule's integration time from the next exposure on; None: as the schedule says."""
        self._given_integration_time = value

    @property
    def length(self) -> int:
        """Number of frames of the schedule (100 without one)."""
        return sum(station.frames for station in self._stations)

    @property
    def stamp(self) -> int:
        """Stamp in ns of the coming exposure."""
        return self._stamp

    def next(self, *, stamp: int | None = None) -> Exposure | None:
        """Return the next exposure, or None at the end of a schedule that does not repeat.

        ``stamp`` [ns] sets the time of a camera that runs in real time.
        """
        if self._station >= len(self._stations):
            if not self.repeat:
                return None
            self._station = 0
        station = self._stations[self._station]
        if stamp is not None:
            if not self._first:
                self._uptime += (stamp - self._stamp) / NANOSECONDS
            self._stamp = stamp
        if self._station == 0 and self._count == 0:
            self._restart()
        if self._count == 0:
            self._enter(station)
        exposure = Exposure(
            stamp=self._stamp,
            settings=Settings(
                integration_time=self.integration_time,
                modulation_frequency=self.camera.sensor.modulation_frequency,
                uptime=self._uptime,
                body_temperature=body_temperature(ambient=self._ambient, uptime=self._uptime),
                ambient_temperature=self._ambient,
            ),
            poses=self._current_poses(),
            station=self._done_stations,
            # surfaces at rest have one pose message per station, which distinguishes stations in recordings
            pose_stamp=None if self.scene.camera_motion.moves else self._entered,
        )
        self._first = False
        step = round(NANOSECONDS / self.rate)
        self._stamp += step
        self._uptime += step / NANOSECONDS
        self._count += 1
        if self._count >= station.frames and not self._endless:
            self._count = 0
            self._station += 1
            self._done_stations += 1
        return exposure

    def __iter__(self) -> Iterator[Exposure]:
        while (exposure := self.next()) is not None:
            yield exposure

    def _restart(self) -> None:
        """Restore the state before the first station."""
        self._poses = {name: (pose, self._stamp) for name, pose in self.scene.fixed_poses().items()}
        self._ambient = DEFAULT_AMBIENT
        self._station_rate = self.rate_of(self.scene)
        self._station_integration_time = self.camera.sensor.integration_time or DEFAULT_INTEGRATION_TIME

    def _enter(self, station: Station) -> None:
        self._station_rate = station.rate
        if station.integration_time is not None:
            self._station_integration_time = station.integration_time
        if station.ambient is not None:
            self._ambient = station.ambient
        if station.uptime is not None and (self._first or not self._real_time):
            if station.uptime > self._uptime and not self._first:
                self._stamp += round((station.uptime - self._uptime) * NANOSECONDS)
            self._uptime = station.uptime
        for name, pose in station.poses.items():
            self._poses[name] = (pose.pose, self._stamp)
        self._entered = self._stamp

    def _current_poses(self) -> dict[str, Pose]:
        """Return the present poses: those of surfaces at rest change as the camera moves."""
        motion = self.scene.camera_motion
        return {
            name: motion.carry(pose, (self._stamp - since) / NANOSECONDS)
            for name, (pose, since) in self._poses.items()
        }


def exposures_like(frames: Iterable[RawFrame], scene: Scene, camera: Camera) -> Iterator[Exposure]:
    """Yield exposures with the stamps, settings, temperatures and truth poses of recorded frames.

    Surfaces with ``pose: truth`` have the recorded pose of each frame. The others have the pose of the scene
    file at the first frame, and then move with the camera. Frames with the same pose messages form one
    station; poses of surfaces that are not in the scene are ignored. Raises `InputError` where a truth pose
    is missing.
    """
    surfaces = {surface.name for surface in scene.surfaces}
    first: int | None = None
    station, key = -1, None
    motion = scene.camera_motion
    for frame in frames:
        frame = frame.with_truth_of(surfaces)
        if first is None:
            first = frame.stamp
        poses = scene.poses_for(frame.truth)
        for name in scene.fixed_poses():
            poses[name] = motion.carry(poses[name], (frame.stamp - first) / NANOSECONDS)
        stamps = tuple(sorted(frame.pose_stamps.items()))
        if stamps != key or station < 0:
            station, key = station + 1, stamps
        settings = frame.settings
        if settings.integration_time is None:
            settings = replace(settings, integration_time=camera.integration_time(settings))
        yield Exposure(
            stamp=frame.stamp,
            settings=settings,
            poses=poses,
            station=station,
            # poses of surfaces at rest are published once, also if the recording has none
            pose_stamp=max(frame.pose_stamps.values(), default=None if motion.moves else first),
        )
