"""The supervisor's side of the acquisition process: start, messages, shared memory, end."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.devices.acquisition_process import MESSAGE_SIZE, SLOTS
from rim_camera_ros.devices.swissranger_settings import CameraSettings
from rim_camera_ros.errors import DeviceError, InputError, RimError

_MODULE = "rim_camera_ros.devices.acquisition_process"
#: Seconds that loading the library may take.
_PROBE_TIMEOUT = 10.0
#: Seconds in which a process that was killed must be gone.
_KILL_TIMEOUT = 2.0


class AcquisitionProcess:
    """A process that runs the library, with its connection and the memory for the images.

    Used by one thread, except `send_settings`, `finish` and `pid`.
    """

    def __init__(
        self, *, library: str | None, serial: int, settings: CameraSettings, transfer_timeout: float
    ) -> None:
        self._connection, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._memory_file = os.memfd_create("swissranger")
        self._memory: mmap.mmap | None = None
        self._poll = select.poll()
        self._poll.register(self._connection, select.POLLIN)
        given = {
            "library": library,
            "serial": serial,
            "settings": settings.to_plain(),
            "transfer_timeout": transfer_timeout,
        }
        descriptors = (other.fileno(), self._memory_file)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _MODULE, *map(str, descriptors), json.dumps(given)],
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                stdout=2,  # the library writes messages; standard output belongs to the program
                env=child_environment(),
                start_new_session=True,  # Ctrl-C ends the supervisor, and that ends the process
            )
        except OSError as error:
            self._free()
            problem = f"cannot start a process for the camera: {error.strerror or error}"
            raise DeviceError(problem, remedy="check the limits of memory and processes") from None
        finally:
            other.close()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def receive(self, timeout: float) -> dict[str, Any] | None:
        """Return the next message, None where none came within ``timeout`` [s].

        Raises the fault that the process sent, or `DeviceError` where it ended without a message.
        """
        if not self._poll.poll(max(timeout, 0.0) * 1000):
            return None
        try:
            data = self._connection.recv(MESSAGE_SIZE)
        except ConnectionError:
            data = b""
        if not data:
            raise DeviceError(
                f"the acquisition process {self._how_it_ended()}",
                remedy="it is started anew; if that repeats, libmesasr or the camera is at fault",
            )
        message: dict[str, Any] = json.loads(data)
        if "fault" in message:
            raise error_of(message["fault"])
        return message

    def pending(self) -> bool:
        """Return whether a message waits."""
        return bool(self._poll.poll(0))

    def images(self, slot: int, *, rows: int, columns: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Return copies of a slot's distance and amplitude, (rows, columns) each, and release the slot."""
        size = 2 * rows * columns
        if self._memory is None:
            self._memory = mmap.mmap(self._memory_file, SLOTS * 2 * size, prot=mmap.PROT_READ)
        both = self._memory[2 * size * slot : 2 * size * (slot + 1)]
        distance, amplitude = np.frombuffer(bytearray(both), np.uint16).reshape(2, rows, columns)
        self.release(slot)
        return distance, amplitude

    def release(self, slot: int) -> None:
        """Release a slot without reading it."""
        self._send(release=slot)

    def send_settings(self, settings: CameraSettings) -> None:
        """Send settings, for use from the next frame on."""
        self._send(settings=settings.to_plain())

    def finish(self) -> None:
        """Ask the process to close the camera and end."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def stop(self, patience: float) -> None:
        """End the process, kill it if it has not ended after ``patience`` [s], and free all resources.

        Raises `DeviceError` where it cannot be ended.
        """
        self.finish()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            try:
                self._process.wait(_KILL_TIMEOUT)
            except subprocess.TimeoutExpired:
                raise DeviceError(
                    f"the acquisition process {self.pid} hangs in the kernel", remedy="unplug the camera"
                ) from None
        finally:
            self._free()

    def _free(self) -> None:
        self._connection.close()
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        if self._memory_file >= 0:
            os.close(self._memory_file)
            self._memory_file = -1

    def _send(self, **message: Any) -> None:
        with contextlib.suppress(OSError):  # the process has ended: the next receiver raises its error
            self._connection.send(json.dumps(message).encode())

    def _how_it_ended(self) -> str:
        try:
            status = self._process.wait(_KILL_TIMEOUT)
        except subprocess.TimeoutExpired:
            return "closed its connection"
        return how_it_ended(status)


def probe_library(path: str | None) -> dict[str, str]:
    """Return ``file`` and ``version`` of the vendor's library, which is loaded in a separate process.

    Raises `InputError` where it is absent or of an unknown version, `DeviceError` where loading it fails.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-m", _MODULE, "--probe", *([path] if path else [])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_PROBE_TIMEOUT,
            env=child_environment(),
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise DeviceError("loading the vendor's library does not end", file=path or "libmesasr.so") from None
    start = done.stdout.find(b"{")  # the library may have written before
    if done.returncode != 0 or start < 0:
        raise DeviceError(
            "the vendor's library crashes when it is loaded",
            file=path or "libmesasr.so",
            remedy="install libmesasr 1.0.14 for this processor",
        )
    found: dict[str, Any] = json.loads(done.stdout[start:])
    if "fault" in found:
        raise error_of(found["fault"])
    return found


def error_of(plain: dict[str, Any]) -> RimError:
    """Return the error that a process sent as plain data."""
    kind = InputError if plain["input"] else DeviceError
    return kind(plain["problem"], file=plain["file"], place=plain["place"], remedy=plain["remedy"])


def how_it_ended(status: int) -> str:
    """Return the end of a process in words, from its ``returncode``."""
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"was ended by signal {-status}"


def child_environment() -> dict[str, str]:
    """Return the environment with which a process finds this package, wherever it was imported from."""
    here = str(Path(__file__).resolve().parents[2])
    paths = [here, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
