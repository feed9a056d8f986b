"""The driver's topics: a frame of a device as messages of one stamp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.publisher import Publisher

from rim_camera_ros.bags.image_transport import JPEG, compressed, compressed_for_looking
from rim_camera_ros.bags.topics import CAMERA_INFO, COMPRESSED, KNOWN_ROLES, POSE, ROLES, SAMPLES, SURFACE
from rim_camera_ros.frame import Intrinsics, Pose, RawFrame
from rim_camera_ros.nodes.common import messages, qos
from rim_camera_ros.nodes.common.lifecycle import ManagedNode
from rim_camera_ros.nodes.common.parameters import Values

#: Ending that image_transport adds to the topic of an image for its compressed form.
_PACKED = "/compressed"


class FramePublishers:
    """Publishers of the raw frames; ``values`` are the driver's parameters, ``images`` the frames' roles.

    ``frame_id``, ``truth`` (publish poses of the scene's surfaces), ``clock`` (publish stamps to /clock) and
    ``geometry`` (in place of that of the frames) may be changed between frames.
    """

    def __init__(
        self, node: ManagedNode, values: Values, images: Sequence[str] = ("distance", "amplitude")
    ) -> None:
        self.images = tuple(images)
        #: topics whose subscribers count for wait_for_subscribers
        self._gate = ("frame_info", *reversed(self.images))
        self._node = node
        self._values = values
        self._of: dict[str, Publisher] = {}
        self._poses: dict[str, tuple[Publisher, tuple[Pose, int] | None]] = {}
        self._clock: Publisher | None = None
        self.frame_id: str = values["frame_id"]
        self.truth: bool = values["publish_truth"]
        self.clock: bool = values["publish_clock"]
        self.geometry: Intrinsics | None = None
        # topics that others wait for are made last: who has discovered them has discovered the rest
        info = KNOWN_ROLES[self.images[0]][0].rpartition("/")[0] + "/camera_info"
        self._of["distance_camera_info"] = self._publisher(CAMERA_INFO, info, "qos.info")
        for role in reversed(self.images):
            topic, kind = KNOWN_ROLES[role]
            self._of[role + _PACKED] = self._publisher(COMPRESSED, topic + _PACKED, "qos.images")
        for role in ("temperature", "ambient", "reference", "camera_info", *self._gate):
            parameter = "qos.images" if role in self.images else "qos.info"
            topic, kind = KNOWN_ROLES[role]
            self._of[role] = self._publisher(kind, topic, parameter)

    def destroy(self) -> None:
        """Remove the topics."""
        clock = [] if self._clock is None else [self._clock]
        for publisher in (*self._of.values(), *(made for made, _ in self._poses.values()), *clock):
            self._node.destroy_publisher(publisher)

    def listeners(self) -> int:
        """Return the least number of subscribers of any of the images and frame_info."""
        return min(self._of[role].get_subscription_count() for role in self._gate)

    def wait_until_received(self, seconds: float) -> None:
        """Wait until reliable subscribers have received everything, at most ``seconds`` for each topic."""
        from rclpy.duration import Duration

        for publisher in self._of.values():
            publisher.wait_for_all_acked(Duration(seconds=seconds))

    def geometry_of(self, frame: RawFrame) -> Intrinsics | None:
        """Return the geometry for camera_info of a frame, None where none fits its size."""
        geometry = self.geometry if self.geometry is not None else frame.intrinsics
        fits = geometry is not None and (geometry.height, geometry.width) == frame.shape
        return geometry if fits else None

    def publish(self, frame: RawFrame) -> None:
        """Publish on the topics that have subscribers; the images come last and complete the frame."""
        frame_id, stamp, settings = self.frame_id, frame.stamp, frame.settings
        head = messages.header(stamp, frame_id)
        if self.clock:
            self._publish_clock(head.stamp)
        if self.truth:
            self._publish_poses(frame)
        for role, value, make in (
            ("temperature", settings.body_temperature, messages.temperature),
            ("ambient", settings.ambient_temperature, messages.temperature),
            ("reference", settings.reference_distance, messages.reference),
        ):
            if value is not None and self._wanted(role):
                self._of[role].publish(make(value, stamp, frame_id))
        if self._wanted("frame_info"):
            self._of["frame_info"].publish(messages.frame_info(settings, stamp, frame.device, frame_id))
        geometry = self.geometry_of(frame)
        if geometry is not None:
            for role in ("camera_info", "distance_camera_info"):
                if self._wanted(role):
                    self._of[role].publish(messages.camera_info(geometry, head))
        self._publish_samples(frame, head)
        for role, pixels in reversed(frame.by_role.items()):
            if role not in self.images:
                continue
            if self._wanted(packed := role + _PACKED) and pixels.dtype.kind == "u":
                lossy = role.startswith("amplitude") and self._values["compressed.format"] == JPEG
                packing = compressed_for_looking if lossy and pixels.dtype == np.uint16 else compressed
                self._of[packed].publish(messages.compressed_image(packing(pixels), head))
            if self._wanted(role):
                self._of[role].publish(messages.image(pixels, head))

    def _publish_samples(self, frame: RawFrame, head: Any) -> None:
        """Publish the data from which distances were evaluated; topics are made once a device delivers it."""
        for role in frame.images.keys() & SAMPLES.keys():
            if role not in self._of:
                topic, kind = SAMPLES[role]
                self._of[role] = self._publisher(kind, topic, "qos.images")
            if self._wanted(role):
                self._of[role].publish(messages.image(frame.images[role], head))

    def _publisher(self, kind: str, topic: str, parameter: str) -> Publisher:
        profile = qos.profile(self._values[parameter])
        return qos.publisher(self._node, messages.ros_class(kind), topic, profile, parameter=parameter)

    def _wanted(self, role: str) -> bool:
        return bool(self._of[role].get_subscription_count() > 0)

    def _publish_clock(self, stamp: Any) -> None:
        from rosgraph_msgs.msg import Clock

        if self._clock is None:
            self._clock = self._node.create_publisher(Clock, "/clock", qos.profile(qos.SENSOR_DATA))
        self._clock.publish(Clock(clock=stamp))

    def _publish_poses(self, frame: RawFrame) -> None:
        """Publish the poses that are new; they are kept for late subscribers."""
        for surface, pose in frame.truth.items():
            stamp = frame.pose_stamps.get(surface, frame.stamp)
            if surface not in self._poses:
                # below the namespace, as two cameras see the same surface from two places
                topic = ROLES["truth"][0].lstrip("/").replace(SURFACE, messages.topic_part(surface))
                # not overridable: a scene has any number of surfaces, and each would have three parameters
                kind = messages.ros_class(POSE)
                made = qos.publisher(self._node, kind, topic, qos.latched(), overridable=False)
                self._poses[surface] = (made, None)
            made, last = self._poses[surface]
            if last != (pose, stamp):
                made.publish(messages.pose(pose, stamp, self.frame_id))
                self._poses[surface] = (made, (pose, stamp))
