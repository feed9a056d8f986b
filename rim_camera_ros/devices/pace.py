"""Pacing of frames on a clock that never jumps, and their times on the wall clock."""

from __future__ import annotations

import threading
import time

from rim_camera_ros.frame import NANOSECONDS

#: If the wall clock differs by more than this [ns] it was set, and not merely read late.
_CLOCK_WAS_SET = NANOSECONDS // 20


class Pace:
    """Times at which frames are due, in ns of the monotonic clock: one period apart, without drift.

    ``interrupt`` may be called from another thread; it ends the present wait and all later ones. ``skipped``
    counts the due times that had already passed when they were requested.
    """

    def __init__(self) -> None:
        self._due: int | None = None
        self._offset: int | None = None
        self._interrupted = threading.Event()
        self.skipped = 0

    @property
    def interrupted(self) -> bool:
        return self._interrupted.is_set()

    def next(self, period: int, *, skip: bool = True) -> int:
        """Return the next due time [ns], ``period`` [ns] after the last one.

        If that has already passed: with ``skip`` the next time on the same grid, else the present time.
        """
        now = time.monotonic_ns()
        if self._due is None:
            self._due = now
        else:
            self._due += period
            if self._due < now and skip:
                late = -((self._due - now) // period)
                self._due += late * period
                self.skipped += late
            elif self._due < now - period:
                self._due = now
        return self._due

    def wait(self, due: int) -> bool:
        """Wait until ``due`` [ns]; False where it was interrupted."""
        while not self._interrupted.is_set():
            left = due - time.monotonic_ns()
            if left <= 0:
                return True
            self._interrupted.wait(left / NANOSECONDS)
        return False

    def interrupt(self) -> None:
        """End all waiting."""
        self._interrupted.set()

    def wall(self, due: int) -> int:
        """Return the wall-clock time [ns since 1970] of a due time.

        Both clocks run at the same rate, so their difference is kept until the wall clock is set.
        """
        offset = time.time_ns() - time.monotonic_ns()
        if self._offset is None or abs(offset - self._offset) > _CLOCK_WAS_SET:
            self._offset = offset
        return due + self._offset
