"""The process that runs the vendor's library, so that a hang or a crash of it affects nothing else.

Started by `rim_camera_ros.devices.supervision` as ``python -m``; not meant to be run by hand. Messages are
JSON, one per datagram of a SOCK_SEQPACKET pair. Images go through shared memory, which has a slot for each of
a few frames.
To this process: ``{"settings": ...}``, ``{"release": slot}``; the end of the connection ends the process.
From it: ``ready`` once, then ``frame`` and ``refused``, and ``fault`` last. It does not import numpy, so that
it starts in a tenth of a second.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import mmap
import os
import socket
import sys
import threading
import time
from collections import deque
from typing import Any

from rim_camera_ros.devices.mesa_library import MesaCamera, MesaLibrary, ShortFrame
from rim_camera_ros.devices.swissranger_settings import CameraSettings
from rim_camera_ros.errors import DeviceError, InputError, RimError

#: Largest message in bytes.
MESSAGE_SIZE = 1 << 16
#: Frames that fit in the shared memory.
SLOTS = 4
#: Largest number of pixels of a side that is accepted.
_LARGEST = 4096
#: Number of consecutive short frames after which a camera counts as failed.
_SHORT_FRAMES = 5
#: Seconds within which the library must end once the supervisor is gone.
_PATIENCE = 1.0
_NANOSECONDS = 1_000_000_000


class Link:
    """The connection to the supervisor; a thread takes its messages while the library is busy."""

    def __init__(self, connection: socket.socket, settings: CameraSettings) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self._settings: CameraSettings | None = settings
        self._free = deque(range(SLOTS))
        #: Set when there are new settings or the supervisor is gone.
        self.news = threading.Event()
        self.ended = False
        threading.Thread(target=self._listen, name="link", daemon=True).start()

    def send(self, **message: Any) -> None:
        """Send a message; do nothing if the supervisor is gone."""
        with contextlib.suppress(OSError):
            self._connection.send(json.dumps(message).encode())

    def take_settings(self) -> CameraSettings | None:
        """Return the newest settings that were not taken yet, None without any."""
        with self._lock:
            self.news.clear()
            taken, self._settings = self._settings, None
            if self.ended:
                self.news.set()
            return taken

    def take_slot(self) -> int | None:
        """Return a free slot, None where all are in use."""
        with self._lock:
            return self._free.popleft() if self._free else None

    def _listen(self) -> None:
        while True:
            try:
                data = self._connection.recv(MESSAGE_SIZE)
            except OSError:
                data = b""
            if not data:
                break
            message = json.loads(data)
            with self._lock:
                if "release" in message:
                    self._free.append(message["release"])
                else:
                    self._settings = CameraSettings.from_plain(message["settings"])
                    self.news.set()
        with self._lock:
            self.ended = True
            self.news.set()
        time.sleep(_PATIENCE)
        os._exit(0)  # the library hangs


class Acquisition:
    """Takes frames from an open camera, and applies settings between them."""

    def __init__(self, camera: MesaCamera, link: Link, memory: int) -> None:
        self._camera = camera
        self._link = link
        if not (0 < camera.rows <= _LARGEST and 0 < camera.columns <= _LARGEST):
            raise DeviceError(f"libmesasr states images of {camera.columns} x {camera.rows} pixels")
        self._slot_size = 2 * camera.image_size
        os.ftruncate(memory, SLOTS * self._slot_size)
        self._memory = mmap.mmap(memory, SLOTS * self._slot_size)
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self._applied: CameraSettings | None = None
        self._dropped = self._short = self._short_in_a_row = 0
        self._due = 0

    def begin(self) -> None:
        """Apply the first settings. Raises `DeviceError` where the camera refuses them."""
        settings = self._link.take_settings()
        assert settings is not None
        self._apply(settings)

    def run(self) -> None:
        """Deliver frames until the supervisor is gone. Raises `DeviceError` where the camera failed."""
        while not self._link.ended:
            settings = self._link.take_settings()
            if settings is not None:
                self._apply(settings)
            if self._wait_until_due():
                self._frame()

    def _apply(self, settings: CameraSettings) -> None:
        """Apply all settings, or none if one is refused."""
        before = self._applied
        try:
            self._camera.apply(settings)
            self._applied = settings
        except DeviceError as error:
            if before is None:
                raise
            self._camera.apply(before)
            self._link.send(refused=error.problem)
        self._state = self._camera.state()

    def _wait_until_due(self) -> bool:
        """Wait until the next frame is due by the frame rate; False where something else comes first."""
        assert self._applied is not None
        now, rate = time.monotonic_ns(), self._applied.frame_rate
        if rate is None:
            self._due = now
            return True
        period = round(_NANOSECONDS / rate)
        if self._due < now - period or self._due > now + period:
            self._due = now
        if self._due > now and self._link.news.wait((self._due - now) / _NANOSECONDS):
            return False
        self._due += period
        return True

    def _frame(self) -> None:
        camera = self._camera
        assert self._applied is not None
        if self._applied.auto_exposure is not None:
            self._state = camera.state()  # with the integration time of the coming exposure, before it adapts
        begun = time.monotonic_ns()
        try:
            camera.acquire()
        except ShortFrame as error:
            self._short += 1
            self._short_in_a_row += 1
            if self._short_in_a_row >= _SHORT_FRAMES:
                problem = f"{_SHORT_FRAMES} short frames after each other: {error.problem}"
                raise DeviceError(problem, remedy="check the cable; connect without a hub") from None
            return
        arrived, wall = time.monotonic_ns(), time.time_ns()
        self._short_in_a_row = 0
        slot = self._link.take_slot()
        if slot is None:
            self._dropped += 1
            return
        camera.copy_images(self._address + slot * self._slot_size)
        self._link.send(
            frame=slot,
            begun=begun,
            arrived=arrived,
            wall=wall,
            dropped=self._dropped,
            short=self._short,
            state=self._state,
            settings=self._applied.to_plain(),
        )


def probe(path: str | None) -> dict[str, Any]:
    """Load the library; return its file and version, or the error."""
    try:
        library = MesaLibrary(path)
    except RimError as error:
        return {"fault": _plain(error)}
    return {"file": library.file, "version": library.version}


def serve(connection: socket.socket, memory: int, given: dict[str, Any]) -> None:
    """Open the camera and deliver frames; errors are sent as ``fault``."""
    link = Link(connection, CameraSettings.from_plain(given["settings"]))
    camera: MesaCamera | None = None
    try:
        library = MesaLibrary(given["library"])
        camera = library.open(serial=given["serial"], timeout=given["transfer_timeout"])
        acquisition = Acquisition(camera, link, memory)
        acquisition.begin()
        link.send(
            ready={
                "rows": camera.rows,
                "columns": camera.columns,
                "serial": camera.serial,
                "usb_ids": camera.usb_ids,
                "device_string": camera.device_string,
                "version": library.version,
            }
        )
        acquisition.run()
    except RimError as error:
        link.send(fault=_plain(error))
    except Exception as error:
        link.send(fault=_plain(DeviceError(f"unexpected {type(error).__name__}: {error}")))
    with contextlib.suppress(Exception):
        if camera is not None:
            camera.close()


def _plain(error: RimError) -> dict[str, Any]:
    return {
        "input": isinstance(error, InputError),
        "problem": error.problem,
        "file": error.file,
        "place": error.place,
        "remedy": error.remedy,
    }


def main(arguments: list[str]) -> None:
    """Run with ``--probe [LIBRARY]``, or with the file descriptors of connection and memory, and JSON."""
    if arguments[0] == "--probe":
        os.write(1, json.dumps(probe(arguments[1] if arguments[1:] else None)).encode())
    else:
        serve(socket.socket(fileno=int(arguments[0])), int(arguments[1]), json.loads(arguments[2]))
    os._exit(0)  # so that nothing in the library can delay the end of the process


if __name__ == "__main__":
    main(sys.argv[1:])
