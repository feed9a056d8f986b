"""Ctrl-C while a program of this package still imports its libraries: it ends without a traceback.

This module runs first in every program of the package, and imports almost nothing. Programs set their own
handlers once they have something to clean up.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

#: Programs, by the name of their executable or of their module, with their exit status when interrupted. For
#: nodes it is success, as they only end on request.
PROGRAMS = {
    "rim": 130,
    "demo": 130,
    "camera_node": 0,
    "driver_node": 0,
    "correction_node": 0,
    "people_node": 0,
    "calibration_node": 0,
}
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PACKAGE = "rim_camera_ros"
#: Modules that are not named like their program.
_MODULES = {"cli": "rim"}


def program(command: Sequence[str], script: str) -> str | None:
    """Return which of `PROGRAMS` a process is, None for any other that imports the package.

    ``command``: the interpreter's command line (``sys.orig_argv``); ``script``: ``sys.argv[0]`` while the
    package is imported, which is ``-m`` for a module.
    """
    if script == "-m":
        flags = [i for i, one in enumerate(command[:-1]) if one.startswith("-") and one.endswith("m")]
        package, _, module = command[flags[0] + 1].partition(".") if flags else ("", "", "")
        if package != _PACKAGE:
            return None
        name = module.removeprefix("nodes.").replace(".", "_")
        name = _MODULES.get(name, name)
    else:
        name = os.path.basename(script)
    return name if name in PROGRAMS else None


def end_quietly_while_importing() -> None:
    """End this process at SIGINT, SIGTERM, SIGHUP if it is one of `PROGRAMS` and does not ignore them.

    Once its work is done it ignores them, until the interpreter has ended.
    """
    name = program(sys.orig_argv, sys.argv[0] if sys.argv else "")
    if name is None:
        return

    def end(number: int, frame: FrameType | None) -> None:
        ignore()  # a second signal before the end would write the line again
        status = PROGRAMS[name]
        if status:
            os.write(2, f"{name}: interrupted\n".encode())
        os._exit(status)  # no work has begun; an exception could be lost during an import

    def ignore() -> None:
        for number in heard:
            signal.signal(number, signal.SIG_IGN)

    heard = [signals for signals in _ENDING if signal.getsignal(signals) != signal.SIG_IGN]
    for number in heard:
        signal.signal(number, end)
    # at its end the interpreter restores the system's handlers, but ignored signals stay ignored
    atexit.register(ignore)
