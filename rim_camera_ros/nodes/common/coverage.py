"""Topics of the coverage of a recording: a DiagnosticArray for programs and an image for RViz and rqt."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from rim_camera_ros.coverage.evaluate import Coverage
from rim_camera_ros.coverage.picture import Report
from rim_camera_ros.nodes.common import qos


class CoveragePublisher:
    """Publishes reports as ``coverage`` and ``coverage/image`` below a namespace; the last one is kept."""

    def __init__(self, node: Node, namespace: str) -> None:
        self._node = node
        make = node.create_publisher
        self._state = make(DiagnosticArray, f"{namespace}/coverage", qos.latched())
        self._image = make(Image, f"{namespace}/coverage/image", qos.latched())

    def publish(self, report: Report) -> None:
        """Publish a report with the present time."""
        head = Header(stamp=self._node.get_clock().now().to_msg())
        status = DiagnosticStatus(name="coverage")
        if report.coverage is None:
            status.level, status.message = DiagnosticStatus.ERROR, report.words
        else:
            moved = report.coverage.moved is not None
            status.level = DiagnosticStatus.WARN if moved else DiagnosticStatus.OK
            status.message = report.coverage.lines()[0]
            status.values = [KeyValue(key=key, value=value) for key, value in values_of(report.coverage)]
        self._state.publish(DiagnosticArray(header=head, status=[status]))
        if report.picture is not None:
            self._image.publish(_image(report.picture, head))


def values_of(coverage: Coverage) -> list[tuple[str, str]]:
    """Return keys and values: what is determined, what is not, what to record next."""
    result = [("stations", str(coverage.stations)), ("frames", str(coverage.frames))]
    result.append(("at_rest", str(coverage.moved is None).lower()))
    if coverage.moved is not None:
        result.append(("moved_mm", f"{coverage.moved * 1e3:.3f}"))
    result.append(("determined", ",".join(coverage.determined)))
    result.append(("open", ",".join(coverage.open)))
    result.append(("next", "" if coverage.next is None else coverage.next.words))
    return result + [(f"factor.{name}", f"{factor:.3g}") for name, factor in coverage.factors.items()]


def _image(pixels: Any, head: Header) -> Image:
    height, width, _ = pixels.shape
    message = Image(header=head, height=height, width=width, encoding="rgb8", step=3 * width)
    message.data.frombytes(pixels.tobytes())
    return message
