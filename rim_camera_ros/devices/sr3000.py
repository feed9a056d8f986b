"""The SwissRangers SR-3000 and SR-2 as a device.

Frames come through the vendor's library in a separate process, which is started anew when it hangs, crashes
or loses the camera.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from rim_camera_ros.devices.supervision import AcquisitionProcess, probe_library
from rim_camera_ros.devices.swissranger_settings import CameraSettings, mode_bits, mode_name
from rim_camera_ros.devices.usb import MODELS, Model, UsbCameras
from rim_camera_ros.errors import DeviceError, InputError, RimError
from rim_camera_ros.frame import NANOSECONDS, Intrinsics, RawFrame, Settings

#: Seconds until a lost camera is looked for again: after the first fault, and at most.
_RETRY, _RETRY_AT_MOST = 0.1, 1.0
#: A frame that has waited longer than this [ns] is skipped for a newer one.
_STALE = NANOSECONDS // 2
#: Seconds within which the acquisition process must close the camera: at the end, and after a fault.
_GRACE, _GRACE_AFTER_FAULT = 1.0, 0.3
#: Number of hangs without a frame in between after which the camera is reset.
_HANGS_BEFORE_RESET = 2
#: Weight of the newest interval in the measured frame rate.
_NEWEST = 0.1


@dataclass(frozen=True, slots=True)
class _Stream:
    """An acquisition process that delivers frames, and the properties of its camera."""

    process: AcquisitionProcess
    model: Model
    rows: int
    columns: int
    constant: Mapping[str, str]


class SwissRanger:
    """An SR-3000 or SR-2 on USB as a `rim_camera_ros.devices.base.Device`.

    ``library``: file of libmesasr; None: the variable RIM_LIBMESASR, or the system's. ``serial``: the
    camera's serial number, 0: the first. ``intrinsics``: the geometry that frames state; `InputError` if its
    size is not that of the camera.

    A lost camera (unplugged, library hung or crashed) is reported once, as `DeviceError` from ``next_frame``.
    The next call looks for it again, at growing intervals up to 1 s, and returns its next frame, or raises an
    error if the reason has changed (``reconnects``). Settings are kept. ``watchdog``: seconds without a frame
    after which the library counts as hung; ``start_timeout``: seconds that it may take to open the camera.
    ``wait_for_camera``: `open` does not fail if only the camera is missing.

    The stamp of a frame is the middle between call and return of the library's acquisition, on the wall
    clock; ``acquisition_time`` [s] in ``settings.extra`` is the time between the two.
    """

    #: After an error ``next_frame`` looks for the camera itself.
    reconnects = True

    def __init__(
        self,
        *,
        settings: CameraSettings | None = None,
        library: str | None = None,
        serial: int = 0,
        intrinsics: Intrinsics | None = None,
        cameras: UsbCameras | None = None,
        watchdog: float = 2.0,
        start_timeout: float = 15.0,
        transfer_timeout: float = 1.0,
        wait_for_camera: bool = False,
    ) -> None:
        for name, value in (("watchdog", watchdog), ("start_timeout", start_timeout)):
            if not value > transfer_timeout > 0:
                raise InputError(
                    f"{value:g} s is not longer than a transfer may take, {transfer_timeout:g} s", place=name
                )
        self.library = library
        self.serial = serial
        self.intrinsics = intrinsics
        self.watchdog = watchdog
        self.start_timeout = start_timeout
        self.transfer_timeout = transfer_timeout
        self.wait_for_camera = wait_for_camera
        #: Frames that were skipped because they were taken too late, short frames, and processes started.
        self.skipped = self.short_frames = self.starts = 0
        #: Messages for the user.
        self.notes: set[str] = set()
        self._cameras = cameras or UsbCameras()
        self._wanted = settings or CameraSettings()
        self._lock = threading.Lock()  # for process, settings, closed; held briefly
        self._reading = threading.Lock()  # held while waiting for a frame
        self._closed = threading.Event()
        self._process: AcquisitionProcess | None = None
        self._stream: _Stream | None = None
        self._opened = False
        self._forget()

    def _forget(self) -> None:
        """Forget earlier faults."""
        self._pause = 0.0
        self._reported: set[str] = set()
        self._hangs = 0
        self._dropped = self._short = 0
        self._arrived = 0
        self._rate = 0.0

    # --- the interface of a device --------------------------------------------------------------

    @property
    def image_roles(self) -> tuple[str, ...]:
        """Roles of the images of its frames."""
        return ("distance", "amplitude")

    @property
    def frame_rate(self) -> float:
        """Frames per second: as set, else as measured, 0 before the second frame."""
        return self._wanted.frame_rate or self._rate

    @property
    def process_id(self) -> int | None:
        """Id of the acquisition process, None while there is none."""
        process = self._process
        return None if process is None else process.pid

    def open(self) -> None:
        """Open the camera; a no-op when the device is open.

        Raises `InputError` where the library is absent or of an unknown version, and (unless
        ``wait_for_camera``) `DeviceError` where the camera is missing, may not be used or fails.
        """
        with self._reading:
            if self._opened:
                return
            self._closed.clear()
            self._forget()
            if self.wait_for_camera:
                probe_library(self.library)
            else:
                try:
                    self._connect()
                except BaseException:
                    self._drop()
                    raise
            self._opened = True

    def next_frame(self) -> RawFrame | None:
        """Return the next frame; None once closed. Raises `DeviceError` where the camera was lost."""
        with self._reading:
            while self._opened and not self._closed.is_set():
                try:
                    if self._stream is None:
                        if self._closed.wait(self._pause):
                            return None
                        self._connect()
                    return self._receive()
                except RimError as error:
                    self._lost()
                    if self._closed.is_set():
                        return None
                    error = self._explained(error)
                    if str(error) not in self._reported:
                        self._reported.add(str(error))
                        raise error from None
            if self._closed.is_set():
                return None
        raise DeviceError("the camera is not open", remedy="open it first")

    def set_integration_time(self, value: float | None) -> None:
        """Set the integration time (register 0..255) from the next frame on; None: as found at the opening.

        Raises `InputError` where it is no such number, or with auto exposure.
        """
        self.change(integration_time=value)

    def set_frame_rate(self, value: float | None) -> None:
        """Set the frame rate in Hz from the next frame on; None: as fast as the camera delivers."""
        self.change(frame_rate=value)

    def close(self) -> None:
        """Release the camera and end the acquisition process, from any thread. No-op when closed."""
        with self._lock:
            self._closed.set()
            if self._process is not None:
                self._process.finish()
        with self._reading:
            self._drop()
            self._opened = False

    # --- further settings -----------------------------------------------------------------------

    @property
    def settings(self) -> CameraSettings:
        """The requested settings; those in force are stated by each frame."""
        return self._wanted

    def change(self, **changes: Any) -> None:
        """Change fields of `CameraSettings`, all of them with the same frame.

        Raises `InputError` for a value that no camera accepts; then nothing is changed. If the camera refuses
        a value there is a note, and its settings stay as they were.
        """
        with self._lock:
            self._want(replace(self._wanted, **changes))

    def apply(self, settings: CameraSettings) -> None:
        """Replace all settings, from the next frame on."""
        with self._lock:
            self._want(settings)

    def _want(self, settings: CameraSettings) -> None:
        self._wanted = settings
        if self._process is not None:
            self._process.send_settings(settings)

    # --- connection -----------------------------------------------------------------------------

    def _connect(self) -> None:
        self._cameras.check()
        with self._lock:
            if self._closed.is_set():
                raise DeviceError("the camera was closed")
            process = self._process = AcquisitionProcess(
                library=self.library,
                serial=self.serial,
                settings=self._wanted,
                transfer_timeout=self.transfer_timeout,
            )
        self.starts += 1
        self._dropped = self._short = 0
        end = time.monotonic() + self.start_timeout
        message: dict[str, Any] = {}
        while "ready" not in message:
            received = process.receive(end - time.monotonic())
            if received is None:
                raise self._hung(f"libmesasr does not open the camera within {self.start_timeout:g} s")
            message = received
        stream = _stream(process, message["ready"])
        geometry = self.intrinsics
        if geometry is not None and (geometry.width, geometry.height) != (stream.columns, stream.rows):
            raise InputError(
                f"the {stream.model.name} delivers {stream.columns} x {stream.rows} pixels, the camera file "
                f"describes {geometry.width} x {geometry.height}",
                place="camera",
                remedy="give the camera file of the camera that is connected",
            )
        self._stream = stream

    def _lost(self) -> None:
        """End the process after a fault, and wait longer before the next attempt."""
        try:
            self._drop(_GRACE_AFTER_FAULT)
        except DeviceError as error:
            self.notes.add(str(error))
        self._pause = min(2 * self._pause, _RETRY_AT_MOST) or _RETRY

    def _drop(self, patience: float = _GRACE) -> None:
        with self._lock:
            process, self._process, self._stream = self._process, None, None
        if process is not None:
            process.stop(patience)

    def _hung(self, problem: str) -> DeviceError:
        self._hangs += 1
        self._drop(patience=0.0)
        if self._hangs == _HANGS_BEFORE_RESET:
            try:
                count = self._cameras.reset()
                self.notes.add(f"{count} camera(s) on USB were reset because libmesasr hung repeatedly")
            except DeviceError as error:
                self.notes.add(f"the camera could not be reset: {error}")
        return DeviceError(
            problem, remedy="it is started anew; if that repeats, switch the camera off and on"
        )

    def _explained(self, error: RimError) -> RimError:
        """Return the cause of a fault as found on USB, or the error itself where none is found."""
        if isinstance(error, InputError):
            return error
        try:
            self._cameras.check()
        except DeviceError as found:
            return found
        return error

    # --- frames ---------------------------------------------------------------------------------

    def _receive(self) -> RawFrame:
        stream = self._stream
        assert stream is not None
        while True:
            patience = self._patience()
            message = stream.process.receive(patience)
            if message is None:
                raise self._hung(f"libmesasr hangs: no frame for {patience:.3g} s")
            if "refused" in message:
                self.notes.add(f"settings were not changed: {message['refused']}")
            elif "frame" in message:
                old = time.monotonic_ns() - message["arrived"] > _STALE
                if old and stream.process.pending():
                    self.skipped += 1
                    stream.process.release(message["frame"])
                    continue
                return self._frame(stream, message)

    def _patience(self) -> float:
        """Seconds after the last frame after which the library counts as hung."""
        rate = self._wanted.frame_rate
        return self.watchdog + (1 / rate if rate else 0.0)

    def _frame(self, stream: _Stream, message: Mapping[str, Any]) -> RawFrame:
        distance, amplitude = stream.process.images(
            message["frame"], rows=stream.rows, columns=stream.columns
        )
        self._pause, self._hangs = 0.0, 0
        self._reported.clear()
        self._count(message)
        took = message["arrived"] - message["begun"]
        state = message["state"]
        applied = CameraSettings.from_plain(message["settings"])
        if state["mode"] != mode_bits(applied.mode):
            self.notes.add(
                f"the camera works in mode {mode_name(state['mode'])} although {applied.mode} was requested"
            )
        settings = Settings(
            integration_time=float(state["integration_time"]),
            modulation_frequency=state["modulation_frequency"],
            extra={
                "mode": mode_name(state["mode"]),
                "amplitude_threshold": str(state["amplitude_threshold"]),
                "auto_exposure": "off" if applied.auto_exposure is None else str(applied.auto_exposure),
                "acquisition_time": f"{took / NANOSECONDS:.6f}",
                **stream.constant,
            },
        )
        return RawFrame(
            stamp=message["wall"] - took // 2,
            distance=distance,
            amplitude=amplitude,
            settings=settings,
            intrinsics=self.intrinsics,
            device=stream.model.name,
        )

    def _count(self, message: Mapping[str, Any]) -> None:
        """Update the counts and the frame rate."""
        self.skipped += message["dropped"] - self._dropped
        self.short_frames += message["short"] - self._short
        self._dropped, self._short = message["dropped"], message["short"]
        if self._arrived:
            rate = NANOSECONDS / max(message["arrived"] - self._arrived, 1)
            self._rate += (rate - self._rate) * (_NEWEST if self._rate else 1.0)
        self._arrived = message["arrived"]


def _stream(process: AcquisitionProcess, ready: Mapping[str, Any]) -> _Stream:
    """Return the stream of a process that is ready. Raises `DeviceError` for an unsupported camera."""
    ids = ready["usb_ids"]
    rows, columns = ready["rows"], ready["columns"]
    supported = [model for model in MODELS.values() if model.columns is not None]
    if ids is not None:
        model = MODELS.get((ids[0], ids[1]))
        if model is None or model not in supported:
            name = model.name if model else f"{ids[0]:04x}:{ids[1]:04x}"
            raise DeviceError(f"the camera {name} is not supported", remedy="connect an SR-2 or SR-3000")
        supported = [model]
    fitting = [model for model in supported if (model.columns, model.rows) == (columns, rows)]
    if not fitting:
        names = " or ".join(
            f"{model.name} has {model.columns} x {model.rows}" for model in dict.fromkeys(supported)
        )
        problem = f"libmesasr delivers {columns} x {rows} pixels, an {names}"
        raise DeviceError(problem, remedy="check which camera is connected")
    constant = {"library": f"libmesasr {ready['version']}", "serial_number": f"0x{ready['serial']:08x}"}
    return _Stream(process, fitting[0], rows, columns, constant)
