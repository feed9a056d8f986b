"""Running a node as a process: start, signals, errors in one line, exit status."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from rim_camera_ros.errors import RimError
from rim_camera_ros.files import share_folder

#: Seconds between two warnings of a kind.
_QUIET = 5.0


class Service(Protocol):
    """A node's life: ``status`` becomes other than None when it is to end by itself."""

    status: int | None

    @property
    def node(self) -> Node: ...

    def close(self) -> None: ...


def run(name: str, make: Callable[[], Service]) -> int:
    """Run a node until it ends or a signal comes, and return the exit status.

    0: ended, or asked to end by SIGINT or SIGTERM, however often. An error at the start is one line on
    standard error, status 2 (bad input) or 1.
    """
    signals = _Signals()
    try:
        return _run(name, make, signals)
    finally:
        signals.ignore()


def _run(name: str, make: Callable[[], Service], signals: _Signals) -> int:
    single_threaded()
    try:
        use_shipped_profile()
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except RimError as error:
        return _failed(name, str(error), error.exit_status)
    except Exception as error:
        reason = str(error).partition(", at /")[0].rstrip(".")
        return _failed(name, f"{reason} (parameters: --ros-args -p name:=value)", 2)
    try:
        unknown = remove_ros_args(sys.argv)[1:]
        if unknown:
            return _failed(name, f"unknown argument {unknown[0]} (parameters: --ros-args -p name:=value)", 2)
        try:
            service = make()
        except RimError as error:
            return _failed(name, str(error), error.exit_status)
        except RuntimeError as error:  # of rcl: the middleware refuses (security, domain, memory)
            return _failed(name, str(error).partition(", at /")[0], 1)
        return _spin(service, signals)
    finally:
        rclpy.try_shutdown()  # type: ignore[attr-defined]


def _spin(service: Service, signals: _Signals) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(service.node)
    # a guard condition of a node counts as work: only work makes spin_once return
    signals.wake = service.node.create_guard_condition(lambda: None).trigger
    try:
        while not signals.came and service.status is None:
            executor.spin_once()
    finally:
        signals.wake = None
        service.close()
        executor.remove_node(service.node)
        executor.shutdown(timeout_sec=0)
        service.node.destroy_node()
    return service.status or 0


class _Signals:
    """SIGINT and SIGTERM end the executor between two callbacks; those that come later do nothing.

    rclpy's own handlers shut the context down under a running executor, which then may raise anything.
    Python's run in the main thread, which waits inside of it: hence the pipe, into which Python writes at
    once, and a thread that reads it.
    """

    _NUMBERS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.came = False
        self.wake: Callable[[], None] | None = None
        self._read, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in self._NUMBERS:
            signal.signal(number, _no_matter)
        threading.Thread(target=self._wait, name="signals", daemon=True).start()

    def ignore(self) -> None:
        """Ignore the signals from now on, also while the interpreter ends."""
        for number in self._NUMBERS:
            signal.signal(number, signal.SIG_IGN)

    def _wait(self) -> None:
        while os.read(self._read, 1):
            self.came = True
            wake = self.wake
            if wake is not None:
                with contextlib.suppress(Exception):  # the executor may be going already
                    wake()


def _no_matter(number: int, frame: Any) -> None:
    """Python's part in a signal."""


def use_shipped_profile() -> None:
    """Have Fast DDS use config/fastdds.xml, unless the environment names another profile.

    Its own shared memory of 512 KB is filled by one image of 512 x 424 pixels, and the messages beside it
    come seconds late.
    """
    names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    if any(os.environ.get(name) for name in names):
        return
    profile = share_folder() / "config" / "fastdds.xml"
    if profile.is_file():
        os.environ[names[0]] = str(profile)


def single_threaded() -> None:
    """Pin OpenCV to one thread; BLAS and OpenMP are pinned by `rim_camera_ros.nodes`."""
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(1)


def _failed(name: str, problem: str, status: int) -> int:
    text = " ".join(problem.split())
    print(f"{name}: {text}", file=sys.stderr, flush=True)
    return status


class Throttle:
    """Warnings, of each kind at most one in five seconds, with the number of those left out."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._last: dict[str, float] = {}
        self._left_out: dict[str, int] = {}

    def warn(self, kind: str, text: str) -> None:
        """Log a warning of a kind, unless one was just logged."""
        now = time.monotonic()
        if kind in self._last and now - self._last[kind] < _QUIET:
            self._left_out[kind] = self._left_out.get(kind, 0) + 1
            return
        more = self._left_out.pop(kind, 0)
        self._last[kind] = now
        self._node.get_logger().warning(text + (f" [{more} more like it]" if more else ""))
