"""Frames from messages: images and settings of one exposure by stamp, poses and temperatures by time."""

from __future__ import annotations

import bisect
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from numpy.typing import NDArray

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.images import ENCODINGS
from rim_camera_ros.bags.topics import POSE_ROLES, SAMPLES, is_swissranger_intensity
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics, Pose, RawFrame, Readings, Settings

#: Treatment of a stamp that is not after the one before: an error, or counted.
Backwards = Literal["error", "count"]

#: Most stamps that may wait for the rest of their messages, and most bytes of their image data.
PENDING_STAMPS = 64
PENDING_BYTES = 128 << 20

_LONGEST_HISTORY = 20_000


class History:
    """Values by stamp; those that can no longer be requested are removed."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[Any] = []

    def add(self, stamp: int, value: Any) -> None:
        """Add a value; of two with the same stamp the later one counts."""
        place = bisect.bisect_right(self._stamps, stamp)
        self._stamps.insert(place, stamp)
        self._values.insert(place, value)
        if len(self._stamps) > _LONGEST_HISTORY:
            del self._stamps[0], self._values[0]

    def latest(self, stamp: int) -> tuple[int, Any] | None:
        """Return stamp and value of the last one at or before ``stamp``, None without one."""
        place = bisect.bisect_right(self._stamps, stamp) - 1
        return (self._stamps[place], self._values[place]) if place >= 0 else None

    def forget(self, stamp: int) -> None:
        """Remove the values that are not needed for this stamp or later ones."""
        place = bisect.bisect_right(self._stamps, stamp) - 1
        if place > 0:
            del self._stamps[:place], self._values[:place]


@dataclass(slots=True, eq=False)
class _Exposure:
    stamp: int
    images: dict[str, NDArray[Any]] = field(default_factory=dict)
    others: dict[str, Any] = field(default_factory=dict)
    size: int = 0

    def has(self, role: str) -> bool:
        return role in self.images or role in self.others


class Pairing:
    """Makes frames of decoded messages, in the order of the distance images.

    ``routes``: topic to (role, surface). ``say`` receives sentences on assumptions. ``skipped`` counts
    messages that did not become frames, by reason. At most `PENDING_STAMPS` stamps and `PENDING_BYTES` bytes
    wait. If the recording has poses or temperatures, a frame waits within these limits for those recorded
    after its images, so that the order in the recording does not matter.
    """

    def __init__(
        self, routes: Mapping[str, tuple[str, str]], on_backwards: Backwards, say: Callable[[str], None]
    ) -> None:
        self.skipped: Counter[str] = Counter()
        self._routes = routes
        self._backwards = on_backwards
        self._say = say
        roles = {role for role, _ in routes.values()}
        self._images = tuple(role for role in ENCODINGS if role in roles)
        self._lead = self._images[0] if self._images else "distance"
        self._expected = tuple(role for role in ("camera_info", "frame_info", *SAMPLES) if role in roles)
        self._waits = bool(roles & {"temperature", "ambient", "reference", *POSE_ROLES})
        self._pending: dict[int, _Exposure] = {}
        self._order: deque[_Exposure] = deque()
        self._bytes = 0
        self._last: int | None = None
        self._layout: dict[str, tuple[tuple[int, ...], str]] = {}
        self._sides: dict[str, History] = {}
        self._ambient = Readings()
        self._poses: dict[str, History] = {}
        self._covariances: dict[str, History] = {}
        self._pose_frames: dict[str, str] = {}
        self._frame_id = ""
        self._intrinsics: Intrinsics | None = None

    def add(self, topic: str, message: Any) -> list[RawFrame]:
        """Take a message and return the frames that are ready.

        Raises InputError for a wrong message, a change of the image size and, if chosen so, a stamp that does
        not advance.
        """
        role, surface = self._routes[topic]
        stamp = messages.stamp_of(message)
        place = f"topic {topic} at {messages.stamp_text(stamp)}"
        if role in POSE_ROLES:
            self._pose_frames.setdefault(surface, message.header.frame_id)
            plain = role == "truth"
            histories = self._poses if plain else self._covariances
            pose = (messages.pose_from if plain else messages.pose_with_covariance_from)(message, place)
            histories.setdefault(surface, History()).add(stamp, pose)
            return []
        if role in ("temperature", "ambient", "reference"):
            read = messages.range_from if role == "reference" else messages.temperature_from
            value = read(message)
            self._sides.setdefault(role, History()).add(stamp, value)
            if role == "ambient" and value is not None:
                self._ambient.add(stamp, value)
            return []
        try:
            value = self._value(role, topic, message, place, stamp)
        except InputError:
            self._abandon(stamp)
            raise
        frames: list[RawFrame] = []
        exposure = self._exposure(role, stamp, place, frames)
        if exposure is not None:
            if role in self._images:
                exposure.images[role] = value
            else:
                exposure.others[role] = value
            if hasattr(value, "nbytes"):
                exposure.size += value.nbytes
                self._bytes += value.nbytes
        self._release(frames)
        return frames

    def flush(self) -> list[RawFrame]:
        """Return the frames that still wait, at the end of the recording."""
        frames: list[RawFrame] = []
        while self._order:
            self._emit(frames)
        while self._pending:
            self._drop(next(iter(self._pending)))
        return frames

    def _value(self, role: str, topic: str, message: Any, place: str, stamp: int) -> Any:
        if role == "frame_info":
            return messages.settings_from(message, place)
        if role == "camera_info":
            intrinsics, reason = messages.intrinsics_from(message, place)
            if reason:
                self._say(reason)
            return intrinsics
        image = self._image(role, topic, message, place)
        exposure = self._pending.get(stamp)
        others = exposure.images.items() if exposure is not None else ()
        partner, other = next(((name, one) for name, one in others if name != role), ("", image))
        if other.shape[:2] != image.shape[:2]:
            raise InputError(
                f"the {role} is {_size(image.shape)}, the {partner} {_size(other.shape)}",
                place=place,
                remedy="--topic amplitude=name of the image that belongs to the distance",
            )
        return image

    def _image(self, role: str, topic: str, message: Any, place: str) -> NDArray[Any]:
        eight = role == "amplitude" and is_swissranger_intensity(topic)
        image = messages.image_array(message, role=role, place=place, mono8_amplitude=eight)
        if eight and message.encoding in ("mono8", "8UC1"):
            self._say(f"{topic} is mono8: one step is 256 counts")
        if role == self._lead and not self._frame_id:
            self._frame_id = message.header.frame_id
        layout = (image.shape, str(message.encoding))
        before = self._layout.setdefault(role, layout)
        if layout != before:
            raise InputError(
                f"the image is {_size(layout[0])} {layout[1]}, before it was {_size(before[0])} {before[1]}",
                place=place,
                remedy="split the recording where the camera's mode was changed",
            )
        return image

    def _abandon(self, stamp: int) -> None:
        """Remove an exposure of which one message is wrong, so that it does not become half a frame."""
        exposure = self._pending.pop(stamp, None)
        if exposure is not None and exposure in self._order:
            self._order.remove(exposure)

    def _exposure(self, role: str, stamp: int, place: str, frames: list[RawFrame]) -> _Exposure | None:
        """Return the incomplete exposure of a stamp, None for a message that is not needed."""
        exposure = self._pending.get(stamp)
        if exposure is not None and exposure.has(role):
            if self._backwards == "count" and len(exposure.images) == len(self._images):
                frames += self.flush()  # the next round of a short loop has begun
                exposure = None
            elif role != self._lead or self._backwards == "count":
                self.skipped[f"{role} twice with one stamp"] += 1
                return None
        if role == self._lead:
            if self._last is not None and stamp <= self._last:
                if self._backwards == "error":
                    raise InputError(
                        f"the stamp is not after the one before, {messages.stamp_text(self._last)}",
                        place=place,
                        remedy="a looped or stampless recording: record one pass, stamped by the driver",
                    )
                self.skipped["stamps that run backwards"] += 1
            self._last = stamp
        if exposure is None:
            exposure = self._pending[stamp] = _Exposure(stamp)
        if role == self._lead:
            self._order.append(exposure)
        return exposure

    def _release(self, frames: list[RawFrame]) -> None:
        if not self._waits:
            while self._order and self._complete(self._order[0]):
                self._emit(frames)
        while len(self._pending) > PENDING_STAMPS or (self._bytes > PENDING_BYTES and len(self._pending) > 1):
            oldest = next(iter(self._pending.values()))
            if self._lead in oldest.images:
                while self._emit(frames) is not oldest:
                    pass
            else:
                self._drop(oldest.stamp)

    def _complete(self, exposure: _Exposure) -> bool:
        return len(exposure.images) == len(self._images) and all(
            role in exposure.others for role in self._expected
        )

    def _drop(self, stamp: int) -> None:
        exposure = self._pending.pop(stamp)
        self._bytes -= exposure.size
        what = next(iter(exposure.images), " and ".join(exposure.others))
        self.skipped[f"{what} without {self._lead}"] += 1

    def _emit(self, frames: list[RawFrame]) -> _Exposure:
        """Remove the first waiting exposure, and make a frame of it if it has all images."""
        exposure = self._order.popleft()
        del self._pending[exposure.stamp]
        self._bytes -= exposure.size
        missing = next((role for role in self._images if role not in exposure.images), None)
        if missing is None:
            frames.append(self._frame(exposure))
        else:
            self.skipped[f"{self._lead} without {missing}"] += 1
        return exposure

    def _frame(self, exposure: _Exposure) -> RawFrame:
        stamp, others = exposure.stamp, exposure.others
        for role in self._expected:
            if role not in others:
                self.skipped[f"{role} missing beside a frame"] += 1
        settings, device = others.get("frame_info", (None, ""))
        intrinsics = others.get("camera_info", self._intrinsics)
        if intrinsics is not None:
            self._intrinsics = intrinsics = self._fitting(intrinsics, exposure)
        truth: dict[str, Pose] = {}
        pose_stamps: dict[str, int] = {}
        for surface in dict.fromkeys((*self._poses, *self._covariances)):
            found = self._pose_of(surface, stamp)
            if found is not None:
                pose_stamps[surface], truth[surface] = found
                self._compare_frames(surface)
        settings = self._with_sides(settings, stamp)
        if self._pending:
            earliest = min(self._pending)
            for history in (*self._poses.values(), *self._covariances.values(), *self._sides.values()):
                history.forget(min(earliest, stamp))
        return RawFrame(
            stamp=stamp,
            distance=exposure.images[self._images[0]],
            amplitude=exposure.images[self._images[1]],
            images={role: exposure.images[role] for role in self._images[2:]}
            | {role: others[role] for role in SAMPLES if role in others},
            settings=settings,
            truth=truth,
            pose_stamps=pose_stamps,
            intrinsics=intrinsics,
            device=device,
        )

    def _pose_of(self, surface: str, stamp: int) -> tuple[int, Pose] | None:
        """Return stamp and value of the latest pose, with the covariance if one has the same stamp."""
        pose, certain = (
            histories[surface].latest(stamp) if surface in histories else None
            for histories in (self._poses, self._covariances)
        )
        if pose is None or (certain is not None and certain[0] >= pose[0]):
            return certain
        return pose

    def _with_sides(self, settings: Settings | None, stamp: int) -> Settings:
        sides = {
            role: found[1] for role, side in self._sides.items() if (found := side.latest(stamp)) is not None
        }
        if settings is None:
            settings = Settings(extra={})
        if not sides:
            return settings
        return Settings(
            integration_time=settings.integration_time,
            modulation_frequency=settings.modulation_frequency,
            uptime=settings.uptime,
            body_temperature=sides.get("temperature"),
            ambient_temperature=sides.get("ambient"),
            reference_distance=sides.get("reference"),
            extra=settings.extra,
            ambient_readings=self._ambient if self._ambient.stamps else None,
        )

    def _fitting(self, intrinsics: Intrinsics, exposure: _Exposure) -> Intrinsics | None:
        shape = exposure.images[self._lead].shape
        if (intrinsics.height, intrinsics.width) == shape:
            return intrinsics
        self._say(
            f"camera_info is for {intrinsics.width} x {intrinsics.height} pixels, the images are"
            f" {_size(shape)}: it is not used"
        )
        return None

    def _compare_frames(self, surface: str) -> None:
        given = self._pose_frames.pop(surface, "").lstrip("/")
        images = self._frame_id.lstrip("/")
        if given and images and given != images:
            self._say(
                f"the poses of {surface} are in the frame {given}, taken for that of the images, {images}"
            )


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
