"""The executor: who is called, when entities come and go, and that it does not gather them with each call."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt32
from std_srvs.srv import Trigger

from rim_camera_ros.nodes.common.executor import SteadyExecutor
from test.ros.harness import next_domain

PATIENCE = 20.0
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Nodes:
    """Two nodes of a domain of their own, and the executor of both."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=next_domain())
        self.node, self.other = (
            Node(name, context=self.context, start_parameter_services=False) for name in ("first", "second")
        )
        self.executor = SteadyExecutor(context=self.context)
        for one in (self.node, self.other):
            self.executor.add_node(one)

    def until(self, condition: Callable[[], bool]) -> bool:
        """Spin until the condition holds; False where it never does."""
        end = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(0.05)
        return True

    def close(self) -> None:
        for one in (self.node, self.other):
            self.executor.remove_node(one)
        self.executor.shutdown(0)
        for one in (self.node, self.other):
            one.destroy_node()
        rclpy.try_shutdown(context=self.context)  # type: ignore[attr-defined]


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    made = Nodes()
    yield made
    made.close()


def steady_timer(node: Node, seconds: float, callback: Callable[[], None]) -> object:
    return node.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def test_messages_services_timers_and_guard_conditions_are_served(nodes: Nodes) -> None:
    came: dict[str, int] = {"message": 0, "service": 0, "timer": 0, "guard": 0}

    def note(name: str) -> None:
        came[name] += 1

    def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        note("service")
        response.success, response.message = True, "served"
        return response

    nodes.node.create_subscription(UInt32, "numbers", lambda message: note("message"), 10)
    nodes.node.create_service(Trigger, "serve", serve)
    guard = nodes.node.create_guard_condition(lambda: note("guard"))
    publisher = nodes.other.create_publisher(UInt32, "numbers", 10)
    client = nodes.other.create_client(Trigger, "serve")
    answers = []

    def on_timer() -> None:
        note("timer")
        if publisher.get_subscription_count() and client.service_is_ready() and not answers:
            publisher.publish(UInt32(data=7))
            answers.append(client.call_async(Trigger.Request()))
            guard.trigger()

    steady_timer(nodes.other, 0.02, on_timer)
    assert nodes.until(lambda: all(came.values()) and bool(answers) and answers[0].done()), came
    assert answers[0].result().message == "served"
    assert (came["message"], came["service"], came["guard"]) == (1, 1, 1)


def test_entities_are_gathered_again_only_after_a_change(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    gathered = []
    gather = SteadyExecutor._gather
    monkeypatch.setattr(SteadyExecutor, "_gather", lambda self: (gathered.append(1), gather(self)))
    ticks = []
    steady_timer(nodes.node, 0.002, lambda: ticks.append(1))
    assert nodes.until(lambda: len(ticks) >= 5)
    gathered.clear()
    assert nodes.until(lambda: len(ticks) >= 40)
    assert not gathered
    more = []
    steady_timer(nodes.other, 0.002, lambda: more.append(1))
    assert nodes.until(lambda: len(more) >= 5)
    assert len(gathered) == 1


def test_what_another_thread_creates_ends_the_wait(nodes: Nodes) -> None:
    came: list[int] = []
    nodes.executor.spin_once(0)
    threading.Timer(0.05, lambda: steady_timer(nodes.other, 0.01, lambda: came.append(1))).start()
    end = time.monotonic() + PATIENCE
    while not came and time.monotonic() < end:
        nodes.executor.spin_once()  # for ever, but for what is created
    assert came


def test_what_is_destroyed_is_not_called_although_it_was_ready(nodes: Nodes) -> None:
    called: list[str] = []
    guards = {}

    def call(name: str, other: str) -> None:
        called.append(name)
        nodes.node.destroy_guard_condition(guards[other])

    guards["a"] = nodes.node.create_guard_condition(lambda: call("a", "b"))
    guards["b"] = nodes.node.create_guard_condition(lambda: call("b", "a"))
    nodes.executor.spin_once(0)
    for one in guards.values():
        one.trigger()
    assert nodes.until(lambda: bool(called))
    for _ in range(5):
        nodes.executor.spin_once(0.01)
    assert len(called) == 1


def test_a_guard_condition_that_is_triggered_in_its_callback_comes_again(nodes: Nodes) -> None:
    calls = []

    def call() -> None:
        calls.append(1)
        if len(calls) < 3:
            guard.trigger()

    guard = nodes.node.create_guard_condition(call)
    guard.trigger()
    assert nodes.until(lambda: len(calls) == 3)


def test_events_of_the_middleware_are_seen(nodes: Nodes) -> None:
    events = []
    steady_timer(nodes.node, 0.02, lambda: None)
    nodes.node.create_publisher(
        UInt32,
        "numbers",
        BEST_EFFORT,
        event_callbacks=PublisherEventCallbacks(incompatible_qos=events.append, use_default_callbacks=False),
    )
    nodes.other.create_subscription(UInt32, "numbers", lambda message: None, 10)
    assert nodes.until(lambda: bool(events))


def test_an_error_of_a_callback_reaches_the_caller_and_the_next_one_is_called(nodes: Nodes) -> None:
    calls = []

    def fail() -> None:
        calls.append("fail")
        raise ValueError("of the callback")

    nodes.node.create_guard_condition(fail).trigger()
    with pytest.raises(ValueError, match="of the callback"):
        nodes.until(lambda: False)
    nodes.node.create_guard_condition(lambda: calls.append("next")).trigger()
    assert nodes.until(lambda: calls == ["fail", "next"])


def test_a_callback_that_waits_is_an_error(nodes: Nodes) -> None:
    future: rclpy.Future[None] = rclpy.Future()

    async def wait() -> None:
        await future

    nodes.node.create_guard_condition(wait).trigger()
    with pytest.raises(RuntimeError, match="callbacks of these nodes are plain functions"):
        nodes.until(lambda: False)


def test_a_shut_down_context_ends_a_wait(nodes: Nodes) -> None:
    nodes.executor.spin_once(0)
    threading.Timer(0.05, lambda: rclpy.shutdown(context=nodes.context)).start()
    with pytest.raises(ExternalShutdownException):
        nodes.executor.spin_once()
