"""The correction: raw images in, corrected clouds and images out.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given
(``--ros-args -r __ns:=/front``). Only what somebody subscribes to is computed and published.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Set
from dataclasses import replace
from typing import Any

from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from rim_camera_ros.bags.topics import CAMERA_INFO, ROLES
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera_apart
from rim_camera_ros.effects import registry
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import CorrectedDistance, CorrectedFrame, RawFrame, Settings
from rim_camera_ros.nodes import messages, qos
from rim_camera_ros.nodes.aside import Aside
from rim_camera_ros.nodes.correction_parameters import EFFECT, SPECS, correction_of, effect_spec, warm_up
from rim_camera_ros.nodes.correction_status import CorrectionStatus
from rim_camera_ros.nodes.diagnostics import Diagnostics
from rim_camera_ros.nodes.folders import Folders
from rim_camera_ros.nodes.lifecycle import ManagedNode
from rim_camera_ros.nodes.pairing import StampPairing
from rim_camera_ros.nodes.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.run import Throttle, run
from rim_camera_ros.pipeline.correct import Correction

#: Outputs that are images of the corrected frame, beside the cloud.
_IMAGES = ("sigma", "flags", "corrected_distance", "depth")
#: Seconds between two looks for frames that wait in vain.
_TICK = 0.1
#: Pixels by which camera_info may differ from the camera file before it is said.
_SAME_OPTICS = 2.0
#: Messages of a topic that may wait while the tables of a new integration time are made: 0.5 s at 100 Hz.
_QUEUE = 50
#: Integration times lately seen whose tables another camera file or effect makes before it takes effect.
_SEEN = 4
#: Sentences that are said once; more of them are not said at all.
_NOTES_AT_MOST = 200


class CorrectionNode:
    """Corrects frames with a camera file; it never ends by itself."""

    status: int | None = None

    def __init__(self) -> None:
        self.node = ManagedNode("correction")
        self._log = self.node.log
        self._throttle = Throttle(self.node)
        self._parameters = Parameters(self.node, SPECS)
        values = self._parameters.values
        self._folders = Folders(values["folders"], given=[values["camera"]])
        self._camera = load_camera(find_camera(values["camera"]))
        self._parameters.extend([effect_spec(name, name in self._camera.effects) for name in registry()])
        self._correction = correction_of(self._camera, values)
        self._status = CorrectionStatus()
        self._use(values)
        self._frame_id = ""
        self._last: RawFrame | None = None
        self._seen: dict[float | None, Settings] = {}
        self._noted: set[str] = set()
        self._left_out: dict[str, int] = {}
        self._to: dict[str, Publisher] = {}
        self._from: dict[str, Subscription] = {}
        self._pairing = self._new_pairing()
        self._aside = Aside(self._from.values, self._look_for_overdue)
        self._parameters.watch(self._prepare, also=self._effects_of_file)
        self._parameters.warn_unknown()
        self.node.start(self, autostart=values["autostart"])
        self._timer = self.node.steady_timer(_TICK, self._look_for_overdue)
        self._services = [
            self.node.create_service(Trigger, f"~/{name}", serve)
            for name, serve in (("load_camera", self._load_camera), ("save_camera", self._save_camera))
        ]
        self._diagnostics = Diagnostics(
            self.node,
            {
                "frames": self._look_at_frames,
                "pixels": self._status.pixels,
                "calibration": self._status.calibration,
                "warm-up": self._status.warm_up,
                "consistency": self._status.consistency,
            },
            hardware=self._status.hardware,
        )

    def close(self) -> None:
        """Let go of all topics."""
        self.node.end()
        self._aside.close()

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Make the tables and offer the topics."""
        warm_up(self._correction)
        values = self._parameters.values
        for role in ("points", *_IMAGES):
            parameter = "qos.points" if role == "points" else "qos.images"
            topic, kind = ROLES[role]
            self._to[role] = self._publisher(kind, topic, parameter)
        beside = ROLES["depth"][0].rpartition("/")[0] + "/camera_info"
        self._to["depth_camera_info"] = self._publisher(CAMERA_INFO, beside, "qos.images")
        self._log.info(f"correcting {self.node.get_namespace()} with camera file {values['camera']}")

    def activate(self) -> None:
        """Take raw frames from now on."""
        # in the order in which a driver publishes: what waits together is taken in this order
        profile = qos.profile(self._parameters.values["qos.input"], depth=_QUEUE)
        self._pairing = self._new_pairing()
        self._left_out.clear()
        for role in (
            "temperature",
            "ambient",
            "reference",
            "frame_info",
            "camera_info",
            "amplitude",
            "distance",
        ):
            topic, kind = ROLES[role]
            take = self._compare if role == "camera_info" else self._taker(role)
            self._from[role] = qos.subscription(
                self.node, messages.ros_class(kind), topic, take, profile, parameter="qos.input"
            )
        self._status.begin()

    def deactivate(self) -> None:
        """Take no more frames; what was not whole is forgotten."""
        for one in self._from.values():
            self.node.destroy_subscription(one)
        self._from.clear()

    def cleanup(self) -> None:
        """Take the topics back."""
        for one in self._to.values():
            self.node.destroy_publisher(one)
        self._to.clear()

    def _publisher(self, kind: str, topic: str, parameter: str) -> Publisher:
        profile = qos.profile(self._parameters.values[parameter])
        return qos.publisher(self.node, messages.ros_class(kind), topic, profile, parameter=parameter)

    def _new_pairing(self) -> StampPairing:
        def published(role: str) -> bool:
            known = self._from.get(role)
            return known is not None and self.node.count_publishers(known.topic_name) > 0

        return StampPairing(published)

    # --- messages in ----------------------------------------------------------------------------

    def _taker(self, role: str) -> Any:
        return lambda message: self._take(role, message)

    def _take(self, role: str, message: Any) -> None:
        """Take a message of a role; what is wrong with it is counted and said, and its frame is left out."""
        if role not in self._from:
            return  # it came while the node was being deactivated
        stamp = messages.stamp_of(message)
        try:
            if stamp < 0:
                raise InputError("the stamp is negative")
            value = self._value(role, message)
        except Exception as error:  # whatever hostile messages provoke: the node goes on
            self._status.refused[role] += 1
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
        """Say where camera_info has other optics than the camera file, by which is corrected."""
        try:
            stated, _ = messages.intrinsics_from(message)
        except Exception:
            self._status.refused["camera_info"] += 1
            return
        if stated is None or (stated.height, stated.width) != self._camera.shape:
            return
        ours = self._camera.intrinsics
        apart = max(abs(getattr(stated, name) - getattr(ours, name)) for name in ("fx", "fy", "cx", "cy"))
        if apart > _SAME_OPTICS:
            self._throttle.warn(
                "optics",
                f"camera_info differs from the camera file's optics by up to {apart:.1f} px; points are "
                "computed with the camera file",
            )

    # --- frames out -----------------------------------------------------------------------------

    def _look_for_overdue(self) -> None:
        self._correct(self._pairing.overdue(time.monotonic()))

    def _correct(self, frames: list[RawFrame]) -> None:
        for frame in frames:
            self._last = frame
            self._note_setting(frame.settings)
            wanted = {role for role, one in self._to.items() if one.get_subscription_count() > 0}
            begun = time.monotonic()
            try:
                looked_at = self._status.take(frame)
                sample = self._correct_one(frame, wanted, whole=looked_at)
            except Exception as error:  # a frame that cannot be corrected must not end the node
                self._status.uncorrected += 1
                known = isinstance(error, RimError)
                problem = str(error) if known else f"{type(error).__name__} {error} (please report this)"
                self._throttle.warn(f"uncorrected {type(error).__name__}", f"frame not corrected: {problem}")
            else:
                self._status.corrected(frame, processing=time.monotonic() - begun, sample=sample)
        for note in self._correction.notes - self._noted:
            if len(self._noted) < _NOTES_AT_MOST:
                self._noted.add(note)
                self._log.warning(note)
        for reason, count in self._pairing.left_out.items():
            if count > self._left_out.get(reason, 0):
                self._left_out[reason] = count
                self._throttle.warn(reason, f"{reason}: {count} left out so far")

    def _note_setting(self, settings: Settings) -> None:
        self._seen.pop(settings.integration_time, None)
        self._seen[settings.integration_time] = settings
        if len(self._seen) > _SEEN:
            del self._seen[next(iter(self._seen))]

    def _correct_one(self, frame: RawFrame, wanted: set[str], *, whole: bool) -> CorrectedFrame | None:
        """Correct and publish what is wanted; ``whole``: return the frame with sigma and flags."""
        if not wanted and not whole:
            return None
        head = messages.header(frame.stamp, self._frame_id)
        corrected: CorrectedDistance
        full: CorrectedFrame | None = None
        if whole or wanted & {"sigma", "flags"}:
            corrected = full = self._correction.correct(frame)
        else:
            corrected = self._correction.correct_distance(frame)
        if full is not None and "sigma" in wanted:
            self._to["sigma"].publish(messages.image(full.sigma, head))
        if full is not None and "flags" in wanted:
            self._to["flags"].publish(messages.image(full.flags, head))
        if "points" in wanted:
            self._to["points"].publish(messages.cloud(self._correction.cloud(corrected), head))
        if "corrected_distance" in wanted:
            self._to["corrected_distance"].publish(messages.image(corrected.distance, head))
        if "depth_camera_info" in wanted:
            self._to["depth_camera_info"].publish(messages.camera_info(self._camera.intrinsics, head))
        if "depth" in wanted:
            self._to["depth"].publish(messages.image(self._correction.depth(corrected), head))
        return full

    def _look_at_frames(self) -> Any:
        self._status.phase = self.node.phase
        return self._status.frames(self._pairing.left_out)

    # --- parameters and services ----------------------------------------------------------------

    def _effects_of_file(self, values: Values, changed: Values) -> Values:
        """Return which effects are on with another camera file: all of its own that were not switched off."""
        if "camera" not in changed:
            return {}
        try:
            self._folders.check(values["camera"], kind="calibration", place="camera")
            camera = self._aside.run(lambda: load_camera(find_camera(values["camera"])))
        except RimError:
            return {}  # the check says it
        off = {name for name in self._camera.effects if not self._parameters.values[EFFECT + name]}
        return {EFFECT + name: name in camera.effects and name not in off for name in registry()}

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        """Check new values and build the correction that they ask for; return what puts it into effect.

        It is built, with its tables, in another thread, and frames go on being corrected as before. This
        returns, and the service answers, when all is ready.
        """
        if not changed - {"save_as"}:
            return lambda: None
        anew = "camera" in changed
        if anew:
            self._folders.check(values["camera"], kind="calibration", place="camera")
        used, last, seen = self._camera, self._last, list(self._seen.values())

        def build() -> tuple[Camera, Correction]:
            camera = load_camera(find_camera(values["camera"])) if anew else used
            correction = correction_of(camera, values)
            if last is not None and last.shape == camera.shape:
                correction.correct(last)  # whether it can
                for settings in seen:
                    with contextlib.suppress(RimError):
                        correction.minimum_for(settings)  # so that no frame waits for its tables
            return camera, correction

        camera, correction = self._aside.run(build)
        if self._last is not None and self._last.shape != camera.shape:
            (height, width), (rows, columns) = self._last.shape, camera.shape
            raise InputError(
                f"the file is for {columns} x {rows} px, the images are {width} x {height}",
                file=values["camera"],
                remedy="give the file of this sensor",
            )

        def apply() -> None:
            correction.carry_on(self._correction)  # as the last frame left it
            self._camera, self._correction = camera, correction
            self._use(values)
            if anew:
                self._log.info(f"now correcting with camera file {values['camera']}")

        return apply

    def _use(self, values: Values) -> None:
        """Judge by the camera file and the effects that are in force."""
        off = {name for name in self._camera.effects if not values[EFFECT + name]}
        self._status.use(self._camera, values["camera"], off=off)

    def _load_camera(self, request: Any, response: Any) -> Any:
        """Read the camera file of the parameter anew."""
        name = self._parameters.values["camera"]
        result = self.node.set_parameters_atomically([Parameter("camera", value=name)])
        response.success = bool(result.successful)
        response.message = f"now correcting with {name}" if result.successful else result.reason
        return response

    def _save_camera(self, request: Any, response: Any) -> Any:
        """Write the camera as it corrects, without the effects that are switched off."""
        values = self._parameters.values
        try:
            source = find_camera(values["camera"])
            path = self._folders.target(values["save_as"] or source.name, place="save_as")
            effects = {name: one for name, one in self._camera.effects.items() if values[EFFECT + name]}
            minimum = values["minimum_amplitude"]
            kept = None if len(effects) < len(self._camera.effects) else self._camera.covariance
            camera = replace(
                self._camera,
                effects=effects,
                covariance=kept,
                minimum_amplitude=self._camera.minimum_amplitude if minimum < 0 else minimum,
            )
            save_camera_apart(camera, path, comment="What a correction node corrected with.")
        except Exception as error:
            known = isinstance(error, RimError)
            response.success = False
            response.message = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            return response
        response.success, response.message = True, f"written to {path}"
        return response


def main() -> int:
    """Run the correction."""
    return run("correction_node", CorrectionNode)


if __name__ == "__main__":
    sys.exit(main())
