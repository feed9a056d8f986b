"""Follows people who walk through the view of a resting camera, and publishes them as markers.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given: ``points`` and
``sigma/image`` of the correction in, ``people/markers`` out.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Set
from typing import Any

from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from rim_camera_ros.bags.messages import points_array
from rim_camera_ros.bags.topics import ROLES
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.nodes.common import messages, qos
from rim_camera_ros.nodes.common.diagnostics import Diagnostics
from rim_camera_ros.nodes.common.handover import CorrectedCloud, Handover
from rim_camera_ros.nodes.common.lifecycle import ManagedNode
from rim_camera_ros.nodes.common.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.common.run import Throttle, run
from rim_camera_ros.nodes.people.markers import cleared, markers
from rim_camera_ros.nodes.people.mount import MountOf
from rim_camera_ros.nodes.people.pairing import POINTS, SIGMA, CloudPairing
from rim_camera_ros.nodes.people.parameters import SPECS, people_settings
from rim_camera_ros.nodes.people.status import PeopleStatus
from rim_camera_ros.tracking.moving import dbscan
from rim_camera_ros.tracking.people import PeopleTracker

TOPIC = "people/markers"


class PeopleNode:
    """Follows people; it never ends by itself.

    In one process with other nodes: ``clouds`` hands clouds over from the correction (None: they come as
    messages); ``elsewhere``: the parameters of those nodes.
    """

    status: int | None = None

    def __init__(
        self, *, clouds: Handover[CorrectedCloud] | None = None, elsewhere: Collection[str] = ()
    ) -> None:
        self._clouds = clouds
        self.node = ManagedNode("people")
        self._throttle = Throttle(self.node)
        self._parameters = Parameters(self.node, SPECS)
        self._tracker = PeopleTracker(people_settings(self._parameters.values))
        self._mount = MountOf(self.node, self._mounted)
        self._status = PeopleStatus()
        self._pairing = CloudPairing()
        self._shown: set[int] = set()
        self._to: Publisher | None = None
        self._from: dict[str, Subscription] = {}
        self._parameters.watch(self._prepare)
        self._parameters.warn_unknown(elsewhere)
        if clouds is not None:
            clouds.connect(self.node)
        self.node.start(self, autostart=self._parameters.values["autostart"])
        self._service = self.node.create_service(Trigger, "~/learn_background", self._learn_background)
        self._diagnostics = Diagnostics(
            self.node,
            {
                "frames": self._look_at_frames,
                "people": lambda: self._status.people(self._tracker),
                "mount": lambda: self._mount.look(self._tracker.settings.ground),
            },
            hardware=lambda: "",
        )

    def close(self) -> None:
        """Remove all topics."""
        self.node.end()

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Offer the markers."""
        dbscan()  # imported now, as later it would delay everything in this process
        self._to = qos.publisher(self.node, MarkerArray, TOPIC, qos.profile(qos.RELIABLE))
        self._mount.use(self._parameters.values["base_frame"])

    def activate(self) -> None:
        """Take frames from now on, and learn the background from the first ones."""
        self._tracker.learn_anew()
        self._pairing = CloudPairing()
        delivery = self._parameters.values["qos.input"]
        profile = qos.profile(delivery)
        if self._clouds is not None:
            self._clouds.begin(self._take_cloud, keep_all=False)
        for role in (SIGMA, POINTS) if self._clouds is None else ():
            topic, kind = ROLES[role]
            self._from[role] = qos.subscription(
                self.node,
                messages.ros_class(kind),
                topic,
                self._taker(role),
                profile,
                parameter="qos.input",
            )
        self._status.begin()

    def deactivate(self) -> None:
        """Stop taking frames and delete the markers."""
        if self._clouds is not None:
            self._clouds.end()
        for subscription in self._from.values():
            self.node.destroy_subscription(subscription)
        self._from.clear()
        self._shown.clear()
        if self._to is not None:
            self._to.publish(cleared())

    def cleanup(self) -> None:
        """Remove the topic."""
        if self._to is not None:
            self.node.destroy_publisher(self._to)
            self._to = None
        self._mount.use("")

    # --- frames ---------------------------------------------------------------------------------

    def _taker(self, role: str) -> Any:
        return lambda message: self._take(role, message)

    def _take(self, role: str, message: Any) -> None:
        """Take a cloud or a sigma image; an invalid one is counted and logged, and the node goes on."""
        if role not in self._from:
            return  # it came while the node was being deactivated
        try:
            stamp = messages.stamp_of(message)
            if role == POINTS:
                value: Any = (points_array(message), message.header)
            else:
                value = messages.image_array(message, role=role)
            pair = self._pairing.add(role, stamp, value)
            if pair is not None:
                self._follow(*pair, stamp=stamp)
        except Exception as error:  # whatever malformed messages cause
            self._status.refused[role] += 1
            problem = str(error) if isinstance(error, RimError) else f"{type(error).__name__} {error}"
            self._throttle.warn(
                f"refused {role}", f"{self._from[role].topic_name}: message refused: {problem}"
            )

    def _take_cloud(self, cloud: CorrectedCloud) -> None:
        """Take a frame that the correction hands over."""
        self._follow((cloud.points, cloud.head), cloud.sigma, stamp=cloud.stamp)

    def _follow(self, cloud: tuple[Any, Any], sigma: Any, *, stamp: int) -> None:
        points, head = cloud
        if sigma.dtype.kind != "f":
            raise InputError(f"sigma of type {sigma.dtype}", remedy="expected 32FC1, metres")
        begun = time.monotonic()
        self._mount.seen_from(head.frame_id)
        people = self._tracker.take(points, sigma, stamp=stamp)
        here = {person.identity for person in people}
        gone = sorted(self._shown - here)
        self._shown = here
        if self._to is not None and (people or gone):
            trail = self._parameters.values["trail"]
            self._to.publish(markers(people, gone, self._tracker.settings.ground, head, trail=trail))
        self._status.taken(stamp=stamp, processing=time.monotonic() - begun)

    def _look_at_frames(self) -> Any:
        self._status.phase = self.node.phase
        silent = [
            subscription.topic_name
            for subscription in self._from.values()
            if self.node.count_publishers(subscription.topic_name) == 0
        ]
        dropped = self._pairing.dropped if self._clouds is None else self._clouds.dropped
        return self._status.frames(dropped, " and ".join(silent))

    # --- parameters and services ----------------------------------------------------------------

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        people_settings(values)

        def apply() -> None:
            self._mount.use(values["base_frame"] if self._to is not None else "")
            self._mounted()

        return apply

    def _mounted(self) -> None:
        """Use the mount as it is known now, by parameters or by transforms."""
        self._tracker.use(people_settings(self._parameters.values, ground=self._mount.ground))

    def _learn_background(self, request: Any, response: Any) -> Any:
        """Forget background and people; the new background is learnt from the next frames."""
        self._tracker.learn_anew()
        response.success = True
        response.message = f"the next {self._tracker.missing_frames} frames are the background"
        return response


def main() -> int:
    """Run the node."""
    return run("people_node", lambda: [PeopleNode()])


if __name__ == "__main__":
    sys.exit(main())
