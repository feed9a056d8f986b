"""The correction: raw images in, corrected clouds and images out.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given
(``--ros-args -r __ns:=/front``). Only what somebody subscribes to is computed and published.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Collection, Set
from dataclasses import replace
from typing import Any

from std_srvs.srv import Trigger

from rim_camera_ros.bags.topics import KNOWN_ROLES
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera_apart
from rim_camera_ros.effects import registry
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.measurement import FrameCorrection, measurement_of
from rim_camera_ros.nodes.common import qos
from rim_camera_ros.nodes.common.device_info import LatchedInfo, file_values
from rim_camera_ros.nodes.common.diagnostics import Diagnostics
from rim_camera_ros.nodes.common.folders import Folders
from rim_camera_ros.nodes.common.handover import CorrectedCloud, Exposure, Handover
from rim_camera_ros.nodes.common.lifecycle import ACTIVE, ManagedNode
from rim_camera_ros.nodes.common.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.common.run import Throttle, run
from rim_camera_ros.nodes.correction.aside import Aside
from rim_camera_ros.nodes.correction.freshness import Freshness
from rim_camera_ros.nodes.correction.input import Input, MemoryInput, MessageInput, Receiver
from rim_camera_ros.nodes.correction.parameters import (
    EFFECT,
    INDEPENDENT,
    PEOPLE,
    SPECS,
    correction_of,
    effect_spec,
    warm_up,
)
from rim_camera_ros.nodes.correction.publishers import PublisherWatch
from rim_camera_ros.nodes.correction.publishing import CorrectedPublishers
from rim_camera_ros.nodes.correction.status import CorrectionStatus
from rim_camera_ros.pipeline import kernels

#: Seconds between two checks for frames that wait in vain.
_TICK = 0.1
#: Seconds to wait at the end until reliable subscribers have received the last frame.
_LINGER = 0.5
#: Number of recent integration times whose tables are made before another camera file or effect is used.
_SEEN = 4
#: Why frames that were corrected are not published.
_EXPIRED = "maximum_age was over once it was corrected"
#: Notes of the correction that are logged, each once.
_NOTES_AT_MOST = 200


class CorrectionNode:
    """Corrects frames with a camera file; it never ends by itself.

    In one process with other nodes: ``frames`` hands frames over from the driver (None: they come as
    messages), ``clouds`` hands corrected clouds on; ``elsewhere``: the parameters of those nodes.
    """

    status: int | None = None

    def __init__(
        self,
        *,
        frames: Handover[Exposure] | None = None,
        clouds: Handover[CorrectedCloud] | None = None,
        elsewhere: Collection[str] = (),
    ) -> None:
        self.node = ManagedNode("correction")
        self._log = self.node.log
        self._throttle = Throttle(self.node)
        self._parameters = Parameters(self.node, SPECS if frames is None else (*SPECS, PEOPLE))
        values = self._parameters.values
        self._folders = Folders(values["folders"], given=[values["camera"]])
        self._camera = load_camera(find_camera(values["camera"]))
        self._parameters.extend([effect_spec(name, name in self._camera.effects) for name in registry()])
        self._correction = correction_of(self._camera, values)
        self._info: LatchedInfo | None = None
        self._hashed: Camera | None = None
        self._file: dict[str, str] = {}
        self._off: set[str] = set()
        self._status = CorrectionStatus()
        self._use(values)
        self._last: RawFrame | None = None
        self._seen: dict[float | None, Settings] = {}
        self._noted: set[str] = set()
        self._warned_of: dict[str, int] = {}
        self._clouds = Handover[CorrectedCloud]() if clouds is None else clouds
        self._topics: CorrectedPublishers | None = None
        self._fresh = Freshness(values, lambda: int(self.node.get_clock().now().nanoseconds))
        receiver = Receiver(
            self.node,
            self._throttle,
            self._status.refused,
            lambda: self._camera,
            self._correct,
            self._fresh,
            lambda: bool(self._parameters.values["samples"]),
        )
        self._input: Input = MessageInput(receiver) if frames is None else MemoryInput(receiver, frames)
        self._aside = Aside(self._input.subscriptions, self._input.look)
        self._parameters.watch(self._prepare, also=self._effects_of_file)
        self._parameters.warn_unknown(elsewhere)
        self.node.start(self, autostart=values["autostart"])
        if frames is None:
            self._timer = self.node.steady_timer(_TICK, self._input.look)
        self._services = [
            self.node.create_service(Trigger, f"~/{name}", serve)
            for name, serve in (("load_camera", self._load_camera), ("save_camera", self._save_camera))
        ]
        raw = ("frame_info", *reversed(measurement_of(self._camera).image_roles(self._camera)))
        self._diagnostics = Diagnostics(
            self.node,
            {
                "frames": self._look_at_frames,
                # topics of which two publishers would mix two cameras
                "publishers": PublisherWatch(self.node, [KNOWN_ROLES[one][0] for one in raw]).look,
                "pixels": self._status.pixels,
                "calibration": self._status.calibration,
                "warm-up": self._status.warm_up,
                "consistency": self._status.consistency,
            },
            hardware=self._status.hardware,
            silent={"publishers"},
        )
        self._log.info(kernels.in_words())

    def close(self) -> None:
        """Remove all topics, once messages that were published reliably have been received."""
        if self._topics is not None:
            self._topics.wait_until_received(_LINGER)
        self.node.end()
        self._aside.close()

    @property
    def follows_people(self) -> bool:
        """Whether a node for people is to run in this process."""
        return bool(self._parameters.values.get(PEOPLE.name))

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Make the tables and offer the topics."""
        warm_up(self._correction)
        values = self._parameters.values
        self._topics = CorrectedPublishers(self.node, values, clouds=self._clouds, expired=self._expired)
        self._info = LatchedInfo(self.node, "~/camera_file")
        self._say_file()
        self._log.info(f"correcting {self.node.get_namespace()} with camera file {values['camera']}")

    def activate(self) -> None:
        """Take raw frames from now on."""
        self._warned_of.clear()
        self._input.begin(self._parameters.values["qos.input"])
        self._status.begin()

    def deactivate(self) -> None:
        """Stop taking frames; incomplete ones are dropped."""
        self._input.end()

    def cleanup(self) -> None:
        """Remove the topics."""
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.destroy()
        info, self._info = self._info, None
        if info is not None:
            info.destroy()

    # --- frames out -----------------------------------------------------------------------------

    def _correct(self, frames: list[RawFrame], frame_id: str) -> None:
        topics = self._topics
        if topics is None:  # the node was cleaned up meanwhile
            return
        for frame in frames:
            self._last = frame
            self._note_setting(frame.settings)
            begun = time.monotonic()
            try:
                looked_at = self._status.take(frame)
                sample = topics.publish(self._correction, frame, frame_id, whole=looked_at)
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
        for reason, count in self._dropped().items():
            if count > self._warned_of.get(reason, 0):
                self._warned_of[reason] = count
                self._throttle.warn(reason, f"{reason}: {count} dropped so far")

    def _expired(self, stamp: int) -> bool:
        """Return whether a frame is too old to be published; with reliable input none is."""
        return self._parameters.values["qos.input"] != qos.RELIABLE and self._fresh.expired(stamp)

    def _dropped(self) -> Counter[str]:
        """Return how many frames were not corrected, or not published, by reason."""
        expirations = 0 if self._topics is None else self._topics.expirations
        return Counter(self._input.dropped) + Counter({_EXPIRED: expirations})

    def _note_setting(self, settings: Settings) -> None:
        self._seen.pop(settings.integration_time, None)
        self._seen[settings.integration_time] = settings
        if len(self._seen) > _SEEN:
            del self._seen[next(iter(self._seen))]

    def _look_at_frames(self) -> Any:
        self._status.phase = self.node.phase
        return self._status.frames(self._dropped())

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
        """Check new values and build the correction that they describe; return what puts it into effect.

        The correction and its tables are built in another thread, while frames are corrected as before. This
        method returns, and the service answers, when all is ready.
        """
        if changed <= INDEPENDENT:
            return lambda: None
        anew = "camera" in changed
        if anew:
            self._folders.check(values["camera"], kind="calibration", place="camera")
        used, last, seen = self._camera, self._last, list(self._seen.values())

        def build() -> tuple[Camera, FrameCorrection]:
            camera = load_camera(find_camera(values["camera"])) if anew else used
            correction = correction_of(camera, values)
            if last is not None and last.shape == camera.shape:
                correction.correct(last)  # raises where it cannot
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

        images, used_images = (measurement_of(one).image_roles(one) for one in (camera, used))
        if images != used_images and self.node.phase == ACTIVE:
            raise InputError(
                f"the file is of a camera with the images {', '.join(images)}, subscribed to are those of "
                f"another: {', '.join(used_images)}",
                file=values["camera"],
                remedy="deactivate the node first",
            )

        def apply() -> None:
            correction.carry_on(self._correction)  # with the state after the last frame
            self._camera, self._correction = camera, correction
            self._use(values)
            if anew:
                self._log.info(f"now correcting with camera file {values['camera']}")

        return apply

    def _use(self, values: Values) -> None:
        """Use the camera file and the effects that are in force for the diagnostics."""
        off = {name for name in self._camera.effects if not values[EFFECT + name]}
        self._status.use(self._camera, values["camera"], off=off)
        if self._camera is not self._hashed:
            self._hashed, self._file = self._camera, file_values(values["camera"])
        self._off = off
        self._say_file()

    def _say_file(self) -> None:
        """Publish which camera file is used, and which of its effects are on and off."""
        if self._info is not None:
            effects = [name for name in self._camera.effects if name not in self._off]
            listed = {"effects": ", ".join(effects), "switched_off": ", ".join(sorted(self._off))}
            self._info.publish(self._camera.device, self._file | listed)

    def _load_camera(self, request: Any, response: Any) -> Any:
        """Read the camera file of the parameter anew."""
        name = self._parameters.values["camera"]
        result = self._parameters.renew("camera")
        response.success = bool(result.successful)
        response.message = f"now correcting with {name}" if result.successful else result.reason
        return response

    def _save_camera(self, request: Any, response: Any) -> Any:
        """Write the camera as it corrects, without the effects that are off, to a new file."""
        values = self._parameters.values
        try:
            source = find_camera(values["camera"])
            name = values["save_as"] or source.name
            wanted = self._folders.target(name, place="save_as")
            path = self._folders.new(name, place="save_as")
            effects = {name: effect for name, effect in self._camera.effects.items() if values[EFFECT + name]}
            minimum = values["minimum_amplitude"]
            off = [f"{EFFECT}{name}." for name in self._camera.effects if name not in effects]
            covariance = self._camera.covariance
            camera = replace(
                self._camera,
                effects=effects,
                covariance=None if covariance is None else covariance.without(off),
                minimum_amplitude=self._camera.minimum_amplitude if minimum < 0 else minimum,
            )
            save_camera_apart(camera, path, comment="What a correction node corrected with.")
        except Exception as error:
            known = isinstance(error, RimError)
            response.success = False
            response.message = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            return response
        taken = "" if path == wanted else f" ({wanted.name} was there before and stays as it is)"
        response.success, response.message = True, f"written to {path}{taken}"
        return response


def main() -> int:
    """Run the correction."""
    return run("correction_node", lambda: [CorrectionNode()])


if __name__ == "__main__":
    sys.exit(main())
