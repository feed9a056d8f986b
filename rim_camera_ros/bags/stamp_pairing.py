"""Pairs the messages of one exposure by their exact stamp, as they come; no ROS in here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rim_camera_ros.bags.pairing import History
from rim_camera_ros.frame import NANOSECONDS, RawFrame, Settings

IMAGES = ("distance", "amplitude")
#: Readings that belong to a frame by their stamp, or are the last ones before it.
READINGS = ("temperature", "ambient", "reference")
_SIDES = ("frame_info", *READINGS)

#: Most exposures that may wait for further messages; the second number where they wait for seconds, at up to
#: 100 Hz.
CAPACITY = 32
RELIABLE_CAPACITY = 500
#: Number of stamps of refused messages that are kept, so that their partners are dropped, too.
_REFUSED = 256
#: A reading this far [ns] ahead of the last frame is not kept: many of them would displace the true ones.
_AHEAD = 60 * NANOSECONDS
#: Seconds that a pair of images waits for messages of the kinds that came with the frames before it.
PATIENCE = 0.1
#: Seconds that a pair waits for its frame_info with reliable delivery. Each topic comes in order, but one may
#: lag behind others while publisher and subscriber are matched or a lost packet is sent again.
RELIABLE_PATIENCE = 5.0
_NO_INFO = "a pair without frame_info"


@dataclass(slots=True)
class _Exposure:
    parts: dict[str, Any] = field(default_factory=dict)
    complete_since: float | None = None


class StampPairing:
    """Pairs the distance and amplitude of one stamp, with further messages of that stamp.

    ``images``: the roles of all images of an exposure, distance and amplitude first. ``samples``: roles of
    images that may come with it, as frame_info may.

    ``publishes(role)`` returns whether there is a publisher of frame_info or of a reading. A pair waits
    shortly for such messages if they came with the frame before; for readings the last ones before the frame
    are used otherwise. A pair without its frame_info is dropped if there is a publisher, as its integration
    time is unknown. It waits for frame_info for ``patience`` seconds, or until that of a later frame has
    come, with at most ``capacity`` others. ``dropped`` counts, by reason, messages that did not become
    frames.
    """

    def __init__(
        self,
        publishes: Callable[[str], bool],
        images: Sequence[str] = IMAGES,
        samples: Sequence[str] = (),
        *,
        patience: float = PATIENCE,
        capacity: int = CAPACITY,
    ) -> None:
        self._capacity = capacity
        self._patience = patience
        self._newest_info: int | None = None
        self._images = tuple(images)
        self._samples = tuple(samples)
        self._sides = (*_SIDES, *samples)
        self.dropped: Counter[str] = Counter()
        self._publishes = publishes
        self._waiting: dict[int, _Exposure] = {}
        self._refused: dict[int, None] = {}
        self._newest: int | None = None
        self._readings: dict[str, History] = {}
        self._expected: set[str] | None = None

    def add(self, role: str, stamp: int, value: Any, now: float) -> list[RawFrame]:
        """Take a part of an exposure at ``stamp`` [ns] and return the frames that are ready.

        ``value``: an image (H, W); of frame_info the `Settings` and the device's name; a reading, or None
        where it has no value. ``now`` in s.
        """
        if role in READINGS:
            if self._newest is not None and stamp > self._newest + _AHEAD:
                self.dropped[f"{role} far ahead of the images"] += 1
            else:
                self._readings.setdefault(role, History()).add(stamp, value)
            return self._ready(now)
        if stamp in self._refused:
            return []
        exposure = self._exposure(stamp)
        if role in self._images and role in exposure.parts:
            self.dropped[f"{role} twice with one stamp"] += 1
            return []
        exposure.parts[role] = value
        if role == "frame_info":
            self._newest_info = stamp
        if exposure.complete_since is None and all(image in exposure.parts for image in self._images):
            exposure.complete_since = now
        return self._ready(now)

    def refuse(self, stamp: int, reason: str) -> None:
        """Drop the exposure of a stamp of which one message was refused."""
        if stamp not in self._refused:
            # kept apart from waiting exposures, so that many of them do not displace good frames
            self._refused[stamp] = None
            self._waiting.pop(stamp, None)
            self.dropped[reason] += 1
            while len(self._refused) > _REFUSED:
                del self._refused[next(iter(self._refused))]

    def overdue(self, now: float) -> list[RawFrame]:
        """Return the frames that have waited long enough; ``now`` in s."""
        return self._ready(now) if self._waiting else []

    def _exposure(self, stamp: int) -> _Exposure:
        exposure = self._waiting.get(stamp)
        if exposure is None:
            exposure = self._waiting[stamp] = _Exposure()
            while len(self._waiting) > self._capacity:
                self._drop(next(iter(self._waiting)))
        return exposure

    def _ready(self, now: float) -> list[RawFrame]:
        frames: list[RawFrame] = []
        complete = [stamp for stamp, one in self._waiting.items() if one.complete_since is not None]
        for i, stamp in enumerate(complete):
            exposure = self._waiting[stamp]
            assert exposure.complete_since is not None
            if self._lacks_info(stamp) and now - exposure.complete_since < self._patience:
                break
            newer = i + 1 < len(complete)
            if newer or now - exposure.complete_since >= PATIENCE or not self._awaited(stamp):
                frames += self._take(stamp)
            else:
                break
        return frames

    def _awaited(self, stamp: int) -> bool:
        """Whether a published message that came with the last frame has not come with this one."""
        missing = [role for role in self._sides if not self._came(role, stamp)]
        expected = self._sides if self._expected is None else self._expected
        return any(role in expected and self._publishes(role) for role in missing)

    def _lacks_info(self, stamp: int) -> bool:
        """Whether the frame_info of a pair may still come: topics are delivered in their order."""
        passed = self._newest_info is not None and self._newest_info > stamp
        return "frame_info" not in self._waiting[stamp].parts and not passed and self._publishes("frame_info")

    def _came(self, role: str, stamp: int) -> bool:
        if role not in READINGS:
            return role in self._waiting[stamp].parts
        history = self._readings.get(role)
        found = None if history is None else history.latest(stamp)
        return found is not None and found[0] == stamp

    def _take(self, stamp: int) -> list[RawFrame]:
        for older in list(self._waiting):
            if older == stamp:
                break
            self._drop(older)
        self._refused = {one: None for one in self._refused if one > stamp}
        self._newest = stamp
        self._expected = {role for role in self._sides if self._came(role, stamp)} | {"frame_info"}
        parts = self._waiting.pop(stamp).parts
        if "frame_info" not in parts and self._publishes("frame_info"):
            self.dropped[_NO_INFO] += 1
            return []
        settings, device = parts.get("frame_info", (Settings(), ""))
        readings = {role: self._reading(role, stamp) for role in READINGS}
        return [
            RawFrame(
                stamp=stamp,
                distance=parts[self._images[0]],
                amplitude=parts[self._images[1]],
                images={role: parts[role] for role in (*self._images[2:], *self._samples) if role in parts},
                settings=Settings(
                    integration_time=settings.integration_time,
                    modulation_frequency=settings.modulation_frequency,
                    uptime=settings.uptime,
                    body_temperature=readings["temperature"],
                    ambient_temperature=readings["ambient"],
                    reference_distance=readings["reference"],
                    extra=settings.extra,
                ),
                device=device,
            )
        ]

    def _reading(self, role: str, stamp: int) -> Any:
        history = self._readings.get(role)
        found = None if history is None else history.latest(stamp)
        if history is None or found is None:
            return None
        history.forget(stamp)
        return found[1]

    def _drop(self, stamp: int) -> None:
        exposure = self._waiting.pop(stamp)
        there = [role for role in self._images if role in exposure.parts]
        if len(there) == len(self._images):
            self.dropped[_NO_INFO] += 1
        # a node that starts late receives only one half of the first exposure, which is no fault
        if 0 < len(there) < len(self._images) and self._expected is not None:
            other = next(role for role in self._images if role not in there)
            self.dropped[f"{there[0]} without {other}"] += 1
