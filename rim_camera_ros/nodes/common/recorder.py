"""Records the topics of a namespace: messages go to the file as they come, still serialised."""

from __future__ import annotations

import contextlib
import queue
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
import rclpy.utilities
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from rim_camera_ros.bags import KNOWN_ROLES, ROLES, RecordingWriter, Topics
from rim_camera_ros.bags.topics import CAMERA_INFO, FURTHER_IMAGES, POSE_ROLES
from rim_camera_ros.coverage.frames import Message
from rim_camera_ros.coverage.live import LAST_WORDS, LiveCoverage
from rim_camera_ros.coverage.picture import Report
from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.nodes.common.coverage import CoveragePublisher
from rim_camera_ros.nodes.common.messages import ros_class

#: Messages of a topic that may wait to be written.
_DEPTH = 200
#: Seconds that messages of the last frame may take to arrive.
_GRACE = 1.0
#: Seconds after the first image within which a frame with all its parts must come, and most bytes held then.
_BEGINNING = 2.0
_HELD_BYTES = 128 << 20
#: Roles of the messages of one frame.
_PARTS = frozenset({"distance", "amplitude", "frame_info"})
_OF_FRAMES = _PARTS | {"camera_info"}
#: Seconds between two looks for new publishers.
_LOOK = 0.1
#: Every message here begins with a header: encapsulation (4 bytes), seconds, nanoseconds.
_STAMP = struct.Struct("<4xiI")


@dataclass(frozen=True, slots=True)
class _Message:
    role: str
    topic: str
    kind: str
    stamp: int
    data: bytes


class Recorder:
    """Subscribes to all roles of ``topics`` and writes what comes, each message once.

    ``frames`` counts distance images. A subscription is made when a publisher appears, reliable where all
    publishers of the topic are (then nothing is lost), else best effort, which suits every publisher.

    The topics are discovered one by one: messages before the first frame with distance, amplitude and
    frame_info are skipped. If no such frame comes within `_BEGINNING` seconds (a driver without frame_info),
    all messages are kept.
    """

    def __init__(
        self,
        topics: Topics,
        writer: RecordingWriter,
        *,
        frames: int | None = None,
        watch: Callable[[Message], None] | None = None,
    ) -> None:
        self._topics = topics
        self._watch = watch
        self._writer = writer
        self._wanted = frames
        self._last: int | None = None
        self._held: list[_Message] | None = []
        self._parts: dict[int, set[str]] = {}
        self._held_bytes = 0
        self._first_image: float | None = None
        self.frames = 0
        self._lead = ""
        self.node = rclpy.create_node("recorder")
        self._known: dict[str, tuple[QoSProfile, Any]] = {}
        self._routes = {
            topics.paired_info(role): ("camera_info", CAMERA_INFO) for role in ("distance", "depth")
        }
        self._routes |= {
            topics[role]: (role, kind) for role, (_, kind) in KNOWN_ROLES.items() if role not in POSE_ROLES
        }

    def look(self) -> None:
        """Subscribe to topics that have appeared since the last call, with the QoS that publishers offer."""
        for topic, kinds in self.node.get_topic_names_and_types():
            route = self._routes.get(topic) or self._pose_route(topic)
            if route is not None and route[1] in kinds:
                role, kind = route
                offers = [
                    topic_endpoint_info.qos_profile
                    for topic_endpoint_info in self.node.get_publishers_info_by_topic(topic)
                ]
                if offers:
                    self._subscribe(role, topic, kind, _suiting(role, offers))

    def _pose_route(self, topic: str) -> tuple[str, str] | None:
        for role in POSE_ROLES:
            if self._topics.surface_of(topic, role=role):
                return role, ROLES[role][1]
        return None

    def _subscribe(self, role: str, topic: str, kind: str, qos: QoSProfile) -> None:
        known = self._known.get(topic)
        if known is not None and known[0] == qos:
            return

        def take(data: bytes) -> None:
            self._take(role, topic, kind, bytes(data))

        if known is not None:
            # before the new one is made: a message received twice would look like a stamp that does not
            # advance
            self.node.destroy_subscription(known[1])
        made = self.node.create_subscription(ros_class(kind), topic, take, qos, raw=True)
        self._known[topic] = (qos, made)

    def _take(self, role: str, topic: str, kind: str, data: bytes) -> None:
        if len(data) < _STAMP.size or data[1] not in (0, 1):
            return
        layout = _STAMP if data[1] == 1 else struct.Struct(">4xiI")
        seconds, nanoseconds = layout.unpack_from(data)
        stamp = max(seconds * NANOSECONDS + nanoseconds, 0)
        message = _Message(role, topic, kind, stamp, data)
        if self._held is None or not (role in _OF_FRAMES or role in FURTHER_IMAGES):
            self._write(message)
            return
        self._held.append(message)
        self._held_bytes += len(data)
        # with several frequencies the first image stands for the frame
        part = role.removesuffix("_0")
        if part == "distance" and self._first_image is None:
            self._first_image = time.monotonic()
        parts = self._parts.setdefault(stamp, set())
        parts.add(part)
        if parts >= _PARTS:
            self._begin(stamp)
        elif self._held_bytes > _HELD_BYTES:
            self._begin(0)

    def _begin(self, first: int) -> None:
        """Write the held messages from the stamp ``first`` on, and from now on all that come."""
        held, self._held = self._held or [], None
        self._parts.clear()
        for one in held:
            if one.stamp >= first:
                self._write(one)

    def _write(self, message: _Message) -> None:
        if self._last is not None and message.stamp > self._last:
            return
        self._writer.write_serialised(message.role, message.topic, message.kind, message.stamp, message.data)
        if self._watch is not None:
            surface = self._topics.surface_of(message.topic, role=message.role) or ""
            self._watch(Message(message.role, surface, message.kind, message.data))
        if message.role in ("distance", "distance_0"):
            self._lead = self._lead or message.role
        if message.role == self._lead:
            self.frames += 1
            if self.frames == self._wanted:
                self._last = message.stamp

    def wait_no_longer(self, *, at_once: bool = False) -> None:
        """Keep the held messages although no frame had all its parts, once the time for it is over."""
        if self._held is None or self._first_image is None:
            return
        if at_once or time.monotonic() - self._first_image > _BEGINNING:
            self._begin(0)

    @property
    def complete(self) -> bool:
        """Whether all requested frames have come."""
        return self._last is not None


def _suiting(role: str, offers: list[QoSProfile]) -> QoSProfile:
    """Return the best profile that all publishers offer; poses published earlier are requested too."""
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    kept = role in POSE_ROLES and all(
        offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers
    )
    return QoSProfile(
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
    )


def record(
    topics: Topics,
    writer: RecordingWriter,
    *,
    frames: int | None,
    duration: float | None,
    show: Callable[[int], Any],
    stopped: Callable[[], bool],
    known: tuple[Path, Path] | None = None,
    report: Callable[[Report], None] | None = None,
    hurried: Callable[[], bool] = lambda: False,
) -> int:
    """Record until so many frames, so many seconds, or ``stopped()``; return the number of frames.

    ``show`` is called with the number of frames so far. With the files of a ``known`` scene and camera, the
    coverage of the recording is published meanwhile (`CoveragePublisher`) and given to ``report``. At the end
    it waits for the last report, unless ``hurried()``.
    """
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    reports: queue.SimpleQueue[Report] = queue.SimpleQueue()
    live = None if known is None else LiveCoverage(*known, reports.put)
    recorder = Recorder(topics, writer, frames=frames, watch=None if live is None else live.take)
    publisher = None if live is None else CoveragePublisher(recorder.node, topics.namespace)

    def publish() -> None:
        while publisher is not None and not reports.empty():
            found = reports.get()
            publisher.publish(found)
            if report is not None:
                report(found)

    start = time.monotonic()
    looked, ended = 0.0, None
    try:
        with contextlib.suppress(ExternalShutdownException):
            while not stopped():
                now = time.monotonic()
                if ended is None and (
                    recorder.complete or (duration is not None and now - start >= duration)
                ):
                    ended = now
                if ended is not None and now - ended >= (_GRACE if recorder.complete else 0.0):
                    break
                if now - looked >= _LOOK:
                    recorder.look()
                    looked = now
                rclpy.spin_once(recorder.node, timeout_sec=0.05)
                recorder.wait_no_longer()
                show(recorder.frames)
                publish()
        recorder.wait_no_longer(at_once=True)
    finally:
        if live is not None:
            live.close(patience=0.0 if hurried() else LAST_WORDS)
            publish()
        recorder.node.destroy_node()
        rclpy.utilities.try_shutdown()
    return recorder.frames
