"""Findings of a node on /diagnostics, once a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile, ReliabilityPolicy

from rim_camera_ros.nodes.common.findings import Announcements, Finding, Level
from rim_camera_ros.nodes.common.lifecycle import ManagedNode

TOPIC = "/diagnostics"
#: Seconds between two messages.
PERIOD = 1.0


class Diagnostics:
    """Publishes one status per check, named ``<node>: <check>``; ``hardware`` returns the device's id.

    A warning or error is logged when it begins and when it is over (see `Announcements`), except for the
    checks ``silent``, which log themselves.
    """

    def __init__(
        self,
        node: ManagedNode,
        checks: Mapping[str, Callable[[], Finding]],
        *,
        hardware: Callable[[], str],
        silent: Collection[str] = (),
    ) -> None:
        self._node = node
        self._checks = dict(checks)
        self._hardware = hardware
        self._silent = frozenset(silent)
        self._announcements = Announcements()
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, qos)
        self._timer = node.steady_timer(PERIOD, self.publish)

    def publish(self) -> None:
        """Run the checks and publish their findings."""
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        hardware = self._hardware()
        for check, look in self._checks.items():
            try:
                finding = look()
            except Exception as error:  # a check that fails must not end the node
                finding = Finding()
                finding.worse(Level.ERROR, f"the check failed: {type(error).__name__} {error}")
            if check not in self._silent:
                self._log(check, finding)
            message.status.append(
                DiagnosticStatus(
                    level=bytes([finding.level]),
                    name=f"{name}: {check}",
                    message=finding.message,
                    hardware_id=hardware,
                    values=[KeyValue(key=key, value=value) for key, value in finding.values.items()],
                )
            )
        self._publisher.publish(message)

    def _log(self, check: str, finding: Finding) -> None:
        line = self._announcements.line(check, finding, now=time.monotonic())
        if line is None:
            return
        level, text = line
        # rclpy allows one severity per line of code
        if level == Level.ERROR:
            self._node.log.error(text)
        elif level == Level.WARN:
            self._node.log.warning(text)
        else:
            self._node.log.info(text)
