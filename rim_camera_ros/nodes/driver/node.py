"""The driver: publishes the raw frames of a camera, simulated, played back or on USB.

Topics are relative to the node's namespace, which is ``/camera`` unless one is given
(``--ros-args -r __ns:=/front``); poses of the scene's surfaces go to ``ground_truth/<surface>/pose``.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Collection, Set
from typing import Any

from rclpy.parameter import Parameter
from sensor_msgs.srv import SetCameraInfo

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.acquisition import Acquisition
from rim_camera_ros.devices.base import Device
from rim_camera_ros.errors import DeviceError, InputError, RimError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import Intrinsics, RawFrame
from rim_camera_ros.nodes.common import qos
from rim_camera_ros.nodes.common.device_info import LatchedInfo, file_values
from rim_camera_ros.nodes.common.diagnostics import Diagnostics
from rim_camera_ros.nodes.common.folders import Folders
from rim_camera_ros.nodes.common.handover import Exposure, Handover
from rim_camera_ros.nodes.common.lifecycle import ACTIVE, UNCONFIGURED, ManagedNode
from rim_camera_ros.nodes.common.parameters import Apply, Parameters, Values
from rim_camera_ros.nodes.common.run import run
from rim_camera_ros.nodes.common.transforms import Mount
from rim_camera_ros.nodes.driver import parameters as driver_parameters
from rim_camera_ros.nodes.driver.geometry import store_geometry
from rim_camera_ros.nodes.driver.publishing import FramePublishers
from rim_camera_ros.nodes.driver.status import DriverStatus

#: Seconds to wait at the end until reliable subscribers have received the last frames.
_LINGER = 5.0
#: Seconds between two checks of the watchdog.
_LOOK = 0.25
#: Parameters that name files, with the folder of the shipped ones that they may name.
_FILES = {"camera": "calibration", "camera_info": "calibration", "scene": "config", "recording": None}


class DriverNode:
    """Publishes the frames of a device; ``status`` is set where the node is to end by itself.

    In one process with other nodes: ``frames`` hands the frames to the correction; ``elsewhere``: the
    parameters of those nodes.
    """

    def __init__(self, *, frames: Handover[Exposure] | None = None, elsewhere: Collection[str] = ()) -> None:
        self._frames = Handover[Exposure]() if frames is None else frames
        self.status: int | None = None
        self.node = ManagedNode("driver")
        self._log = self.node.log
        self._parameters = Parameters(self.node, driver_parameters.SPECS)
        values = self._parameters.values
        self._folders = Folders(values["folders"], given=[values[name] for name in _FILES])
        self._published = 0
        self._source = driver_parameters.source_of(values)
        self._device: Device | None = None
        self._topics: FramePublishers | None = None
        self._info: LatchedInfo | None = None
        self._file: dict[str, str] = {}
        self._acquisition: Acquisition | None = None
        self._status = DriverStatus(source=self._source.describe())
        self._said: set[str] = set()
        self._wait_for = int(values["wait_for_subscribers"])
        self._stopped = threading.Event()
        self._finished = self.node.create_guard_condition(_nothing)
        self._mount = Mount(self.node)
        self._parameters.watch(self._prepare)
        self._parameters.warn_unknown(elsewhere)
        self.node.start(self, autostart=values["autostart"])
        self._service = self.node.create_service(SetCameraInfo, "set_camera_info", self._set_camera_info)
        self._diagnostics = Diagnostics(
            self.node,
            {"frames": self._look_at_frames, "device": self._look_at_device},
            hardware=self._status.hardware,
        )
        self._watchdog = self.node.steady_timer(_LOOK, self._watch)

    def close(self) -> None:
        """Stop the acquisition."""
        self._stopped.set()
        self.node.end()

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Open the device and offer the topics."""
        values = self._parameters.values
        self._source = driver_parameters.source_of(values)
        geometry = _geometry(values)
        self._device = self._source.open()
        self._topics = FramePublishers(self.node, values, self._device.image_roles)
        self._topics.geometry = geometry
        self._info = LatchedInfo(self.node, "device_info")
        self._file = _file_in_use(values)
        self._status.source = self._source.describe()

    def activate(self) -> None:
        """Publish frames."""
        assert self._device is not None
        self._device.open()  # no-op unless it was closed by `deactivate`
        self._stopped.clear()
        self._mount.publish(self._parameters.values)
        self._status.begin()
        self._status.paused = self._source.pause
        self._acquisition = Acquisition(
            self._device, self, retry=self._source.retries, paused=self._source.pause
        )
        self._log.info(f"publishing {self._source.describe()} under {self.node.get_namespace()}")
        self._acquisition.start()

    def deactivate(self) -> None:
        """Stop publishing and release the device, so that others can use it."""
        self._stopped.set()
        acquisition, self._acquisition = self._acquisition, None
        if acquisition is not None:
            self._device = acquisition.device
            acquisition.stop()

    def cleanup(self) -> None:
        """Release the device and remove the topics."""
        device, self._device = self._device, None
        if device is not None:
            device.close()
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.destroy()
        info, self._info = self._info, None
        if info is not None:
            info.destroy()

    # --- called by the acquisition, in its thread -----------------------------------------------

    def on_frame(self, frame: RawFrame) -> bool:
        """Publish a frame; return False once the requested number has been published."""
        topics = self._topics
        if topics is None:
            return False
        begun = time.monotonic()
        while self._wait_for and topics.listeners() + self._frames.wanted < self._wait_for:
            self._status.waiting = True
            if self._stopped.wait(0.01):
                return False
        self._wait_for, self._status.waiting = 0, False
        if self._stopped.is_set():
            return False
        try:
            exposure = Exposure(frame, topics.frame_id, topics.geometry_of(frame))
            self._frames.put(exposure, stopped=self._stopped.is_set)  # first, as the correction waits for it
            topics.publish(frame)
        except RimError as error:
            self._status.not_published += 1
            self._log.error(str(error), throttle_duration_sec=5.0)
            return True
        except Exception as error:  # the context may be shut down: the node is being ended
            if self._stopped.is_set() or not self.node.context.ok():
                return False
            self._status.not_published += 1
            self._log.error(f"cannot publish: {type(error).__name__} {error}", throttle_duration_sec=5.0)
            return True
        self._status.published(frame, processing=time.monotonic() - begun)
        self._say_notes()
        self._published += 1
        frames = self._parameters.values["frames"]
        if frames and self._published >= frames:
            self._log.info(f"{self._published} frames published")
            self._end(0)
            return False
        return True

    def on_end(self) -> None:
        """Log that the device has no more frames."""
        self._log.info(f"{self._source.describe()} is at its end, {self._published} frames published")
        self._end(0)

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        """Log what failed."""
        self._status.fault(error)
        again = "" if retry_in is None else f"; next attempt in {retry_in:.1g} s"
        self._log.error(f"{error}{again}")
        if retry_in is None:
            self._end(1)

    def on_recovery(self) -> None:
        """Log that frames come again."""
        self._status.recovered()
        self._log.info(f"{self._source.describe()} delivers again")

    def _end(self, status: int) -> None:
        self._status.ended = status == 0
        if not self._parameters.values["exit_at_end"]:
            return
        self._frames.wait_until_taken(_LINGER)
        if self._parameters.values["qos.images"] == qos.RELIABLE and self._topics is not None:
            self._topics.wait_until_received(_LINGER)
        self.status = status
        self._finished.trigger()

    def _say_notes(self) -> None:
        acquisition = self._acquisition
        device = None if acquisition is None else acquisition.device
        for attribute in ("notes", "assumptions"):
            for note in set(getattr(device, attribute, ())) - self._said:
                self._said.add(note)
                self._log.info(note)

    # --- watching -------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Reopen a device that delivers no frames; playback may wait for as long as was recorded."""
        acquisition, limit = self._acquisition, self._parameters.values["watchdog"]
        if acquisition is None or not limit or self._source.source == "playback":
            return
        rate = acquisition.device.frame_rate
        if rate > 0:
            limit = max(limit, 3.0 / rate)
        if acquisition.waits() > limit:
            acquisition.give_up(
                DeviceError(f"no frame for {limit:g} s", remedy="the device is closed and opened anew")
            )

    def _look_at_frames(self) -> Any:
        self._status.phase = self.node.phase
        return self._status.frames(self._current_device())

    def _look_at_device(self) -> Any:
        self._status.phase = self.node.phase
        if self._info is not None and self._status.last is not None:
            self._info.publish(self._status.last.device, {**self._status.identity(), **self._file})
        return self._status.device(self._current_device())

    def _current_device(self) -> Device | None:
        acquisition = self._acquisition
        return self._device if acquisition is None else acquisition.device

    # --- parameters and services ----------------------------------------------------------------

    def _prepare(self, values: Values, changed: Set[str]) -> Apply:
        """Check new values and open the device that they need; return what puts them into effect."""
        for name, kind in _FILES.items():
            if name in changed:
                self._folders.check(values[name], kind=kind, place=name)
        source = driver_parameters.source_of(values)
        if "/" in values["frame_id"][:1]:
            raise InputError("frame_id must not begin with /", place="frame_id")
        geometry = _geometry(values)
        device: Device | None = None
        if self.node.phase == UNCONFIGURED:
            source.check_settings()
        elif changed & driver_parameters.RESTARTING:
            device = source.open()
            self._check_images(device)
        else:
            source.check_settings(self._current_device())

        def apply() -> None:
            self._source = source
            self._status.source = source.describe()
            self._file = _file_in_use(values)
            if self._topics is not None:
                self._topics.frame_id, self._topics.truth = values["frame_id"], values["publish_truth"]
                self._topics.clock, self._topics.geometry = values["publish_clock"], geometry
            if self.node.phase == ACTIVE:
                self._apply_running(device, changed)
            elif device is not None:
                if self._device is not None:
                    self._device.close()
                self._device = device
            elif self._device is not None:
                source.set_settings(self._device)

        return apply

    def _check_images(self, device: Device) -> None:
        """Close a device and raise `InputError` if its images are not those of the topics offered."""
        if self._topics is not None and device.image_roles != self._topics.images:
            device.close()
            raise InputError(
                f"its images are {', '.join(device.image_roles)}, published are "
                f"{', '.join(self._topics.images)}",
                remedy="take the node back with cleanup first",
            )

    def _apply_running(self, device: Device | None, changed: Set[str]) -> None:
        """Hand a device, or new settings, to the running acquisition."""
        acquisition = self._acquisition
        assert acquisition is not None
        source = self._source
        if device is not None:
            self._status.begin()
            acquisition.exchange(device, retry=source.retries)
            self._log.info(f"now publishing {source.describe()}")
        else:
            source.set_settings(acquisition.device)
        if changed & driver_parameters.MOUNT:
            self._mount.publish(self._parameters.values)
        self._status.paused = source.pause
        acquisition.pause(source.pause)

    def _set_camera_info(self, request: Any, response: Any) -> Any:
        """Store a geometry in a camera file, and publish it in camera_info from the next frame on."""
        values = self._parameters.values
        try:
            base = values["camera_info"] or values["camera"]
            path, _ = store_geometry(request.camera_info, base=base, folders=self._folders)
            (result,) = self.node.set_parameters([Parameter("camera_info", value=str(path))])
            if not result.successful:
                raise RimError(result.reason)
        except Exception as error:
            known = isinstance(error, RimError)
            response.success = False
            response.status_message = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            return response
        response.success = True
        response.status_message = f"the geometry is in {path}; give this file to the correction"
        self._log.info(f"set_camera_info: {response.status_message}")
        return response


def _geometry(values: Values) -> Intrinsics | None:
    """Return the geometry for camera_info; None: that of the frames."""
    name = values["camera_info"]
    return load_camera(find_camera(name)).intrinsics if name else None


def _file_in_use(values: Values) -> dict[str, str]:
    """Return path and hash of the camera file of the frames; of a recording only if a file is given."""
    name = values["camera_info"] or ("" if values["source"] == "playback" else values["camera"])
    return file_values(name) if name else {}


def _nothing() -> None:
    """A guard condition only wakes the executor."""


def main() -> int:
    """Run the driver."""
    return run("driver_node", lambda: [DriverNode()])


if __name__ == "__main__":
    sys.exit(main())
