"""Managed nodes (ROS 2 lifecycle) that configure and activate themselves by default."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.timer import Timer

from rim_camera_ros.bags.topics import DEFAULT_NAMESPACE
from rim_camera_ros.errors import RimError
from rim_camera_ros.nodes.common.parameters import Spec

#: Namespace of a node without a given one: topics are then those of the documentation.
NAMESPACE = DEFAULT_NAMESPACE.lstrip("/")

AUTOSTART = Spec(
    "autostart",
    True,
    "configure and activate at the start; false: wait for a lifecycle manager",
    read_only=True,
)

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = "unconfigured", "inactive", "active", "finalized"


class Managed(Protocol):
    """What a node does at each transition. A `RimError` refuses it, and the node stays in its state."""

    def configure(self) -> None:
        """Read files, open the device, offer topics; on an error hold nothing."""

    def activate(self) -> None:
        """Begin to work; on an error hold what `configure` held."""

    def deactivate(self) -> None:
        """Stop working; nothing is published after it."""

    def cleanup(self) -> None:
        """Release what `configure` holds; no-op if it holds nothing."""


class ManagedNode(LifecycleNode):
    """A lifecycle node whose transitions are the methods of a `Managed`.

    ``phase`` is its state. ``failure`` is the error of the last transition that was refused, None after one
    that was not.
    """

    def __init__(self, name: str) -> None:
        self.phase = UNCONFIGURED
        self.failure: RimError | None = None
        self._life: Managed | None = None
        self._quiet = False
        super().__init__(name, namespace=NAMESPACE)
        self.log: Any = Node.get_logger(self)
        service = self._service_change_state
        service.callback = _guarded(service.callback)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)

    def start(self, life: Managed, *, autostart: bool) -> None:
        """Hand the transitions to ``life``, and go through the first two with ``autostart``.

        Raises the `RimError` that refuses one of them.
        """
        self._life = life
        if not autostart:
            self.log.info(f"{self.get_fully_qualified_name()} waits to be configured")
            return
        self._quiet = True  # the caller says what is wrong
        try:
            steps: tuple[Callable[[], Any], ...] = (self.trigger_configure, self.trigger_activate)
            for step in steps:
                if step() != TransitionCallbackReturn.SUCCESS:
                    raise self.failure or RimError("the node cannot be started")
        finally:
            self._quiet = False

    def end(self) -> None:
        """Release everything, whatever the state."""
        if self._life is not None:
            if self.phase == ACTIVE:
                self._life.deactivate()
            self._life.cleanup()
        self.phase = FINALIZED

    def steady_timer(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Return a timer that runs on even if the clock is set or simulated time stands still."""
        return self.create_timer(seconds, callback, clock=self._steady)

    # --- transitions ----------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> Any:
        return self._go("configure", INACTIVE)

    def on_activate(self, state: LifecycleState) -> Any:
        return self._go("activate", ACTIVE)

    def on_deactivate(self, state: LifecycleState) -> Any:
        return self._go("deactivate", INACTIVE)

    def on_cleanup(self, state: LifecycleState) -> Any:
        return self._go("cleanup", UNCONFIGURED)

    def on_shutdown(self, state: LifecycleState) -> Any:
        if state.label == ACTIVE:
            self._go("deactivate", INACTIVE)
        return self._go("cleanup", FINALIZED)

    def on_error(self, state: LifecycleState) -> Any:
        self._go("deactivate", INACTIVE)
        return self._go("cleanup", UNCONFIGURED)

    def _go(self, step: str, phase: str) -> Any:
        self.failure = None
        try:
            if self._life is not None:
                getattr(self._life, step)()
        except Exception as error:
            known = isinstance(error, RimError)
            problem = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            self.failure = error if isinstance(error, RimError) else RimError(problem)
            if not self._quiet:
                self.log.error(f"cannot {step}: {problem}")
            return TransitionCallbackReturn.FAILURE
        self.phase = phase
        if not self._quiet:
            self.log.info(f"{step}: done, now {phase}")
        return TransitionCallbackReturn.SUCCESS


def _guarded(callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Refuse a transition that the state does not have; in rclpy it is an exception, which ends the node."""

    def change_state(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception:
            response.success = False
            return response

    return change_state
