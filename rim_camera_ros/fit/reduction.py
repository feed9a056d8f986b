"""The reduction of a recording to stations: a pure function of recording and camera, for any process.

Sums are integers where the recording holds counts, so that they are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.common_variation import common_variation
from rim_camera_ros.fit.data import KEPT_FRAMES, Array, Dataset, Station
from rim_camera_ros.fit.neighbours import neighbours_of
from rim_camera_ros.frame import NANOSECONDS, RawFrame, Settings
from rim_camera_ros.scene import Scene

#: A pose that lasts longer is cut into blocks, so that drifts can be followed [s].
BLOCK_SECONDS = 5.0
#: Blocks become longer where a recording would have more of them than this.
MOST_BLOCKS = 400
#: Frames without settings at the beginning that may wait for the first with them.
_MOST_WAITING = 64


class _Block:
    """Integer sums of the frames of one station."""

    def __init__(self, first: RawFrame, camera: Camera, pose: int, placement: int) -> None:
        self._camera = camera
        self.pose, self.placement = pose, placement
        self.first = first
        # either image may hold integer counts, or metres (distances) and floating-point numbers (amplitudes)
        self._counts = first.distance.dtype == np.uint16
        self._whole_amplitudes = first.amplitude.dtype == np.uint16
        self._period = round(camera.sensor.ambiguity / camera.sensor.lsb) if camera.sensor.wraps else 0
        shape = first.distance.shape
        whole = np.int64 if self._counts else np.float64
        whole_amplitude = np.int64 if self._whole_amplitudes else np.float64
        self._reference: Array = np.zeros(shape, np.int32 if self._counts else np.float64)
        self._seen = np.zeros(shape, bool)
        self._count = np.zeros(shape, np.int32)
        self._saturated = np.zeros(shape, np.int32)
        self._sums: list[Array] = [
            np.zeros(shape, kind) for kind in (whole, whole, whole_amplitude, whole_amplitude)
        ]
        self._stamps: list[int] = []
        self._settings: list[Settings] = []
        self._kept: list[Array] = []

    def add(self, frame: RawFrame) -> None:
        self._stamps.append(frame.stamp)
        self._settings.append(frame.settings)
        if self._counts:
            valid = frame.distance != 0
            value: Array = frame.distance.astype(np.int32)
        else:
            valid = np.isfinite(frame.distance) & (frame.distance > 0)
            value = np.where(valid, frame.distance, 0.0).astype(np.float64)
        if self._whole_amplitudes:
            amplitude: Array = frame.amplitude.astype(np.int64)
        else:
            valid = valid & np.isfinite(frame.amplitude)
            amplitude = np.nan_to_num(frame.amplitude.astype(np.float64))
        saturated = frame.amplitude >= self._camera.sensor.saturation
        self._saturated += saturated
        valid = valid & ~saturated
        new = valid & ~self._seen
        self._reference[new] = value[new]
        self._seen |= valid
        difference = value - self._reference
        period = self._period if self._counts else self._camera.sensor.ambiguity
        if self._camera.sensor.wraps:
            half = period // 2 if self._counts else period / 2
            difference = (difference + half) % period - half
        difference[~valid] = 0
        amplitude = np.where(valid, amplitude, 0)
        wide = difference.astype(self._sums[0].dtype)
        self._count += valid
        self._sums[0] += wide
        self._sums[1] += wide * wide
        self._sums[2] += amplitude
        self._sums[3] += amplitude * amplitude
        if len(self._kept) < KEPT_FRAMES:
            lsb = self._camera.sensor.lsb if self._counts else 1.0
            phase = value.astype(np.float32) * np.float32(2 * np.pi * lsb / self._camera.sensor.ambiguity)
            self._kept.append(np.where(valid, amplitude, 0) * np.exp(1j * phase).astype(np.complex64))

    def station(self, recording: int, start: int) -> Station:
        lsb = self._camera.sensor.lsb if self._counts else 1.0
        n = self._count
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = self._reference + self._sums[0] / n
            if self._camera.sensor.wraps:
                mean %= self._period if self._counts else self._camera.sensor.ambiguity
            variance = (self._sums[1] - self._sums[0].astype(float) ** 2 / n) / (n - 1)
            amplitude = self._sums[2] / n
            amplitude_variance = (self._sums[3] - self._sums[2].astype(float) ** 2 / n) / (n - 1)
        several = n > 1
        middle = (self._stamps[0] + self._stamps[-1]) // 2
        kept = np.stack(self._kept)
        common = common_variation(kept, self._camera.sensor.ambiguity)
        return Station(
            recording=recording,
            pose=self.pose,
            placement=self.placement,
            duration=(self._stamps[-1] - self._stamps[0]) / NANOSECONDS,
            frames=len(self._stamps),
            stamp=middle,
            time=(middle - start) / NANOSECONDS,
            settings=_mean_settings(self._settings),
            truth=self.first.truth,
            distance=np.where(n > 0, mean * lsb, np.nan).astype(np.float64),
            amplitude=np.where(n > 0, amplitude, 0.0).astype(np.float32),
            distance_variance=np.where(several, variance * lsb**2, np.nan).astype(np.float32),
            amplitude_variance=np.where(several, amplitude_variance, np.nan).astype(np.float32),
            count=n,
            saturated=self._saturated.astype(np.uint16),
            common=None if common is None else common.ratio,
            common_light=None if common is None else common.light,
            movement=None if common is None else common.movement,
            neighbours=neighbours_of(kept),
        )


def _mean_settings(settings: list[Settings]) -> Settings:
    """Return the first frame's settings, with the means of quantities that change steadily."""

    def mean(name: str) -> float | None:
        values = [getattr(setting, name) for setting in settings]
        return None if any(v is None for v in values) else float(np.mean(values))

    return replace(
        settings[0],
        uptime=mean("uptime"),
        body_temperature=mean("body_temperature"),
        ambient_temperature=mean("ambient_temperature"),
        reference_distance=mean("reference_distance"),
    )


def reduce_frames(
    frames: Iterable[RawFrame],
    camera: Camera,
    *,
    recording: int = 0,
    block_seconds: float = BLOCK_SECONDS,
    codes: Array | None = None,
    surfaces: Set[str] | None = None,
) -> Iterator[Station]:
    """Yield the stations of a recording's frames; ``codes`` (65536,) is counted up.

    A code counts where it differs from that of the frame before: a stuck pixel is one occurrence of its code.
    Where ``surfaces`` are given, poses of others are ignored: they begin no stations.

    Raises `InputError` for images of another size than the camera's, or another modulation frequency.
    """
    start: int | None = None
    poses: dict[tuple[tuple[str, int], ...], int] = {}
    placement, stated = -1, None
    block: _Block | None = None
    key: Any = None
    last: Array | None = None
    for frame in frames:
        if start is None:
            start = frame.stamp
        check_frame(frame, camera)
        if surfaces is not None:
            frame = frame.with_truth_of(surfaces)
        if frame.truth != stated:
            # a pose that is published again unchanged is the same placement, with the same error
            placement, stated = placement + 1, frame.truth
        messages = tuple(sorted(frame.pose_stamps.items()))
        own = (messages, frame.settings.integration_time)
        late = block is not None and frame.stamp - block.first.stamp > block_seconds * NANOSECONDS
        if block is None or own != key or late:
            if block is not None:
                yield block.station(recording, start)
            block, key = _Block(frame, camera, poses.setdefault(messages, len(poses)), placement), own
        block.add(frame)
        if codes is not None and frame.distance.dtype == np.uint16:
            changed = True if last is None else frame.distance != last
            codes += np.bincount(frame.distance[changed].ravel(), minlength=FULL_SCALE)
            last = frame.distance
    if block is not None and start is not None:
        yield block.station(recording, start)


def of_known_exposure(frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
    """Yield the frames that state their integration time, or all frames where none of the first does.

    Messages of settings can be lost, or begin later than the images; such frames have no known integration
    time.
    """
    waiting: list[RawFrame] = []
    stated = stateless = False
    for frame in frames:
        if frame.settings.integration_time is not None:
            stated = True
            waiting.clear()
        if stated and frame.settings.integration_time is None:
            continue
        if stated or stateless:
            yield frame
            continue
        waiting.append(frame)
        if len(waiting) > _MOST_WAITING:
            stateless = True
            yield from waiting
            waiting.clear()
    yield from waiting


def check_frame(frame: RawFrame, camera: Camera) -> None:
    """Raise `InputError` where a frame cannot be of this camera."""
    if frame.shape != camera.shape:
        raise InputError(
            f"its images have {frame.shape[1]} x {frame.shape[0]} px, "
            f"the camera file {camera.shape[1]} x {camera.shape[0]}",
            remedy="give the camera file of the camera that recorded it",
        )
    frame.require_one_distance()
    camera.check_modulation(frame.settings)


def reduce_recording(
    path: str | PathLike[str],
    camera: Camera,
    *,
    topics: Topics | None = None,
    recording: int = 0,
    scene: Scene | None = None,
    progress: Callable[[Iterable[RawFrame]], Iterable[RawFrame]] | None = None,
) -> Dataset:
    """Return the stations of one recording, a pure function of recording, camera and scene.

    Poses of surfaces that are not in the ``scene``, where one is given, are ignored. ``progress`` wraps the
    iteration over frames. Raises `InputError` naming the recording.
    """
    with Recording(path, topics=topics) as bag:
        summary = bag.summary()
        seconds = max(BLOCK_SECONDS, summary.duration / MOST_BLOCKS)
        frames: Iterable[RawFrame] = of_known_exposure(bag.frames())
        if progress is not None:
            frames = progress(frames)
        try:
            codes = np.zeros(FULL_SCALE, np.int64)
            stations = list(
                reduce_frames(
                    frames,
                    camera,
                    recording=recording,
                    block_seconds=seconds,
                    codes=codes,
                    surfaces=None if scene is None else {surface.name for surface in scene.surfaces},
                )
            )
        except InputError as error:
            raise error.located(path) from None
        notes = list(bag.assumptions)
        if summary.damage:
            notes.append(f"{path}: {summary.damage}: only what could be read is used")
        notes += [f"{path}: excluded: {number} {why}" for why, number in bag.skipped.items() if number]
    return Dataset(
        stations,
        [str(path)],
        notes,
        sum(station.frames for station in stations),
        codes if codes.any() else None,
    )
