"""Takes frames from a device in its own thread, exchanges devices between frames, retries after faults."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from rim_camera_ros.devices.base import Device
from rim_camera_ros.errors import DeviceError, RimError
from rim_camera_ros.frame import RawFrame

#: Seconds until a device that failed is opened again: after the first fault, and at most.
_RETRY, _RETRY_AT_MOST = 1.0, 10.0


class Listener(Protocol):
    """Receives frames and events of an acquisition; its methods are called in the acquisition's thread."""

    def on_frame(self, frame: RawFrame) -> bool:
        """Take a frame; False ends the acquisition."""

    def on_end(self) -> None:
        """Take note that the device has no more frames; another device may follow."""

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        """Take note of a fault; the device is opened again in ``retry_in`` seconds, or never (None)."""

    def on_recovery(self) -> None:
        """Take note that a device that had failed delivers again."""


class Acquisition:
    """A thread that takes frames from an open device.

    ``retry``: a device that fails is closed and opened again; otherwise it counts as at its end. ``exchange``
    replaces it by another open device between two frames. ``paused``: no frames are requested.
    """

    def __init__(
        self, device: Device, listener: Listener, *, retry: bool = True, paused: bool = False
    ) -> None:
        self._device = device
        self._next: tuple[Device, bool] | None = None
        self._listener = listener
        self._retry = retry
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._paused = paused
        self._stopping = False
        self._stalled: RimError | None = None
        self._asked: float | None = None
        self._thread = threading.Thread(target=self._run, name="acquisition", daemon=True)

    def start(self) -> None:
        """Begin to take frames."""
        self._thread.start()

    def exchange(self, device: Device, *, retry: bool = True) -> None:
        """Take frames from another, open device from the next frame on."""
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

    def pause(self, paused: bool) -> None:
        """Request no more frames after the pending one, or request frames again."""
        with self._lock:
            self._paused = paused
        self._wake.set()

    def waits(self) -> float:
        """Return for how many seconds the request of a frame has been pending, 0 where there is none."""
        asked = self._asked
        return 0.0 if asked is None else time.monotonic() - asked

    def give_up(self, error: RimError) -> None:
        """Treat the pending request as a fault of the device, which is closed and opened again."""
        with self._lock:
            self._stalled = error
            current = self._device
        current.close()

    def stop(self, timeout: float = 2.0) -> None:
        """End the thread and close the device."""
        with self._lock:
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
            self._stand_still()
            try:
                if failed:
                    self._device.open()
                frame = self._next_frame(watched=not failed)
            except Exception as error:
                if not self._pending:
                    failed = True
                    if getattr(self._device, "reconnects", False) and isinstance(error, RimError):
                        self._fault(error, 0.1)  # the device looks for its camera itself, ever less often
                        continue
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

    def _next_frame(self, *, watched: bool) -> RawFrame | None:
        """Return the device's next frame; raise the error of `give_up` if that ended the wait."""
        self._asked = time.monotonic() if watched else None
        try:
            frame = self._device.next_frame()
        finally:
            self._asked = None
            with self._lock:
                stalled, self._stalled = self._stalled, None
        if stalled is not None and not self._pending:
            raise stalled
        return frame

    def _stand_still(self) -> None:
        while not self._pending:
            with self._lock:
                if not self._paused or self._stopping or self._next is not None:
                    return
                self._wake.clear()
            self._wake.wait()

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
        """Wait for so many seconds (None: forever), or until there is another device or the end."""
        end = None if seconds is None else time.monotonic() + seconds
        while not self._pending:
            left = None if end is None else end - time.monotonic()
            if left is not None and left <= 0:
                return
            self._wake.wait(left)
            with self._lock:
                if self._next is None and not self._stopping:
                    self._wake.clear()

    def _fault(self, error: Exception, retry_in: float | None) -> None:
        if not isinstance(error, RimError):
            error = DeviceError(f"unexpected {type(error).__name__}: {error}", remedy="please report this")
        self._listener.on_fault(error, retry_in)
