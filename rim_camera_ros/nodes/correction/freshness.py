"""Which of the waiting frames are too old to be corrected; no ROS in here."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from statistics import median
from typing import Protocol

from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.nodes.common.parameters import Spec, Values

MAXIMUM_AGE = Spec(
    "maximum_age",
    0.0,
    "seconds [s] by which a frame that waits may be behind the newest, and its stamp behind the clock; older "
    "ones are dropped, counted and warned of, unless qos.input is reliable; 0: three periods of the frames "
    "behind the newest, whatever the clock says",
    limits=(0.0, 60.0),
)
QUEUE_DEPTH = Spec(
    "queue_depth",
    5,
    "frames that may wait for the correction; where more would, all but the newest are dropped, counted and "
    "warned of, unless qos.input is reliable",
    limits=(1, 1000),
)

#: Periods by which a frame may be behind the newest.
_PERIODS = 3
#: Number of steps between stamps whose median is the period.
_STEPS = 15
#: Stamps farther apart than this [ns], or farther from the clock, come from a clock that was set or a
#: recording.
_JUMP = 60 * NANOSECONDS


class Stamped(Protocol):
    """A waiting value; ``stamp`` in ns."""

    @property
    def stamp(self) -> int: ...


class Freshness:
    """Decides how many of the waiting values are to be dropped.

    ``values`` holds `MAXIMUM_AGE` and `QUEUE_DEPTH`; ``now`` returns the time of the stamps' clock in ns.
    """

    def __init__(self, values: Values, now: Callable[[], int]) -> None:
        self._values = values
        self._now = now
        self._steps: deque[int] = deque(maxlen=_STEPS)
        self._newest: int | None = None

    def surplus(self, waiting: Sequence[Stamped]) -> int:
        """Return how many of the values that wait, in the order of their arrival, are to be dropped.

        If one is too old all but the newest are dropped. The correction has then caught up, and small delays
        now and then lose no frames.
        """
        if not waiting:
            return 0
        newest = waiting[-1].stamp
        self._note(newest)
        if self.expired(newest):
            return len(waiting)
        limit = self._limit or self._three_periods()
        late = any(limit < newest - stamped.stamp < _JUMP for stamped in waiting) if limit else False
        return len(waiting) - 1 if late or len(waiting) > self._values[QUEUE_DEPTH.name] else 0

    def expired(self, stamp: int) -> bool:
        """Return whether a stamp [ns] is behind the clock by more than the maximum age, if one is set."""
        limit = self._limit
        return bool(limit) and limit < self._now() - stamp < _JUMP

    @property
    def _limit(self) -> int:
        return round(float(self._values[MAXIMUM_AGE.name]) * NANOSECONDS)

    def _note(self, stamp: int) -> None:
        if self._newest is not None and 0 < stamp - self._newest < _JUMP:
            self._steps.append(stamp - self._newest)
        self._newest = stamp

    def _three_periods(self) -> int:
        # half a period more: stamps are not exactly a period apart
        return round((_PERIODS + 0.5) * median(self._steps)) if self._steps else 0
