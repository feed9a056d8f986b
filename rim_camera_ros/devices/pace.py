"""Pacing on a clock that never jumps, and the wall-clock time of what is due."""

from __future__ import annotations

import threading
import time

from rim_camera_ros.frame import NANOSECONDS

#: The wall clock was set, not merely read late, where it is off by more than this [ns].
_CLOCK_WAS_SET = NANOSECONDS // 20


class Pace:
    """When frames are due, in ns of the monotonic clock: a period after each other, without drift.

    ``interrupt`` may be called from another thread; it ends the wait that is under way and all later
    ones. ``skipped`` counts the due times that had passed before anybody waited for them.
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

        Where that has passed already: the next of the same raster with ``skip``, else at once.
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

        Both clocks run alike, so their difference is kept until the wall clock is set.
        """
        offset = time.time_ns() - time.monotonic_ns()
        if self._offset is None or abs(offset - self._offset) > _CLOCK_WAS_SET:
            self._offset = offset
        return due + self._offset
