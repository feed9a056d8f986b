"""The mount of a camera on /tf_static, without tf2_ros, which is only available from apt."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from rim_camera_ros.nodes.common.qos import latched

TOPIC = "/tf_static"
#: Optical axes (x right, y down, z forward) in a body's (x forward, y left, z up): REP 103.
_OPTICAL = (-0.5, 0.5, -0.5, 0.5)

#: Remedy where the messages of /tf are missing.
INSTALL = "(sudo apt install ros-jazzy-tf2-msgs)"

Quaternion = tuple[float, float, float, float]


def optical_rotation(*, roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation x y z w of the optical frame in the base frame.

    ``roll``, ``pitch``, ``yaw`` [rad] turn the camera's body about its fixed x, y, z axes in this order, as
    URDF and static_transform_publisher do; all 0: the camera looks along x of the base.
    """
    half = (roll / 2, pitch / 2, yaw / 2)
    (cr, cp, cy), (sr, sp, sy) = (tuple(f(one) for one in half) for f in (math.cos, math.sin))
    body = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    return _product(body, _OPTICAL)


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def mount(values: Mapping[str, Any]) -> TransformStamped:
    """Return the transform that the parameters base_frame, mount.* and frame_id describe, without a stamp."""
    result = TransformStamped()
    result.header.frame_id = values["base_frame"]
    result.child_frame_id = values["frame_id"]
    move, turn = result.transform.translation, result.transform.rotation
    move.x, move.y, move.z = (values[f"mount.{one}"] for one in ("x", "y", "z"))
    turn.x, turn.y, turn.z, turn.w = optical_rotation(
        **{one: values[f"mount.{one}"] for one in ("roll", "pitch", "yaw")}
    )
    return result


def transform_message() -> Any:
    """Return the class of the messages of /tf, None where tf2_msgs is not installed (apt, not a wheel)."""
    try:
        return importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None


class Mount:
    """Publishes the mount to /tf_static, also for late subscribers."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Any = None

    def publish(self, values: Mapping[str, Any]) -> None:
        """Publish if a base_frame is given; log a warning where tf2_msgs is missing."""
        if not values["base_frame"]:
            return
        message = transform_message()
        if message is None:
            self._node.get_logger().warning(
                f"base_frame is given, but tf2_msgs is not installed: no transform is published {INSTALL}"
            )
            return
        if self._publisher is None:
            self._publisher = self._node.create_publisher(message, TOPIC, latched())
        transform = mount(values)
        transform.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message(transforms=[transform]))
