"""Long work within a callback, in another thread, while the node goes on taking its messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

from rclpy.subscription import Subscription

_Result = TypeVar("_Result")

#: Seconds between two checks for messages.
_LOOK = 0.001


class Aside:
    """One thread for work that takes longer than a frame may wait.

    A callback of the node (a service that may answer only after the work) calls `run`. Meanwhile the
    callbacks of ``subscriptions`` are called as the executor would, in the thread of the caller: apart from
    the work, the node never runs in two threads at once. ``idle`` is called when no message waits.
    """

    def __init__(self, subscriptions: Callable[[], Iterable[Subscription]], idle: Callable[[], None]) -> None:
        self._subscriptions = subscriptions
        self._idle = idle
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aside")

    def run(self, work: Callable[[], _Result]) -> _Result:
        """Return what the work returns, or raise what it raises."""
        future = self._thread.submit(work)
        while not future.done():
            if not take_messages(self._subscriptions()):
                self._idle()
                wait([future], _LOOK)
        return future.result()

    def close(self) -> None:
        """Accept no more work."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def take_messages(subscriptions: Iterable[Subscription]) -> bool:
    """Take one message of each subscription, and call its callback; False where there was none."""
    found = False
    for subscription in list(subscriptions):
        with subscription.handle:  # as rclpy's executor takes them
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is not None:
            found = True
            subscription.callback(taken[0])
    return found
