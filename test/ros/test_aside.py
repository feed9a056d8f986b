"""Work in a thread of its own, while messages are taken in the calling one."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rim_camera_ros.nodes.correction.aside import Aside


class StandIn:
    """A subscription, and its handle, to which messages come."""

    msg_type, raw = str, False

    def __init__(self) -> None:
        self.handle = self
        self.waiting: list[str] = []
        self.taken: list[tuple[str, int]] = []

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def take_message(self, kind: Any, raw: bool) -> tuple[str, None] | None:
        return (self.waiting.pop(0), None) if self.waiting else None

    def callback(self, message: str) -> None:
        self.taken.append((message, threading.get_ident()))


@pytest.fixture
def subscription() -> StandIn:
    return StandIn()


@pytest.fixture
def aside(subscription: StandIn) -> Iterator[Aside]:
    one = Aside(lambda: [subscription], lambda: None)  # type: ignore[list-item]
    yield one
    one.close()


def test_messages_are_taken_in_the_calling_thread_while_it_works(aside: Aside, subscription: StandIn) -> None:
    def work() -> int:
        assert threading.get_ident() != here
        for number in range(3):
            subscription.waiting.append(f"message {number}")
            end = time.monotonic() + 10.0
            while len(subscription.taken) <= number:  # it ends only if they are taken meanwhile
                assert time.monotonic() < end
                time.sleep(0.001)
        return 7

    here = threading.get_ident()
    assert aside.run(work) == 7
    assert subscription.taken == [(f"message {number}", here) for number in range(3)]
    # what comes later is the executor's
    subscription.waiting.append("later")
    assert subscription.waiting == ["later"]


def test_an_error_of_the_work_is_raised_and_the_next_work_is_done(aside: Aside) -> None:
    def fails() -> None:
        raise ValueError("no such file")

    with pytest.raises(ValueError, match="no such file"):
        aside.run(fails)
    assert aside.run(lambda: "next") == "next"
