"""The correction's topics: a corrected frame as messages of one stamp, for topics with subscribers."""

from __future__ import annotations

from collections.abc import Callable, Set

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from rim_camera_ros.bags.image_transport import compressed, compressed_depth
from rim_camera_ros.bags.topics import CAMERA_INFO, COMPRESSED, IMAGE, ROLES
from rim_camera_ros.frame import CorrectedDistance, CorrectedFrame, RawFrame
from rim_camera_ros.measurement import FrameCorrection
from rim_camera_ros.nodes.common import messages, qos
from rim_camera_ros.nodes.common.handover import CorrectedCloud, Handover
from rim_camera_ros.nodes.common.lifecycle import ManagedNode
from rim_camera_ros.nodes.common.parameters import Values
from rim_camera_ros.pipeline.rectification import rectifier

#: Topics that are not roles of recordings: name, message type.
_FURTHER = {
    "depth_camera_info": ("depth/camera_info", CAMERA_INFO),
    "rectified": ("depth/image_rect", IMAGE),
    "depth_compressed": ("depth/image_raw/compressedDepth", COMPRESSED),
    "rectified_compressed": ("depth/image_rect/compressedDepth", COMPRESSED),
    "flags_compressed": ("flags/image/compressed", COMPRESSED),
}
_ROLES = ("points", "sigma", "flags", "corrected_distance", "depth")
_RECTIFIED = {"rectified", "rectified_compressed"}
#: Outputs that need sigma and flags, and those that need the depth.
_WHOLE = {"sigma", "flags", "flags_compressed"}
_DEPTH = {"depth", "depth_compressed", *_RECTIFIED}


class CorrectedPublishers:
    """Publishers of the corrected frames; ``values`` are the correction's parameters.

    ``clouds`` also hands points and sigma to a node in the same process. ``expired`` returns for a stamp [ns]
    whether its corrected frame is too old to be published; ``expirations`` counts such frames.
    """

    def __init__(
        self,
        node: ManagedNode,
        values: Values,
        *,
        clouds: Handover[CorrectedCloud],
        expired: Callable[[int], bool],
    ) -> None:
        self._node = node
        self._expired = expired
        self.expirations = 0
        self._clouds = clouds
        self._values = values
        self._of: dict[str, Publisher] = {}
        self._cloud: messages.CloudMessage | None = None
        for role, (topic, kind) in ({role: ROLES[role] for role in _ROLES} | _FURTHER).items():
            self._of[role] = self._publisher(kind, topic, "qos.points" if role == "points" else "qos.images")

    def wait_until_received(self, seconds: float) -> None:
        """Wait until reliable subscribers have received everything, at most ``seconds`` for each topic."""
        for publisher in self._of.values():
            publisher.wait_for_all_acked(Duration(seconds=seconds))

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in self._of.values():
            self._node.destroy_publisher(publisher)

    def publish(
        self, correction: FrameCorrection, frame: RawFrame, frame_id: str, *, whole: bool
    ) -> CorrectedFrame | None:
        """Correct a frame and publish it on the topics that have subscribers.

        ``whole``: correct it in any case, and return it with sigma and flags.
        """
        wanted = {role for role, publisher in self._of.items() if publisher.get_subscription_count() > 0}
        handed = self._clouds.wanted
        if not wanted and not whole and not handed:
            return None
        head = messages.header(frame.stamp, frame_id)
        fields = self._values["points.fields"].split("+")
        further = "points" in wanted and len(fields) > 1
        full = correction.correct(frame) if whole or handed or further or wanted & _WHOLE else None
        corrected: CorrectedDistance = correction.correct_distance(frame) if full is None else full
        points: NDArray[np.float32] | None = None
        cloud: PointCloud2 | None = None
        if full is not None and (handed or further):
            points = correction.cloud(full)
            if "points" in wanted:
                sigma = full.sigma if "sigma" in fields else None
                flags = full.flags if "flags" in fields else None
                cloud = messages.cloud(points, head, sigma=sigma, flags=flags)
        elif "points" in wanted:
            if self._cloud is None or self._cloud.points.shape[:2] != frame.shape:
                self._cloud = messages.CloudMessage(frame.shape)
            correction.cloud(corrected, out=self._cloud.points)
            cloud = self._cloud.of(head)
        if (wanted or handed) and self._expired(frame.stamp):
            self.expirations += 1
            return full
        if cloud is not None:  # first, as a node waits for it
            self._of["points"].publish(cloud)
        if points is not None and full is not None:
            self._clouds.put(CorrectedCloud(points, full.sigma, head, frame.stamp))
        if full is not None:
            self._publish_whole(full, wanted, head)
        if "corrected_distance" in wanted:
            self._of["corrected_distance"].publish(messages.image(corrected.distance, head))
        if "depth_camera_info" in wanted:
            self._of["depth_camera_info"].publish(messages.camera_info(correction.camera.intrinsics, head))
        if wanted & _DEPTH:
            self._publish_depth(correction, correction.depth(corrected), wanted, head)
        return full

    def _publish_whole(self, frame: CorrectedFrame, wanted: Set[str], head: Header) -> None:
        if "sigma" in wanted:
            self._of["sigma"].publish(messages.image(frame.sigma, head))
        if "flags" in wanted:
            self._of["flags"].publish(messages.image(frame.flags, head))
        if "flags_compressed" in wanted:
            self._of["flags_compressed"].publish(messages.compressed_image(compressed(frame.flags), head))

    def _publish_depth(
        self, correction: FrameCorrection, depth: NDArray[np.float32], wanted: Set[str], head: Header
    ) -> None:
        images = {"depth": depth}
        if wanted & _RECTIFIED:
            images["rectified"] = rectifier(correction.camera.intrinsics).depth(depth)
        for role, image in images.items():
            if role in wanted:
                self._of[role].publish(messages.image(image, head))
            if (packed := f"{role}_compressed") in wanted:
                self._of[packed].publish(messages.compressed_image(compressed_depth(image), head))

    def _publisher(self, kind: str, topic: str, parameter: str) -> Publisher:
        profile = qos.profile(self._values[parameter])
        return qos.publisher(self._node, messages.ros_class(kind), topic, profile, parameter=parameter)
