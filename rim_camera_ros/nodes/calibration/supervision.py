"""The node's side of a worker process: its start, its messages, its end by request, kill or crash; no ROS."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

from rim_camera_ros.devices.supervision import child_environment, how_it_ended
from rim_camera_ros.errors import RimError
from rim_camera_ros.nodes.calibration.link import CANCEL, FINISH

_MODULES = {
    "calibration": "rim_camera_ros.nodes.calibration.process",
    "recording": "rim_camera_ros.nodes.calibration.recording",
}
#: Seconds within which a process must end once it was asked to, before it is killed.
_PATIENCE = {CANCEL: 3.0, FINISH: 15.0}
_KILL_TIMEOUT = 2.0
_CHUNK = 1 << 16


class WorkProcess:
    """A process that does ``work`` (``calibration``, ``recording``) as ``request`` says.

    No method waits, except `stop`. Raises `RimError` where the process cannot be started.
    """

    def __init__(self, work: str, request: Mapping[str, Any]) -> None:
        self.work = work
        self.begun = time.monotonic()
        self._buffer = b""
        self._last: dict[str, Any] | None = None
        self._end: dict[str, Any] | None = None
        self._cancelled = False
        self._deadline: float | None = None
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _MODULES[work]],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=child_environment(),
                start_new_session=True,  # Ctrl-C ends the node, and that ends the process
            )
        except OSError as error:
            problem = f"cannot start a process for the {work}: {error.strerror or error}"
            raise RimError(problem, remedy="check the limits of memory and processes") from None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        os.set_blocking(self._output, False)
        self._write(json.dumps(request).encode() + b"\n")

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.begun

    def poll(self) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
        """Return the new progress, the last of each stage, and how the work ended (None: it still runs).

        The end is the last message of `link`. Where the process ended without one it is ``failed``, or
        ``cancelled`` if that was requested.
        """
        if self._end is not None:
            return [], self._end
        if self._deadline is not None and time.monotonic() > self._deadline:
            self._process.kill()
            self._deadline = None
        ended = self._process.poll() is not None  # before reading, so that all it wrote is read
        progress = self._read()
        if not ended:
            return progress, None
        if self._last is not None:
            self._end = self._last
        elif self._cancelled:
            self._end = {"cancelled": True}
        else:
            remedy = "see what it wrote to standard error, and the memory; then start again"
            self._end = {
                "failed": f"the {self.work} process {how_it_ended(self._process.returncode)} ({remedy})"
            }
        self._free()
        return progress, self._end

    def cancel(self) -> None:
        """Ask the process to end without a result; it is killed if it does not end in time."""
        self._cancelled = True
        self._ask(CANCEL)

    def finish(self) -> None:
        """Ask the process to end with the data so far."""
        self._ask(FINISH)

    def stop(self) -> dict[str, Any] | None:
        """Wait until a process that was asked to end has ended, kill it if necessary; return how it ended.

        None where it hangs in the kernel and cannot be killed.
        """
        with contextlib.suppress(subprocess.TimeoutExpired):
            # a full pipe would block the process: it is emptied meanwhile
            while self._process.poll() is None and self._deadline is not None:
                self.poll()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(0.02)
            self._process.wait(_KILL_TIMEOUT)
        return self.poll()[1]

    def _ask(self, word: bytes) -> None:
        self._write(word)
        deadline = time.monotonic() + _PATIENCE[word]
        self._deadline = deadline if self._deadline is None else min(self._deadline, deadline)

    def _write(self, data: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended already: `poll` says how
            self._process.stdin.write(data)
            self._process.stdin.flush()

    def _read(self) -> list[dict[str, Any]]:
        """Read what the process has written; return the progress in it, the last of each stage."""
        progress: list[dict[str, Any]] = []
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._output, _CHUNK):
                *lines, self._buffer = (self._buffer + data).split(b"\n")
                for line in lines:
                    message: dict[str, Any] = json.loads(line)
                    if "stage" not in message:
                        self._last = message
                        continue
                    if progress and progress[-1]["stage"] == message["stage"]:
                        progress.pop()
                    progress.append(message)
        return progress

    def _free(self) -> None:
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
