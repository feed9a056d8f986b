"""A worker process's connection to the calibration node; no ROS in here.

The node writes the request, one line of JSON, to standard input. Later it may write a line `CANCEL`, or
`FINISH`, which ends the work with the data so far; the end of the input means that the node is gone. The
process answers with lines of JSON on standard output: ``{"stage", "done", "total"}`` any number of times, and
at the end one of ``{"result": ...}``, ``{"failed": text}``, ``{"cancelled": true}``. What libraries print
goes to standard error.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from rim_camera_ros.errors import RimError

CANCEL, FINISH = b"cancel\n", b"finish\n"
#: Least seconds between two messages of the same stage.
_PACE = 0.1
#: Seconds within which the work must end once the node is gone.
_PATIENCE = 5.0


class Link:
    """The connection to the node: its ``request``, and whether the work is to be ``cancelled`` or finished.

    ``finishing``: the work is to end with the data so far. ``keep``: if the node is gone, work is finished
    instead of cancelled.
    """

    def __init__(self, *, keep: bool) -> None:
        self.cancelled = False
        self.finishing = False
        self._keep = keep
        self._last = 0.0
        self._channel = os.dup(1)
        os.dup2(2, 1)
        # not sys.stdin: a thread that waits in it would make the interpreter's end an error
        self._input = os.fdopen(os.dup(0), "rb", buffering=0)
        self.request: dict[str, Any] = json.loads(self._input.readline())
        threading.Thread(target=self._watch, name="link", daemon=True).start()

    def progress(self, stage: str, done: int | None = None, total: int | None = None) -> None:
        """Report the stage, and how much of its total is done; counts at most ten times a second."""
        now = time.monotonic()
        if done is not None and done != total and now - self._last < _PACE:
            return
        self._last = now
        self.send(stage=stage, done=done, total=total)

    def send(self, **message: Any) -> None:
        """Send a message; do nothing if the node is gone."""
        data = json.dumps(message).encode() + b"\n"
        with contextlib.suppress(OSError):
            while data:
                data = data[os.write(self._channel, data) :]

    def _watch(self) -> None:
        while line := self._input.readline():
            self.cancelled |= line == CANCEL
            self.finishing |= line == FINISH
        if self._keep:
            self.finishing = True
        else:
            self.cancelled = True
        time.sleep(_PATIENCE)
        os._exit(1)


def serve(work: Callable[[Link], Mapping[str, Any]], *, keep: bool) -> None:
    """Do the work that the node requests, and send the result, or the reason why there is none."""
    link = Link(keep=keep)
    try:
        niceness = int(link.request.get("niceness", 0))
        if niceness:
            os.nice(niceness)
        link.send(result=dict(work(link)))
    except Exception as error:
        if link.cancelled:
            link.send(cancelled=True)
        elif isinstance(error, RimError):
            link.send(failed=str(error))
        else:
            traceback.print_exc()
            link.send(failed=f"unexpected {type(error).__name__}: {error} (please report this)")
