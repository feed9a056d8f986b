"""Running a node as a process: start, signals, errors in one line, exit status."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, MutableMapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_rmw_implementation_identifier, remove_ros_args

from rim_camera_ros.errors import RimError
from rim_camera_ros.files import share_folder
from rim_camera_ros.nodes.common.ending import end_within
from rim_camera_ros.nodes.common.executor import SteadyExecutor

#: Seconds between two warnings of a kind.
_QUIET = 5.0
#: Seconds that the middleware may take to destroy nodes: 0.05 to 0.2 s are usual, and ``ros2 launch`` kills
#: a process after ten.
_ENDING = 5.0
#: Parameters of mallopt (malloc.h), and the bytes up to which memory is kept: the greatest allowed value.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT_SIZE = 32 << 20
#: Variables by which a user chooses other transports or profiles.
_OF_USER = (
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
)
_FAST_DDS = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


class Service(Protocol):
    """A node that is run: ``status`` becomes the exit status when it is to end by itself, else None."""

    status: int | None

    @property
    def node(self) -> Node: ...

    def close(self) -> None: ...


def run(name: str, make: Callable[[], Iterable[Service]]) -> int:
    """Run the nodes that ``make`` makes until one ends or a signal comes, and return the exit status.

    0: ended, or asked to end by SIGINT or SIGTERM, however often. An error at the start is one line on
    standard error, status 2 (bad input) or 1.
    """
    signals = _Signals()
    try:
        return _run(name, make, signals)
    finally:
        signals.ignore()


def _run(name: str, make: Callable[[], Iterable[Service]], signals: _Signals) -> int:
    single_threaded()
    keep_memory()
    try:
        used = use_shipped_profile(
            os.environ,
            profile=share_folder() / "config" / "fastdds.xml",
            middleware=get_rmw_implementation_identifier(),
        )
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
        services: list[Service] = []
        try:
            for service in make():
                services.append(service)  # one by one: if one fails, those before it are closed
                if signals.came:
                    break
        except RimError as error:
            status = _failed(name, str(error), error.exit_status)
            _close(services, status=status)
            return status
        except RuntimeError as error:  # from rcl: the middleware refuses (security, domain, memory)
            status = _failed(name, str(error).partition(", at /")[0], 1)
            _close(services, status=status)
            return status
        services[0].node.get_logger().info(used)
        return _spin(services, signals)
    finally:
        rclpy.try_shutdown()  # type: ignore[attr-defined]


def _spin(services: Sequence[Service], signals: _Signals) -> int:
    executor = SteadyExecutor()
    for service in services:
        executor.add_node(service.node)
    # a guard condition of a node counts as work: only work makes spin_once return
    signals.wake = services[0].node.create_guard_condition(lambda: None).trigger
    status = 1  # for an exception, which Python reports
    try:
        while not signals.came and all(service.status is None for service in services):
            executor.spin_once()
        status = max(service.status or 0 for service in services)
    finally:
        signals.wake = None
        _close(services, executor, status=status)
    return status


def _close(services: Sequence[Service], executor: SteadyExecutor | None = None, *, status: int) -> None:
    """End the nodes, in reverse order of their making: sources of frames before receivers.

    The process ends with ``status`` at the latest after `_ENDING`.
    """
    for service in reversed(services):
        service.close()
        if executor is not None:
            executor.remove_node(service.node)
    if executor is not None:
        executor.shutdown(timeout_sec=0)
    for output in (sys.stdout, sys.stderr):
        output.flush()
    end_within(_ENDING, status=status)
    for service in services:
        service.node.destroy_node()


class _Signals:
    """SIGINT and SIGTERM end the executor between two callbacks; later signals are ignored.

    rclpy's own handlers shut the context down while the executor runs, which then may raise anything.
    Python's handlers run in the main thread, which is blocked in the executor. Therefore Python writes
    signals into a pipe at once, and a thread reads it.
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
                with contextlib.suppress(Exception):  # the executor may already be shut down
                    wake()


def _no_matter(number: int, frame: Any) -> None:
    """Handle a signal in Python: do nothing, as the thread acts."""


def use_shipped_profile(environment: MutableMapping[str, str], *, profile: Path, middleware: str) -> str:
    """Have Fast DDS use ``profile`` where the user has set nothing, and return which settings are used.

    With the default settings one image of 512 x 424 pixels fills the shared memory of 512 KB, and further
    messages come seconds late. ``middleware``: its name. To be called before nodes are made.
    """
    if middleware not in _FAST_DDS:
        return f"middleware: {middleware}, with its own settings"
    for name in _OF_USER:
        if environment.get(name):
            return f"middleware: Fast DDS as {name}={environment[name]} says"
    if not profile.is_file():
        return "middleware: Fast DDS with its own settings"
    environment[_OF_USER[1]] = str(profile)
    return f"middleware: Fast DDS with {profile}"


def single_threaded() -> None:
    """Pin OpenCV to one thread; BLAS and OpenMP are pinned by `rim_camera_ros.nodes`."""
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(1)


def keep_memory() -> None:
    """Let the C library (glibc) keep freed memory: images and clouds are allocated anew for every frame.

    Otherwise blocks of this size return to the system each time, which then fills their pages with zeros
    again. For a cloud of 640 x 480 points this takes more than a millisecond.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_MMAP_THRESHOLD, _KEPT_SIZE)
        libc.mallopt(_TRIM_THRESHOLD, 8 * _KEPT_SIZE)


def _failed(name: str, problem: str, status: int) -> int:
    text = " ".join(problem.split())
    print(f"{name}: {text}", file=sys.stderr, flush=True)
    return status


class Throttle:
    """Logs of each kind of warning at most one in five seconds, with the number of those suppressed."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._last: dict[str, float] = {}
        self._suppressed: dict[str, int] = {}

    def warn(self, kind: str, text: str) -> None:
        """Log a warning of a kind, unless one was logged recently."""
        now = time.monotonic()
        if kind in self._last and now - self._last[kind] < _QUIET:
            self._suppressed[kind] = self._suppressed.get(kind, 0) + 1
            return
        more = self._suppressed.pop(kind, 0)
        self._last[kind] = now
        self._node.get_logger().warning(text + (f" [{more} more like it]" if more else ""))
