"""The end of a process within a time limit, whatever the middleware does.

Fast DDS 2.14, as the wheels build it, can block for half a minute or longer while it destroys its
participant. If a callback of its discovery runs at that moment, it waits for the callback while it holds the
lock that the callback needs (Fast DDS issue 6513: a time limit that overflows). When two cameras were ended
together this happened about once in 300 times. rclpy destroys the participant with the interpreter's lock
held, so that neither a thread of Python nor a signal handler can act.
"""

from __future__ import annotations

import contextlib
import ctypes
from typing import ClassVar

#: As <signal.h> and <time.h> of Linux have them.
_SIGEV_THREAD, _CLOCK_MONOTONIC = 2, 1


class _Event(ctypes.Structure):
    """``struct sigevent`` of Linux with 64-bit pointers."""

    _fields_: ClassVar = [
        ("value", ctypes.c_long),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_long * 4),
    ]


class _Times(ctypes.Structure):
    """``struct itimerspec``: interval and first expiry in s and ns."""

    _fields_: ClassVar = [("interval", ctypes.c_long * 2), ("value", ctypes.c_long * 2)]


def end_within(seconds: float, *, status: int) -> None:
    """End this process with an exit status after so many seconds, if it still runs then.

    A timer of the C library calls ``_exit``, which does not need Python. As after SIGKILL, no output is
    flushed, and other processes only notice when the middleware's lease runs out. Where there is no such
    timer (another C library) nothing is done.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None, use_errno=True)
        event = _Event(value=status, notify=_SIGEV_THREAD)
        event.function = ctypes.cast(libc._exit, ctypes.c_void_p)
        timer = ctypes.c_void_p()
        whole = int(seconds)
        times = _Times(value=(ctypes.c_long * 2)(whole, round((seconds - whole) * 1e9)))
        if libc.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
            libc.timer_settime(timer, 0, ctypes.byref(times), None)
