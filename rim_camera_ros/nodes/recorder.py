"""Records the topics of a namespace: messages go to the file as they come, still serialised."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any

import rclpy
import rclpy.utilities
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from rim_camera_ros.bags import ROLES, RecordingWriter, Topics
from rim_camera_ros.bags.topics import CAMERA_INFO, POSE
from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.nodes.messages import ros_class

#: Messages of a topic that may wait to be written.
_DEPTH = 200
#: Seconds that messages of the last frame may take to arrive.
_GRACE = 1.0
#: Seconds between two looks for new surfaces.
_LOOK = 0.5
#: Every message here begins with a header: encapsulation (4 bytes), seconds, nanoseconds.
_STAMP = struct.Struct("<4xiI")


class Recorder:
    """Subscribes to all roles of ``topics`` and writes what comes, each message once.

    ``frames`` counts distance images. Best-effort subscriptions are compatible with every publisher.
    """

    def __init__(self, topics: Topics, writer: RecordingWriter, *, frames: int | None = None) -> None:
        self._topics = topics
        self._writer = writer
        self._wanted = frames
        self._last: int | None = None
        self.frames = 0
        self.node = rclpy.create_node("recorder")
        self._known: set[str] = set()
        for role, (_, kind) in ROLES.items():
            if role != "truth":
                self._subscribe(role, topics[role], kind)
        for role in ("distance", "depth"):
            self._subscribe("camera_info", topics.info_beside(role), CAMERA_INFO)

    def _subscribe(self, role: str, topic: str, kind: str) -> None:
        if topic in self._known:
            return
        self._known.add(topic)
        latched = role == "truth"
        qos = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )

        def take(data: bytes) -> None:
            self._take(role, topic, kind, bytes(data))

        self.node.create_subscription(ros_class(kind), topic, take, qos, raw=True)

    def _take(self, role: str, topic: str, kind: str, data: bytes) -> None:
        if len(data) < _STAMP.size or data[1] not in (0, 1):
            return
        layout = _STAMP if data[1] == 1 else struct.Struct(">4xiI")
        seconds, nanoseconds = layout.unpack_from(data)
        stamp = max(seconds * NANOSECONDS + nanoseconds, 0)
        if self._last is not None and stamp > self._last:
            return
        self._writer.write_serialised(role, topic, kind, stamp, data)
        if role == "distance":
            self.frames += 1
            if self.frames == self._wanted:
                self._last = stamp

    @property
    def complete(self) -> bool:
        """Whether all the frames that are wanted have come."""
        return self._last is not None

    def look(self) -> None:
        """Subscribe to the poses of surfaces that have appeared."""
        for topic, kinds in self.node.get_topic_names_and_types():
            if POSE in kinds and self._topics.surface_of(topic):
                self._subscribe("truth", topic, POSE)


def record(
    topics: Topics,
    writer: RecordingWriter,
    *,
    frames: int | None,
    duration: float | None,
    show: Callable[[int], Any],
    stopped: Callable[[], bool],
) -> int:
    """Record until so many frames, so many seconds, or ``stopped()``; return the number of frames.

    ``show`` is called with the number of frames so far.
    """
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    recorder = Recorder(topics, writer, frames=frames)
    start = time.monotonic()
    looked, ended = 0.0, None
    try:
        while not stopped():
            now = time.monotonic()
            if ended is None and (recorder.complete or (duration is not None and now - start >= duration)):
                ended = now
            if ended is not None and now - ended >= (_GRACE if recorder.complete else 0.0):
                break
            if now - looked >= _LOOK:
                recorder.look()
                looked = now
            rclpy.spin_once(recorder.node, timeout_sec=0.05)
            show(recorder.frames)
    except ExternalShutdownException:
        pass
    finally:
        recorder.node.destroy_node()
        rclpy.utilities.try_shutdown()
    return recorder.frames
