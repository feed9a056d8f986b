"""Takes frames from a device in a thread of its own, exchanges devices between frames, and tries again."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from rim_camera_ros.devices.base import Device
from rim_camera_ros.errors import DeviceError, RimError
from rim_camera_ros.frame import RawFrame

#: Seconds until a device that failed is opened again: at first, and at most.
_RETRY, _RETRY_AT_MOST = 1.0, 10.0


class Listener(Protocol):
    """What an acquisition tells; all of it is called in its thread."""

    def on_frame(self, frame: RawFrame) -> bool:
        """Take a frame; False ends the acquisition."""

    def on_end(self) -> None:
        """The device has no more frames; another one may follow."""

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        """The device failed; it is opened again in so many seconds, or never."""

    def on_recovery(self) -> None:
        """A device that had failed delivers again."""


class Acquisition:
    """A thread that takes frames from an open device.

    ``retry``: a device that fails is closed and opened again, else it is at its end. ``exchange`` puts
    another open device in its place between two frames.
    """

    def __init__(self, device: Device, listener: Listener, *, retry: bool = True) -> None:
        self._device = device
        self._next: tuple[Device, bool] | None = None
        self._listener = listener
        self._retry = retry
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="acquisition", daemon=True)

    def start(self) -> None:
        """Begin to take frames."""
        self._thread.start()

    def exchange(self, device: Device, *, retry: bool = True) -> None:
        """Take frames from another device, which is open, from the next frame on."""
        with self._lock:
            replaced, self._next = self._next, (device, retry)
            current = self._device
        if replaced is not None:
            replaced[0].close()
        current.close()
        self._wake.set()

    @property
    def device(self) -> Device:
        """The device from which the next frame comes."""
        with self._lock:
            return self._next[0] if self._next is not None else self._device

    def stop(self, timeout: float = 2.0) -> None:
        """End the thread and close the device."""
        self._stopping = True
        self.device.close()
        with self._lock:
            current = self._device
        current.close()
        self._wake.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout)

    def _run(self) -> None:
        pause, failed = _RETRY, False
        while not self._stopping:
            if self._take_next():
                pause, failed = _RETRY, False
            try:
                if failed:
                    self._device.open()
                frame = self._device.next_frame()
            except Exception as error:
                if not self._pending:
                    failed = True
                    self._fault(error, pause if self._retry else None)
                    self._device.close()
                    self._rest(pause if self._retry else None)
                    pause = min(2 * pause, _RETRY_AT_MOST)
                continue
            if frame is None:
                if not self._pending:
                    self._listener.on_end()
                    self._rest(None)
                continue
            if failed:
                pause, failed = _RETRY, False
                self._listener.on_recovery()
            if not self._listener.on_frame(frame):
                return

    @property
    def _pending(self) -> bool:
        with self._lock:
            return self._stopping or self._next is not None

    def _take_next(self) -> bool:
        with self._lock:
            self._wake.clear()
            if self._next is None:
                return False
            (self._device, self._retry), self._next = self._next, None
            return True

    def _rest(self, seconds: float | None) -> None:
        """Wait for that long (None: for ever), for another device or for the end."""
        end = None if seconds is None else time.monotonic() + seconds
        while not self._pending:
            left = None if end is None else end - time.monotonic()
            if left is not None and left <= 0:
                return
            self._wake.wait(left)

    def _fault(self, error: Exception, retry_in: float | None) -> None:
        if not isinstance(error, RimError):
            error = DeviceError(f"unexpected {type(error).__name__}: {error}", remedy="please report this")
        self._listener.on_fault(error, retry_in)
