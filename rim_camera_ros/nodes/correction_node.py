"""The correction: raw images in, corrected clouds and images out.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given
(``--ros-args -r __ns:=/front``). Only what somebody subscribes to is computed and published.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Set
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher

from rim_camera_ros.bags.topics import CAMERA_INFO, ROLES
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.timeline import DEFAULT_INTEGRATION_TIME
from rim_camera_ros.effects import registry
from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import CorrectedDistance, RawFrame, Settings
from rim_camera_ros.nodes import messages, qos
from rim_camera_ros.nodes.pairing import StampPairing
from rim_camera_ros.nodes.parameters import Apply, Parameters, Spec, Values
from rim_camera_ros.nodes.run import NAMESPACE, Throttle, run
from rim_camera_ros.pipeline.correct import Correction

_EFFECT = "effects."

SPECS = (
    Spec(
        "camera", "sr3000", "camera file, or the name of a shipped one; setting it again reads the file anew"
    ),
    Spec(
        "minimum_amplitude",
        -1.0,
        "amplitude in counts below which a pixel has no point; -1: the camera file's, or where that has none "
        "the amplitude at which the noise of the amplitude term exceeds the range noise",
        limits=(-1.0, 65535.0),
    ),
    Spec("qos.input", qos.SENSOR_DATA, "delivery asked of the driver", choices=qos.CHOICES, read_only=True),
    Spec("qos.points", qos.SENSOR_DATA, "delivery of points", choices=qos.CHOICES, read_only=True),
    Spec(
        "qos.images",
        qos.SENSOR_DATA,
        "delivery of sigma, flags, distance and depth images with their camera_info",
        choices=qos.CHOICES,
        read_only=True,
    ),
)

#: Outputs that are images of the corrected frame, beside the cloud.
_IMAGES = ("sigma", "flags", "corrected_distance", "depth")
#: Seconds between two looks for frames that wait in vain.
_TICK = 0.1
#: Pixels by which camera_info may differ from the camera file before it is said.
_SAME_OPTICS = 2.0


class CorrectionNode:
    """Corrects frames with a camera file; it never ends by itself."""

    status: int | None = None

    def __init__(self) -> None:
        self.node = Node("correction", namespace=NAMESPACE)
        self._log = self.node.get_logger()
        self._throttle = Throttle(self.node)
        self._parameters = Parameters(self.node, SPECS)
        values = self._parameters.values
        self._camera = load_camera(find_camera(values["camera"]))
        self._parameters.extend([_effect_spec(name, name in self._camera.effects) for name in registry()])
        self._correction = _correction(self._camera, values)
        _warm_up(self._correction)
        self._frame_id = ""
        self._last: RawFrame | None = None
        self._noted: set[str] = set()
        self._left_out: dict[str, int] = {}
        self.refused = 0
        self._make_publishers()
        self._make_subscriptions()
        self._parameters.watch(self._prepare, also=self._effects_of_file)
        self._parameters.warn_unknown()
        self._log.info(f"correcting {self.node.get_namespace()} with camera file {values['camera']}")

    def close(self) -> None:
        """Nothing is held that the node does not hold."""

    def _make_publishers(self) -> None:
        values = self._parameters.values
        self._to: dict[str, Publisher] = {}
        for role in ("points", *_IMAGES):
            parameter = "qos.points" if role == "points" else "qos.images"
            topic, kind = ROLES[role]
            profile = qos.profile(values[parameter])
            self._to[role] = qos.publisher(
                self.node, messages.ros_class(kind), topic, profile, parameter=parameter
            )
        beside = ROLES["depth"][0].rpartition("/")[0] + "/camera_info"
        self._to["depth_camera_info"] = qos.publisher(
            self.node,
            messages.ros_class(CAMERA_INFO),
            beside,
            qos.profile(values["qos.images"]),
            parameter="qos.images",
        )

    def _make_subscriptions(self) -> None:
        # in the order in which a driver publishes: what waits together is taken in this order
        profile = qos.profile(self._parameters.values["qos.input"])
        self._from = {
            role: qos.subscription(
                self.node,
                messages.ros_class(ROLES[role][1]),
                ROLES[role][0],
                take,
                profile,
                parameter="qos.input",
            )
            for role, take in (
                ("temperature", lambda message: self._take("temperature", message)),
                ("ambient", lambda message: self._take("ambient", message)),
                ("reference", lambda message: self._take("reference", message)),
                ("frame_info", lambda message: self._take("frame_info", message)),
                ("camera_info", self._compare),
                ("amplitude", lambda message: self._take("amplitude", message)),
                ("distance", lambda message: self._take("distance", message)),
            )
        }
        self._pairing = StampPairing(lambda role: self.node.count_publishers(self._from[role].topic_name) > 0)
        self._timer = self.node.create_timer(
            _TICK, lambda: self._correct(self._pairing.overdue(time.monotonic()))
        )

    # --- messages in ----------------------------------------------------------------------------

    def _take(self, role: str, message: Any) -> None:
        """Take a message of a role; what is wrong with it is counted and said, and its frame is left out."""
        stamp = messages.stamp_of(message)
        try:
            value = self._value(role, message)
        except Exception as error:  # whatever hostile messages provoke: the node goes on
            self.refused += 1
            self._pairing.refuse(stamp, f"{role} refused")
            problem = str(error) if isinstance(error, RimError) else f"{type(error).__name__} {error}"
            self._throttle.warn(
                f"refused {role}", f"{self._from[role].topic_name}: message refused: {problem}"
            )
            return
        self._correct(self._pairing.add(role, stamp, value, time.monotonic()))

    def _value(self, role: str, message: Any) -> Any:
        if role in ("distance", "amplitude"):
            image = messages.image_array(message, role=role)
            if image.shape != self._camera.shape:
                (height, width), (rows, columns) = image.shape, self._camera.shape
                raise InputError(
                    f"an image of {width} x {height} px, but the camera file is for {columns} x {rows}",
                    remedy="set the parameter camera to the file of this sensor",
                )
            if role == "distance":
                self._frame_id = message.header.frame_id
            return image
        if role == "frame_info":
            return messages.settings_from(message)
        return messages.range_from(message) if role == "reference" else messages.temperature_from(message)

    def _compare(self, message: Any) -> None:
        """Say once where camera_info has other optics than the camera file, by which is corrected."""
        try:
            stated, _ = messages.intrinsics_from(message)
        except InputError:
            return
        if stated is None or (stated.height, stated.width) != self._camera.shape:
            return
        ours = self._camera.intrinsics
        apart = max(abs(getattr(stated, name) - getattr(ours, name)) for name in ("fx", "fy", "cx", "cy"))
        if apart > _SAME_OPTICS:
            self._note(
                f"camera_info differs from the camera file's optics by up to {apart:.1f} px; points are "
                "computed with the camera file"
            )

    # --- frames out -----------------------------------------------------------------------------

    def _correct(self, frames: list[RawFrame]) -> None:
        for frame in frames:
            self._last = frame
            wanted = {role for role, one in self._to.items() if one.get_subscription_count() > 0}
            if not wanted:
                continue
            try:
                self._correct_one(frame, wanted)
            except Exception as error:  # a frame that cannot be corrected must not end the node
                known = isinstance(error, RimError)
                problem = str(error) if known else f"{type(error).__name__} {error} (please report this)"
                self._throttle.warn(f"uncorrected {type(error).__name__}", f"frame not corrected: {problem}")
        for note in self._correction.notes - self._noted:
            self._note(note)
        for reason, count in self._pairing.left_out.items():
            if count > self._left_out.get(reason, 0):
                self._left_out[reason] = count
                self._throttle.warn(reason, f"{reason}: {count} left out so far")

    def _correct_one(self, frame: RawFrame, wanted: set[str]) -> None:
        head = messages.header(frame.stamp, self._frame_id)
        corrected: CorrectedDistance
        if wanted & {"sigma", "flags"}:
            whole = corrected = self._correction.correct(frame)
            for role, pixels in (("sigma", whole.sigma), ("flags", whole.flags)):
                if role in wanted:
                    self._to[role].publish(messages.image(pixels, head))
        else:
            corrected = self._correction.correct_distance(frame)
        self._publish(corrected, wanted, head)

    def _publish(self, corrected: CorrectedDistance, wanted: set[str], head: Any) -> None:
        if "points" in wanted:
            self._to["points"].publish(messages.cloud(self._correction.cloud(corrected), head))
        if "corrected_distance" in wanted:
            self._to["corrected_distance"].publish(messages.image(corrected.distance, head))
        if "depth_camera_info" in wanted:
            self._to["depth_camera_info"].publish(messages.camera_info(self._camera.intrinsics, head))
        if "depth" in wanted:
            self._to["depth"].publish(messages.image(self._correction.depth(corrected), head))

    def _note(self, text: str) -> None:
        """Say something once."""
        if text not in self._noted:
            self._noted.add(text)
            self._log.warning(text)

    # --- parameters -----------------------------------------------------------------------------

    def _effects_of_file(self, values: Values, changed: Values) -> Values:
        """Return which effects are on with another camera file: all of its own that were not switched off."""
        if "camera" not in changed:
            return {}
        try:
            camera = load_camera(find_camera(values["camera"]))
        except RimError:
            return {}  # the check says it
        off = {name for name in self._camera.effects if not self._parameters.values[_EFFECT + name]}
        return {_EFFECT + name: name in camera.effects and name not in off for name in registry()}

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        """Check new values and build the correction that they ask for; return what puts it into effect."""
        anew = "camera" in changed
        camera = load_camera(find_camera(values["camera"])) if anew else self._camera
        correction = _correction(camera, values)
        correction.carry_on(self._correction)
        last = self._last
        if last is not None and last.shape != camera.shape:
            (height, width), (rows, columns) = last.shape, camera.shape
            raise InputError(
                f"the file is for {columns} x {rows} px, the images are {width} x {height}",
                file=values["camera"],
                remedy="give the file of this sensor",
            )
        if last is not None:
            correction.correct(
                last
            )  # whether it can, and so that the next frame need not wait for its tables

        def apply() -> None:
            self._camera, self._correction = camera, correction
            if anew:
                self._log.info(f"now correcting with camera file {values['camera']}")

        return apply


def _effect_spec(name: str, on: bool) -> Spec:
    return Spec(
        _EFFECT + name, on, f"undo {registry()[name].title}; only effects of the camera file can be on"
    )


def _correction(camera: Camera, values: Values) -> Correction:
    """Return the correction that parameters describe; `InputError` for what does not fit the camera."""
    on = {name for name in registry() if values[_EFFECT + name]}
    foreign = sorted(on - set(camera.effects))
    if foreign:
        raise InputError(
            f"the camera file {values['camera']} has no effect '{foreign[0]}'",
            place=_EFFECT + foreign[0],
            remedy=nearest_name(foreign[0], camera.effects) if camera.effects else "it has none",
        )
    minimum = values["minimum_amplitude"]
    if -1.0 < minimum < 0.0:
        raise InputError(
            f"{minimum:g} counts", place="minimum_amplitude", remedy="0 or more, or -1 for the camera file's"
        )
    return Correction(
        camera, without=set(camera.effects) - on, minimum_amplitude=None if minimum < 0 else minimum
    )


def _warm_up(correction: Correction) -> None:
    """Make the tables of the most likely setting, which take longer than a frame may, before frames come."""
    camera = correction.camera
    counts = np.full(camera.shape, 1000, np.uint16)
    integration_time = camera.sensor.integration_time or DEFAULT_INTEGRATION_TIME
    settings = Settings(
        integration_time=integration_time, uptime=0.0, ambient_temperature=0.0, reference_distance=0.0
    )
    # from the far future: every real frame lies before it and begins anew
    correction.correct(RawFrame(stamp=2**62, distance=counts, amplitude=counts, settings=settings))
    correction.notes.clear()


def main() -> int:
    """Run the correction."""
    return run("correction_node", CorrectionNode)


if __name__ == "__main__":
    sys.exit(main())
