"""An executor for nodes with plain callbacks, which does not gather all entities anew for each callback."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import ExitStack
from typing import Any

from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities

#: Kinds of entities by their name in a wait set: the attribute of a node, and the method of a wait set.
_KINDS = {
    "timer": ("timers", "add_timer"),
    "subscription": ("subscriptions", "add_subscription"),
    "guard_condition": ("guards", "add_guard_condition"),
    "client": ("clients", "add_client"),
    "service": ("services", "add_service"),
}

_Take = Callable[[Any], Callable[[], Coroutine[Any, Any, None]] | None]


class SteadyExecutor(SingleThreadedExecutor):
    """Calls the callbacks of nodes one after the other, in the thread that spins.

    rclpy's own executor gathers all entities of its nodes anew for each callback, and once more after it,
    which for a camera's nodes takes longer than to correct a frame. Here they are gathered again only after
    one was created or destroyed. Callbacks are plain functions; a coroutine that waits is an error.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._changed = True
        self._held = ExitStack()
        self._of: dict[str, dict[int, Any]] = {}
        self._waitables: list[Any] = []
        self._events: list[Any] = []
        self._events_due = True
        self._wait_set: Any = None
        self._adding: list[tuple[Callable[[Any], Any], list[Any]]] = []
        self._ready: deque[tuple[_Take, Any]] = deque()

    def wake(self) -> None:
        """Gather the entities anew; rclpy calls this when one was created or destroyed, in any thread."""
        self._changed = True
        super().wake()

    def add_node(self, node: Node) -> bool:
        """Call the callbacks of another node, too."""
        self._changed = True
        return bool(super().add_node(node))

    def remove_node(self, node: Node) -> None:
        """Stop calling the callbacks of a node."""
        self._release()
        super().remove_node(node)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop calling callbacks."""
        self._release()
        return bool(super().shutdown(timeout_sec))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Call one callback; if none is due, wait for one for at most ``timeout_sec`` (None: forever)."""
        if self._changed:
            self._gather()
        if not self._ready:
            self._wait(-1 if timeout_sec is None else round(timeout_sec * 1e9))
        if self._ready:
            take, entity = self._ready.popleft()
            self._call(take(entity))
        if self._tasks:  # made by futures, which these nodes do not use
            super().spin_once(timeout_sec=0)

    def _gather(self) -> None:
        """Hold all entities, so that none is destroyed while it is waited for."""
        self._release()
        # reset before gathering, so that entities that another thread creates meanwhile are seen next time
        self._changed = False
        nodes = self.get_nodes()
        count = NumberOfEntities()
        for kind, (name, _) in _KINDS.items():
            entities = [one for node in nodes for one in getattr(node, name)]
            self._of[kind] = {one.handle.pointer: one for one in self._holding(entities)}
        waitables = list(self._holding([waitable for node in nodes for waitable in node.waitables]))
        for waitable in waitables:
            count += waitable.get_num_entities()
        self._events = [waitable for waitable in waitables if isinstance(waitable, EventHandler)]
        self._waitables = [waitable for waitable in waitables if not isinstance(waitable, EventHandler)]
        self._events_due = True
        context: Any = self._context.handle
        self._held.enter_context(context)
        own = [self._guard.handle, self._sigint_gc.handle]
        handles = {kind: [one.handle for one in found.values()] for kind, found in self._of.items()}
        handles["guard_condition"] += own
        self._wait_set = rclpy_implementation.WaitSet(
            len(handles["subscription"]) + count.num_subscriptions,
            len(handles["guard_condition"]) + count.num_guard_conditions,
            len(handles["timer"]) + count.num_timers,
            len(handles["client"]) + count.num_clients,
            len(handles["service"]) + count.num_services,
            count.num_events,
            context,
        )
        self._adding = [(getattr(self._wait_set, add), handles[kind]) for kind, (_, add) in _KINDS.items()]
        # entities that were ready but have been destroyed since are not called
        alive = {id(one) for found in self._of.values() for one in found.values()}
        alive |= {id(waitable) for waitable in waitables}
        self._ready = deque(one for one in self._ready if id(one[1]) in alive)

    def _holding(self, entities: Iterable[Any]) -> Iterator[Any]:
        for entity in entities:
            try:
                self._held.enter_context(getattr(entity, "handle", entity))
            except InvalidHandle:  # it is being destroyed
                continue
            yield entity

    def _release(self) -> None:
        self._held.close()
        self._of, self._waitables, self._events, self._wait_set, self._adding = {}, [], [], None, []
        self._changed = True

    def _wait(self, nanoseconds: int) -> None:
        wait_set = self._wait_set
        wait_set.clear_entities()
        for add, handles in self._adding:
            for handle in handles:
                add(handle)
        waitables = self._waitables + self._events if self._events_due else self._waitables
        for waitable in waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(nanoseconds)
        if self._is_shutdown:
            raise ShutdownException
        if not self._context.ok():
            raise ExternalShutdownException
        self._ready.extend(
            (self._take_waitable, waitable) for waitable in waitables if waitable.is_ready(wait_set)
        )
        takes: dict[str, _Take] = {
            "timer": self._take_timer,
            "subscription": self._take_subscription,
            "guard_condition": self._take_guard_condition,
            "client": self._take_client,
            "service": self._take_service,
        }
        for kind, take in takes.items():
            of, pointers = self._of[kind], wait_set.get_ready_entities(kind)
            if kind == "timer":
                self._events_due = bool(pointers)
            for pointer in pointers:
                entity = of.get(pointer)  # None: a guard condition of the executor's own
                if entity is not None and (kind != "timer" or entity.handle.is_timer_ready()):
                    self._ready.append((take, entity))

    def _call(self, execute: Callable[[], Coroutine[Any, Any, None]] | None) -> None:
        if execute is None:
            return  # another has taken it
        coroutine = execute()
        try:
            coroutine.send(None)
        except StopIteration:
            return
        coroutine.close()
        raise RuntimeError("a callback waits: callbacks of these nodes are plain functions")
