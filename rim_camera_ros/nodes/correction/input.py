"""Sources of raw frames for the correction: messages of any driver, or a driver in the same process."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.subscription import Subscription

from rim_camera_ros.bags.stamp_pairing import (
    CAPACITY,
    PATIENCE,
    RELIABLE_CAPACITY,
    RELIABLE_PATIENCE,
    StampPairing,
)
from rim_camera_ros.bags.topics import IMAGE, KNOWN_ROLES
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import Intrinsics, RawFrame
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.nodes.common import messages, qos
from rim_camera_ros.nodes.common.handover import Exposure, Handover
from rim_camera_ros.nodes.common.lifecycle import ManagedNode
from rim_camera_ros.nodes.common.run import Throttle
from rim_camera_ros.nodes.correction.aside import take_messages
from rim_camera_ros.nodes.correction.freshness import Freshness

#: Messages of a topic that may wait while the tables of a new integration time are made: 0.5 s at 100 Hz.
_QUEUE = 50
#: Why frames that wait are dropped.
_DROPPED = "a newer frame was there, or maximum_age was over"
#: Pixels by which camera_info may differ from the camera file without a warning.
_SAME_OPTICS = 2.0
#: Roles in the order in which a driver publishes; messages that wait together are taken in this order.
_ROLES = ("temperature", "ambient", "reference", "frame_info", "camera_info")


@dataclass(frozen=True)
class Receiver:
    """The parts of the correction that an input uses.

    ``camera`` returns the camera of the correction; ``deliver`` takes complete frames, and the optical frame
    of their headers; ``refused`` counts refused messages by role; ``fresh`` decides which frames are dropped
    where the correction is too slow for all; ``samples``: whether to take the data from which distances are
    evaluated.
    """

    node: ManagedNode
    throttle: Throttle
    refused: Counter[str]
    camera: Callable[[], Camera]
    deliver: Callable[[list[RawFrame], str], None]
    fresh: Freshness
    samples: Callable[[], bool]


class Input(Protocol):
    """A source of raw frames."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of messages that did not become frames since `begin`, by reason."""

    def begin(self, delivery: str) -> None:
        """Take frames from now on; ``delivery`` is that of the parameter qos.input."""

    def end(self) -> None:
        """Take no more frames; what was not whole is forgotten."""

    def look(self) -> None:
        """Deliver frames that have waited long enough."""

    def subscriptions(self) -> Iterable[Subscription]:
        """Return what the messages come by."""


class MessageInput:
    """Pairs the messages of a driver into frames.

    Frames are corrected only when no message waits: then the newest is known, and older ones may be dropped.
    """

    def __init__(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._frames = Handover[Exposure]()
        self._frames.connect(receiver.node, self._deliver)
        self._keep_all = False
        self._draining = False
        self._frame_id = ""
        self._from: dict[str, Subscription] = {}
        self._pairing = StampPairing(self._published)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Return how many messages became no frame, and frames were not taken, since `begin`, by reason."""
        return _with_dropped(self._pairing.dropped, self._frames)

    def begin(self, delivery: str) -> None:
        """Subscribe to the driver's topics."""
        profile = qos.profile(delivery, depth=_QUEUE)
        self._keep_all = delivery == qos.RELIABLE
        self._frames.begin(self._hand_on, keep_all=False, surplus=self._receiver.fresh.surplus)
        measurement = measurement_of(self._receiver.camera())
        images = measurement.image_roles(self._receiver.camera())
        samples = measurement.samples if self._receiver.samples() else ()
        patience, capacity = (
            (RELIABLE_PATIENCE, RELIABLE_CAPACITY) if self._keep_all else (PATIENCE, CAPACITY)
        )
        self._pairing = StampPairing(self._published, images, samples, patience=patience, capacity=capacity)
        for role in (*_ROLES, *samples, *reversed(images)):
            topic, kind = KNOWN_ROLES[role]
            take = self._compare if role == "camera_info" else self._taker(role)
            self._from[role] = qos.subscription(
                self._receiver.node, messages.ros_class(kind), topic, take, profile, parameter="qos.input"
            )

    def end(self) -> None:
        """Take no more messages."""
        self._frames.end()
        for subscription in self._from.values():
            self._receiver.node.destroy_subscription(subscription)
        self._from.clear()

    def look(self) -> None:
        """Deliver the frames that have waited long enough for messages that came with earlier frames."""
        self._offer(self._pairing.overdue(time.monotonic()))
        self._deliver()

    def subscriptions(self) -> Iterable[Subscription]:
        """Return what the messages come by."""
        return self._from.values()

    def _published(self, role: str) -> bool:
        known = self._from.get(role)
        return known is not None and self._receiver.node.count_publishers(known.topic_name) > 0

    def _taker(self, role: str) -> Any:
        return lambda message: self._take(role, message)

    def _take(self, role: str, message: Any) -> None:
        """Take a message of a role; an invalid one is counted and logged, and its frame is dropped."""
        if role not in self._from:
            return  # it came while the node was being deactivated
        stamp = messages.stamp_of(message)
        try:
            if stamp < 0:
                raise InputError("the stamp is negative")
            value = self._value(role, message)
        except Exception as error:  # whatever malformed messages cause: the node goes on
            self._pairing.refuse(stamp, f"{role} refused")
            _refuse(self._receiver, role, f"{self._from[role].topic_name}: message", error)
            return
        self._offer(self._pairing.add(role, stamp, value, time.monotonic()))
        self._deliver()

    def _offer(self, frames: list[RawFrame]) -> None:
        """Take complete frames; with reliable delivery none is dropped."""
        if self._keep_all:
            self._receiver.deliver(frames, self._frame_id)
            return
        for frame in frames:
            self._frames.put(Exposure(frame, self._frame_id), wake=False)

    def _deliver(self) -> None:
        """Correct one frame; if more wait the executor calls this again, after other callbacks."""
        if self._draining:
            return
        if self._frames.waits:
            self._draining = True
            try:
                rounds = 0  # a flood must not keep it
                while rounds < _QUEUE and take_messages(self._from.values()):
                    rounds += 1
            finally:
                self._draining = False
        self._frames.take_waiting()

    def _hand_on(self, exposure: Exposure) -> None:
        self._receiver.deliver([exposure.frame], exposure.frame_id)

    def _value(self, role: str, message: Any) -> Any:
        if KNOWN_ROLES[role][1] == IMAGE:
            image = messages.image_array(message, role=role)
            _check_shape(image.shape, self._receiver.camera())
            if role.startswith("distance"):
                self._frame_id = message.header.frame_id
            return image
        if role == "frame_info":
            return messages.settings_from(message)
        return messages.range_from(message) if role == "reference" else messages.temperature_from(message)

    def _compare(self, message: Any) -> None:
        try:
            stated, _ = messages.intrinsics_from(message)
        except Exception:
            self._receiver.refused["camera_info"] += 1
            return
        if stated is not None:
            _compare_optics(self._receiver, stated)


class MemoryInput:
    """Takes the frames of a driver in the same process, which are complete."""

    def __init__(self, receiver: Receiver, frames: Handover[Exposure]) -> None:
        self._receiver = receiver
        self._frames = frames
        self._dropped: Counter[str] = Counter()
        frames.connect(receiver.node)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Return how many frames were not taken since `begin`, by reason."""
        return _with_dropped(self._dropped, self._frames)

    def begin(self, delivery: str) -> None:
        """Take frames; with reliable delivery the driver waits for the correction."""
        self._dropped = Counter()
        keep_all = delivery == qos.RELIABLE
        self._frames.begin(self._take, keep_all=keep_all, surplus=self._receiver.fresh.surplus)

    def end(self) -> None:
        """Take no more frames."""
        self._frames.end()

    def look(self) -> None:
        """Take a waiting frame, while the executor is busy with something else."""
        self._frames.take_waiting()

    def subscriptions(self) -> Iterable[Subscription]:
        """Return nothing: there are no messages."""
        return ()

    def _take(self, exposure: Exposure) -> None:
        frame, geometry = exposure.frame, exposure.geometry
        try:
            for image in frame.by_role.values():
                _check_shape(image.shape, self._receiver.camera())
        except InputError as error:
            self._dropped["distance refused"] += 1
            _refuse(self._receiver, "distance", "frame", error)
            return
        if geometry is not None:
            _compare_optics(self._receiver, geometry)
        self._receiver.deliver([frame], exposure.frame_id)


def _with_dropped(dropped: Counter[str], frames: Handover[Exposure]) -> Mapping[str, int]:
    return dropped + Counter({_DROPPED: frames.dropped})


def _refuse(receiver: Receiver, role: str, what: str, error: Exception) -> None:
    receiver.refused[role] += 1
    problem = str(error) if isinstance(error, RimError) else f"{type(error).__name__} {error}"
    receiver.throttle.warn(f"refused {role}", f"{what} refused: {problem}")


def _check_shape(shape: tuple[int, ...], camera: Camera) -> None:
    if shape[:2] != camera.shape:
        (height, width), (rows, columns) = shape[:2], camera.shape
        raise InputError(
            f"an image of {width} x {height} px, but the camera file is for {columns} x {rows}",
            remedy="set the parameter camera to the file of this sensor",
        )


def _compare_optics(receiver: Receiver, stated: Intrinsics) -> None:
    """Warn where the optics of camera_info differ from those of the camera file, which is used."""
    if (stated.height, stated.width) != receiver.camera().shape:
        return
    ours = receiver.camera().intrinsics
    apart = max(abs(getattr(stated, name) - getattr(ours, name)) for name in ("fx", "fy", "cx", "cy"))
    if apart > _SAME_OPTICS:
        receiver.throttle.warn(
            "optics",
            f"camera_info differs from the camera file's optics by up to {apart:.1f} px; points are "
            "computed with the camera file",
        )
