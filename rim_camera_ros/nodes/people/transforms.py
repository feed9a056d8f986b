"""Transforms that other nodes publish on /tf and /tf_static, without tf2_ros, which is only in apt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from rim_camera_ros.nodes.common.qos import latched
from rim_camera_ros.nodes.common.transforms import INSTALL, TOPIC, transform_message
from rim_camera_ros.tracking.transform_tree import TransformTree

_MOVING = "/tf"
#: Messages that may wait, as many as in tf2: those of many nodes may come at once.
_DEPTH = 100


class Transforms:
    """``tree`` holds the transforms of /tf and /tf_static; ``changed`` is called after each message."""

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self.tree = TransformTree()
        self._node = node
        self._changed = changed
        self._from: list[Subscription] = []

    def listen(self, wanted: bool) -> None:
        """Begin to listen, or stop and forget; log a warning where tf2_msgs is missing."""
        if wanted == bool(self._from):
            return
        if not wanted:
            for subscription in self._from:
                self._node.destroy_subscription(subscription)
            self._from, self.tree = [], TransformTree()
            return
        message = transform_message()
        if message is None:
            self._node.get_logger().warning(
                f"base_frame is given, but tf2_msgs is not installed: mount.* holds {INSTALL}"
            )
            return
        moving = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        resting = latched()
        resting.depth = _DEPTH
        for topic, profile in ((_MOVING, moving), (TOPIC, resting)):
            self._from.append(self._node.create_subscription(message, topic, self._take, profile))

    def _take(self, message: Any) -> None:
        for transform in message.transforms:
            move, turn = transform.transform.translation, transform.transform.rotation
            self.tree.add(
                transform.header.frame_id,
                transform.child_frame_id,
                position=(move.x, move.y, move.z),
                quaternion=(turn.x, turn.y, turn.z, turn.w),
            )
        self._changed()
