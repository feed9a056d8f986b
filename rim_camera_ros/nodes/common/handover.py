"""Hands the results of one node to another node of the same process, in memory instead of in messages."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from rim_camera_ros.frame import Intrinsics, RawFrame

#: Values that may wait: where the newest is wanted (without another rule), and where none may be lost.
_NEWEST, _ALL = 2, 50
#: Seconds between two checks whether a sender that waits for room is to stop.
_LOOK = 0.05


@dataclass(frozen=True, slots=True)
class Exposure:
    """A raw frame on its way from the driver to the correction.

    ``geometry``: that of the driver's camera_info, None where it states none.
    """

    frame: RawFrame
    frame_id: str
    geometry: Intrinsics | None = None

    @property
    def stamp(self) -> int:
        return self.frame.stamp


@dataclass(frozen=True, slots=True)
class CorrectedCloud:
    """A corrected frame on its way to the node that follows people.

    ``points`` (H, W, 4) float32: x y z [m], intensity [counts]; ``sigma`` (H, W) float32 [m]; ``head``: the
    header of their messages; ``stamp``: its stamp in ns.
    """

    points: NDArray[np.float32]
    sigma: NDArray[np.float32]
    head: Header
    stamp: int


class Handover[Value]:
    """A queue from one node to another; `put` is called in any thread, ``take`` by the receiver's executor.

    Where the receiver is too slow the oldest values are dropped, and counted in ``dropped``. With
    ``keep_all`` the sender waits for room instead, and nothing is lost, as with a reliable publisher.
    ``surplus`` returns how many of the oldest waiting values are to be dropped.
    """

    def __init__(self) -> None:
        self._surplus: Callable[[Sequence[Value]], int] = _beyond_newest
        self.dropped = 0
        self._waiting: deque[Value] = deque()
        self._changed = threading.Condition()
        self._take: Callable[[Value], None] | None = None
        self._wake: Callable[[], None] = lambda: None
        self._keep_all = False
        self._busy = self._begun = False

    def connect(self, node: Node, look: Callable[[], None] | None = None) -> None:
        """Set the node whose executor takes the values; ``look`` is called in place of `take_waiting`."""
        self._wake = node.create_guard_condition(look or self.take_waiting).trigger

    def begin(
        self,
        take: Callable[[Value], None],
        *,
        keep_all: bool,
        surplus: Callable[[Sequence[Value]], int] | None = None,
    ) -> None:
        """Receive from now on."""
        with self._changed:
            self.dropped, self._begun = 0, False
            self._take, self._keep_all = take, keep_all
            self._surplus = surplus or _beyond_newest

    def end(self) -> None:
        """Stop receiving; waiting values are dropped."""
        with self._changed:
            self._take = None
            self._waiting.clear()
            self._changed.notify_all()

    @property
    def wanted(self) -> bool:
        """Whether there is a receiver."""
        return self._take is not None

    @property
    def waits(self) -> bool:
        """Whether a value waits."""
        return bool(self._waiting)

    def put(self, value: Value, *, stopped: Callable[[], bool] = lambda: False, wake: bool = True) -> None:
        """Hand a value over; do nothing without a receiver. ``stopped`` ends a wait for room.

        ``wake``: False where the caller is the receiver's executor and takes waiting values itself.
        """
        with self._changed:
            while self._take is not None and self._keep_all and len(self._waiting) >= _ALL:
                if stopped():
                    return
                self._changed.wait(_LOOK)
            if self._take is None:
                return
            self._waiting.append(value)
            self._drop()
        if wake:
            self._wake()

    def take_waiting(self) -> None:
        """Take the oldest waiting value; another call follows if there are more."""
        with self._changed:
            take = self._take
            self._drop()
            self._begun = self._begun or take is not None
            if take is None or not self._waiting or self._busy:
                return  # busy: a callback that takes values itself while it waits is processing a value
            value = self._waiting.popleft()
            more = bool(self._waiting)
            self._busy = True
            self._changed.notify_all()
        try:
            take(value)
        finally:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
            if more:
                self._wake()

    def _drop(self) -> None:
        """Drop the values that are no longer wanted."""
        for _ in range(0 if self._keep_all else self._surplus(self._waiting)):
            self._waiting.popleft()
            self.dropped += self._begun  # while the nodes are made nobody looks yet

    def wait_until_taken(self, seconds: float) -> None:
        """Wait until no value waits, at most for ``seconds``; not to be called in the receiver's thread."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting and not self._busy, seconds)


def _beyond_newest(waiting: Sequence[object]) -> int:
    return max(0, len(waiting) - _NEWEST)
