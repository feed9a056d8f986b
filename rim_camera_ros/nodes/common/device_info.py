"""Which camera and which files are in use, as latched topics, which late subscribers receive too."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.publisher import Publisher

from rim_camera_ros.errors import RimError
from rim_camera_ros.files import find_camera
from rim_camera_ros.nodes.common import qos
from rim_camera_ros.nodes.common.lifecycle import ManagedNode


def file_values(name: str) -> dict[str, str]:
    """Return the path of a camera file and the SHA-256 of its bytes; the name where it cannot be read."""
    try:
        path = find_camera(name).resolve()
        return {"file": str(path), "file_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    except (RimError, OSError):
        return {"file": name}


class LatchedInfo:
    """A topic of one status with keys and values, published when it changes and latched."""

    def __init__(self, node: ManagedNode, topic: str) -> None:
        self._node = node
        self._name = topic.rpartition("/")[2]
        self._publisher: Publisher = qos.publisher(node, DiagnosticArray, topic, qos.latched())
        self._last: tuple[str, dict[str, str]] | None = None

    def publish(self, hardware: str, values: Mapping[str, str]) -> None:
        """Publish the values if they differ from those published last."""
        now = (hardware, dict(values))
        if now == self._last:
            return
        self._last = now
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status.append(
            DiagnosticStatus(
                level=DiagnosticStatus.OK,
                name=self._name,
                hardware_id=hardware,
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            )
        )
        self._publisher.publish(message)

    def destroy(self) -> None:
        """Remove the topic."""
        self._node.destroy_publisher(self._publisher)
