"""The driver: publishes the raw frames of a simulated camera or of a recording.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given
(``--ros-args -r __ns:=/front``); poses of the scene's surfaces go to ``/ground_truth/<surface>/pose``.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Set
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from rim_camera_ros.bags.topics import CAMERA_INFO, POSE, ROLES, SURFACE
from rim_camera_ros.devices.base import Device
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.nodes import driver_parameters, messages, qos
from rim_camera_ros.nodes.acquisition import Acquisition
from rim_camera_ros.nodes.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.run import NAMESPACE, run

#: Topics whose subscribers count for wait_for_subscribers.
_GATE = ("frame_info", "amplitude", "distance")
#: Seconds to wait at the end until reliable subscribers have received the last frames.
_LINGER = 2.0


class DriverNode:
    """Publishes what a device delivers; ``status`` is set where it is to end by itself."""

    def __init__(self) -> None:
        self.status: int | None = None
        self.node = Node("driver", namespace=NAMESPACE)
        self._log = self.node.get_logger()
        parameters = Parameters(self.node, driver_parameters.SPECS)
        self._parameters = parameters
        self._frame_id: str = parameters.values["frame_id"]
        self._truth: bool = parameters.values["publish_truth"]
        self._frames: int = parameters.values["frames"]
        self._published = 0
        self._source = driver_parameters.source_of(parameters.values)
        device = self._source.open()
        self._make_publishers()
        self._poses: dict[str, tuple[Publisher, tuple[Pose, int] | None]] = {}
        self._said: set[str] = set()
        self._wait_for = int(parameters.values["wait_for_subscribers"])
        self._stopped = threading.Event()
        self._finished = self.node.create_guard_condition(_nothing)
        parameters.watch(self._prepare)
        parameters.warn_unknown()
        self._acquisition = Acquisition(device, self, retry=self._source.retries)
        self._log.info(f"publishing {self._source.describe()} under {self.node.get_namespace()}")
        self._acquisition.start()

    def close(self) -> None:
        """Stop the acquisition."""
        self._stopped.set()
        self._acquisition.stop()

    # --- called by the acquisition, in its thread -----------------------------------------------

    def on_frame(self, frame: RawFrame) -> bool:
        """Publish a frame; False once enough have been."""
        while (
            self._wait_for and min(self._of[role].get_subscription_count() for role in _GATE) < self._wait_for
        ):
            if self._stopped.wait(0.01):
                return False
        self._wait_for = 0
        try:
            self._publish(frame)
        except RimError as error:
            self._log.error(str(error), throttle_duration_sec=5.0)
            return True
        except Exception as error:  # the context may be gone: the node is being ended
            if self._stopped.is_set() or not self.node.context.ok():
                return False
            self._log.error(f"cannot publish: {type(error).__name__} {error}", throttle_duration_sec=5.0)
            return True
        self._published += 1
        if self._frames and self._published >= self._frames:
            self._log.info(f"{self._published} frames published")
            self._end(0)
            return False
        return True

    def on_end(self) -> None:
        """Say that the device has no more frames."""
        self._log.info(f"{self._source.describe()} is at its end, {self._published} frames published")
        self._end(0)

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        """Say what failed."""
        again = "" if retry_in is None else f"; next attempt in {retry_in:.0f} s"
        self._log.error(f"{error}{again}")
        if retry_in is None:
            self._end(1)

    def on_recovery(self) -> None:
        """Say that frames come again."""
        self._log.info(f"{self._source.describe()} delivers again")

    def _end(self, status: int) -> None:
        if not self._parameters.values["exit_at_end"]:
            return
        if self._parameters.values["qos.images"] == qos.RELIABLE:
            for one in self._of.values():
                one.wait_for_all_acked(_duration(_LINGER))
        self.status = status
        self._finished.trigger()

    # --- publishing -----------------------------------------------------------------------------

    def _make_publishers(self) -> None:
        self._of: dict[str, Publisher] = {}
        # what is waited for comes last, so that whoever has found it has found the rest
        beside = ROLES["distance"][0].rpartition("/")[0] + "/camera_info"
        self._of["distance_camera_info"] = self._publisher(CAMERA_INFO, beside, "qos.info")
        for role in ("temperature", "ambient", "reference", "camera_info", *_GATE):
            parameter = "qos.images" if role in ("distance", "amplitude") else "qos.info"
            topic, kind = ROLES[role]
            self._of[role] = self._publisher(kind, topic, parameter)

    def _publisher(self, kind: str, topic: str, parameter: str) -> Publisher:
        profile = qos.profile(self._parameters.values[parameter])
        return qos.publisher(self.node, messages.ros_class(kind), topic, profile, parameter=parameter)

    def _publish(self, frame: RawFrame) -> None:
        """Publish what somebody listens to; the images come last and complete the frame."""
        frame_id, stamp, settings = self._frame_id, frame.stamp, frame.settings
        head = messages.header(stamp, frame_id)
        if self._truth:
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
        if frame.intrinsics is not None:
            for role in ("camera_info", "distance_camera_info"):
                if self._wanted(role):
                    self._of[role].publish(messages.camera_info(frame.intrinsics, head))
        if self._wanted("amplitude"):
            self._of["amplitude"].publish(messages.image(frame.amplitude, head))
        if self._wanted("distance"):
            self._of["distance"].publish(messages.image(frame.distance, head))
        self._say_notes()

    def _wanted(self, role: str) -> bool:
        return bool(self._of[role].get_subscription_count() > 0)

    def _publish_poses(self, frame: RawFrame) -> None:
        """Publish the poses that are new; they are kept for those who join later."""
        for surface, pose in frame.truth.items():
            stamp = frame.pose_stamps.get(surface, frame.stamp)
            if surface not in self._poses:
                topic = ROLES["truth"][0].replace(SURFACE, messages.topic_part(surface))
                made = qos.publisher(self.node, messages.ros_class(POSE), topic, qos.latched())
                self._poses[surface] = (made, None)
            made, last = self._poses[surface]
            if last != (pose, stamp):
                made.publish(messages.pose(pose, stamp, self._frame_id))
                self._poses[surface] = (made, (pose, stamp))

    def _say_notes(self) -> None:
        for attribute in ("notes", "assumptions"):
            for note in set(getattr(self._acquisition.device, attribute, ())) - self._said:
                self._said.add(note)
                self._log.info(note)

    # --- parameters -----------------------------------------------------------------------------

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        """Check new values and open the device that they ask for; return what puts them into effect."""
        source = driver_parameters.source_of(values)
        if "/" in values["frame_id"][:1]:
            raise InputError("frame_id must not begin with /", place="frame_id")
        device: Device | None = None
        if changed & driver_parameters.RESTARTING:
            device = source.open()
        else:
            source.check_settings(self._acquisition.device)

        def apply() -> None:
            self._source = source
            self._frame_id, self._truth = values["frame_id"], values["publish_truth"]
            if device is not None:
                self._acquisition.exchange(device, retry=source.retries)
                self._log.info(f"now publishing {source.describe()}")
            else:
                source.set_settings(self._acquisition.device)

        return apply


def _nothing() -> None:
    """A guard condition only wakes the executor."""


def _duration(seconds: float) -> Any:
    from rclpy.duration import Duration

    return Duration(seconds=seconds)


def main() -> int:
    """Run the driver."""
    return run("driver_node", DriverNode)


if __name__ == "__main__":
    sys.exit(main())
