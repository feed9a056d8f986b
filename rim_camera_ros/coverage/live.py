"""The coverage of a recording that is being made, evaluated in a separate process."""

from __future__ import annotations

import contextlib
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from rim_camera_ros.bags.stamp_pairing import IMAGES
from rim_camera_ros.coverage.frames import Message
from rim_camera_ros.coverage.picture import Report
from rim_camera_ros.devices.supervision import child_environment, how_it_ended
from rim_camera_ros.errors import RimError

#: Most messages that wait for evaluation; further images are skipped here, but not in the recording.
_WAITING = 128
#: Seconds that the last report may take at the end of a recording.
LAST_WORDS = 4.0


class LiveCoverage:
    """Takes the messages of a recording and calls ``report`` with the coverage so far.

    ``scene`` and ``camera``: their files. ``report`` is called in a separate thread; only `close` waits for
    the evaluation. If the evaluation ends by itself, the last report says so.
    """

    def __init__(self, scene: Path, camera: Path, report: Callable[[Report], None]) -> None:
        self._report = report
        self._queue: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._gone = self._closing = self._killed = False
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rim_camera_ros.coverage.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=child_environment(),
                start_new_session=True,  # Ctrl-C ends the recording, and that ends the process
            )
        except OSError as error:
            problem = f"cannot start a process for the coverage: {error.strerror or error}"
            raise RimError(problem, remedy="check the limits of memory and processes") from None
        self._threads = [threading.Thread(target=self._write, args=(str(scene), str(camera)), daemon=True)]
        self._threads.append(threading.Thread(target=self._read, daemon=True))
        for thread in self._threads:
            thread.start()

    def take(self, message: Message) -> None:
        """Take a message; images are skipped while the evaluation is behind."""
        behind = message.role in IMAGES and self._queue.qsize() >= _WAITING
        if not behind and not self._gone:
            self._queue.put(message)

    def close(self, *, patience: float = LAST_WORDS) -> None:
        """Wait for the last report, at most ``patience`` seconds, and end the process."""
        self._closing = True
        self._queue.put(None)
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._killed = True
            self._process.kill()
            self._process.wait()
        for thread in self._threads:
            thread.join(patience)

    def _write(self, scene: str, camera: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            with self._process.stdin as sink:
                pickle.dump((scene, camera), sink)
                while (message := self._queue.get()) is not None:
                    pickle.dump(message, sink)
                    sink.flush()
            return
        self._gone = True

    def _read(self) -> None:
        assert self._process.stdout is not None
        said = False
        with self._process.stdout as source, contextlib.suppress(EOFError, pickle.UnpicklingError):
            while True:
                report: Report = pickle.load(source)
                said = said or report.ended
                self._report(report)
        self._gone = True
        status = self._process.wait()
        wanted = self._killed or (self._closing and status == 0)
        if not said and not wanted:
            remedy = "see what it wrote to standard error, and the memory"
            self._report(Report(None, problem=f"its process {how_it_ended(status)} ({remedy})", ended=True))
