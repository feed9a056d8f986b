"""Starts nodes as processes and collects what they publish, without loss and without sleeping.

with World(tmp_path) as world:
    world.start("correction_node", camera="sr3000", **{"qos.input": "reliable"})
    points = world.collect(PointCloud2, "/camera/points")
    ...
    assert world.until(lambda: len(points) == 20)
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from rim_camera_ros.bags.messages import (
    image_array,
    points_array,
    range_from,
    settings_from,
    temperature_from,
)
from rim_camera_ros.frame import NANOSECONDS, RawFrame, Settings

#: Seconds after which a condition is given up.
PATIENCE = 30.0

RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
START = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

#: Parameters with which a chain of nodes loses nothing.
LOSSLESS_DRIVER = {"qos.images": "reliable", "qos.info": "reliable"}
LOSSLESS_CORRECTION = {"qos.input": "reliable", "qos.points": "reliable", "qos.images": "reliable"}

#: ROS domains (above 101 ports may be taken), from another one on in each process.
_DOMAINS = 101
_domains = itertools.count(os.getpid() * 13)
_locks: dict[int, TextIO] = {}


def next_domain() -> int:
    """Return a ROS domain that no other test on this machine uses, until it is released or the process ends.

    Tests in a domain by chance the same have set each other's parameters.
    """
    for number in itertools.islice(_domains, _DOMAINS):
        domain = 1 + number % _DOMAINS
        if domain in _locks:
            continue
        with contextlib.suppress(OSError):  # taken, or another user's
            lock = (Path(tempfile.gettempdir()) / f"rim_camera_ros_domain_{domain}").open("w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.close()
                raise
            _locks[domain] = lock
            return domain
    raise RuntimeError("every ROS domain is in use by a test")


def release_domain(domain: int) -> None:
    """Let other tests use a domain."""
    _locks.pop(domain).close()


def stamp_of(message: Any) -> int:
    """Return a message's stamp in ns."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


@dataclass
class Collected:
    """Messages of one topic in the order in which they came, and how many publishers are connected."""

    topic: str
    messages: list[Any] = field(default_factory=list)
    matched: int = 0

    def __len__(self) -> int:
        return len(self.messages)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.messages)

    @property
    def last(self) -> Any:
        return self.messages[-1]

    def by_stamp(self) -> dict[int, Any]:
        """Return the messages by stamp in ns."""
        return {stamp_of(one): one for one in self.messages}


class Diagnosed:
    """Diagnostics that come, by the name of the check, as ``/camera/driver: frames``."""

    def __init__(self, collected: Collected) -> None:
        self._collected = collected

    def of(self, name: str) -> list[Any]:
        """Return all statuses of a check."""
        return [one for message in self._collected for one in message.status if one.name == name]

    def level(self, name: str) -> int:
        """Return the last level of a check, -1 where it has not come."""
        found = self.of(name)
        return int(found[-1].level[0]) if found else -1

    def message(self, name: str) -> str:
        """Return the last message of a check."""
        found = self.of(name)
        return str(found[-1].message) if found else ""

    def values(self, name: str) -> dict[str, str]:
        """Return the last values of a check."""
        found = self.of(name)
        return {one.key: one.value for one in found[-1].values} if found else {}

    def clear(self) -> None:
        """Forget what has come."""
        self._collected.messages.clear()


class Process:
    """A node as a process; its output goes to a file."""

    def __init__(self, command: list[str], environment: dict[str, str], output: Path) -> None:
        self.output = output
        with output.open("wb") as file:
            self._process = subprocess.Popen(
                command, env=environment, stdout=file, stderr=subprocess.STDOUT, start_new_session=True
            )

    @property
    def text(self) -> str:
        """What it has written so far."""
        return self.output.read_text(errors="replace")

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def wait(self, timeout: float = PATIENCE) -> int:
        """Return the exit status."""
        return self._process.wait(timeout)

    def kill(self) -> None:
        if self.running:
            self._process.kill()
            self._process.wait()


class World:
    """A ROS domain of its own with nodes as processes and a listener in this process.

    ``namespace`` is that of the nodes; parameters are given as keywords.
    """

    def __init__(self, folder: Path, *, namespace: str = "/camera") -> None:
        self.namespace = namespace
        self.domain = next_domain()
        self._folder = folder
        self._processes: list[Process] = []
        self._clients: dict[str, AsyncParameterClient] = {}
        self.environment = os.environ | {
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "log"),
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }

    def __enter__(self) -> World:
        before = {name: os.environ.get(name) for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR")}
        os.environ.update({name: self.environment[name] for name in before})
        try:
            self._context = Context()
            rclpy.init(context=self._context, domain_id=self.domain)
            self.node = Node("test_listener", context=self._context)
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        return self

    def __exit__(self, *_: object) -> None:
        for one in self._processes:  # killed at once, they would leave their shared memory behind
            if one.running:
                one.send(signal.SIGINT)
        end = time.monotonic() + 3.0
        for one in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                one.wait(max(0.01, end - time.monotonic()))
            one.kill()
        # the node leaves the executor before anything is destroyed: in the other order rclpy has crashed
        self._executor.remove_node(self.node)
        self._executor.shutdown()
        rclpy.shutdown(context=self._context)
        self.node.destroy_node()
        release_domain(self.domain)

    # --- nodes ----------------------------------------------------------------------------------

    def start(self, executable: str, *arguments: str, **parameters: Any) -> Process:
        """Start a node, ``driver_node`` say, with parameters (with dots: ``**{"qos.images": ...}``)."""
        module = executable if executable == "camera_node" else executable.replace("_node", ".node")
        command = [sys.executable, "-m", f"rim_camera_ros.nodes.{module}", "--ros-args"]
        for name, value in parameters.items():
            shown = (
                str(value).lower()
                if isinstance(value, bool)
                else f"'{value}'"
                if isinstance(value, str)
                else value
            )
            command += ["-p", f"{name}:={shown}"]
        output = self._folder / f"{executable}_{len(self._processes)}.txt"
        process = Process([*command, *arguments], self.environment, output)
        self._processes.append(process)
        return process

    def launch(self, file: Path, **arguments: str) -> Process:
        """Start a launch file as ``ros2 launch`` does, which is there where ROS came from apt."""
        command = ["ros2", "launch", str(file), *(f"{name}:={value}" for name, value in arguments.items())]
        output = self._folder / f"{file.name}_{len(self._processes)}.txt"
        process = Process(command, self.environment, output)
        self._processes.append(process)
        return process

    def until(self, condition: Callable[[], object], seconds: float = PATIENCE) -> bool:
        """Take messages until the condition holds; False where it does not in time, or a process failed."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.02)
        return True

    def output(self) -> str:
        """Return what all processes have written, for the message of a failed assertion."""
        return "\n".join(one.text for one in self._processes)

    # --- topics ---------------------------------------------------------------------------------

    def collect(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> Collected:
        """Subscribe, and return what will come; relative topics are those of the namespace."""
        name = topic if topic.startswith("/") else f"{self.namespace}/{topic}"
        collected = Collected(name)

        def matched(event: Any) -> None:
            collected.matched = event.current_count

        self.node.create_subscription(
            kind,
            name,
            collected.messages.append,
            qos,
            event_callbacks=SubscriptionEventCallbacks(matched=matched),
        )
        return collected

    def publisher(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> Any:
        """Return a publisher; wait for its subscribers with `until`."""
        return self.node.create_publisher(kind, f"{self.namespace}/{topic}", qos)

    def published_by(self, node: str) -> dict[str, str]:
        """Return the topics that a node publishes, as discovered so far, with their types."""
        return self._offered(self.node.get_publisher_names_and_types_by_node, node)

    def served_by(self, node: str) -> dict[str, str]:
        """Return the services that a node offers, as discovered so far, with their types."""
        return self._offered(self.node.get_service_names_and_types_by_node, node)

    def _offered(self, query: Callable[[str, str], list[tuple[str, list[str]]]], node: str) -> dict[str, str]:
        try:
            return {name: kinds[0] for name, kinds in query(node, self.namespace)}
        except NodeNameNonExistentError:  # messages of a node can arrive before its name is discovered
            return {}

    # --- parameters -----------------------------------------------------------------------------

    def set(self, node: str, **values: Any) -> str:
        """Set parameters of a node at once; return the reason of a rejection, or ''."""
        client = self._client(node)
        future = client.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()]
        )
        assert self.until(future.done), f"{node} does not answer\n{self.output()}"
        result = future.result().result
        assert result.successful == (not result.reason)
        return str(result.reason)

    def get(self, node: str, *names: str) -> list[Any]:
        """Return the values of parameters of a node."""
        future = self._client(node).get_parameters(list(names))
        assert self.until(future.done), f"{node} does not answer\n{self.output()}"
        return [rclpy.parameter.parameter_value_to_python(one) for one in future.result().values]

    def describe(self, node: str) -> dict[str, Any]:
        """Return the descriptors of all parameters of a node."""
        client = self._client(node)
        names = client.list_parameters()
        assert self.until(names.done), f"{node} does not answer\n{self.output()}"
        found = client.describe_parameters(list(names.result().result.names))
        assert self.until(found.done), f"{node} does not answer\n{self.output()}"
        return {one.name: one for one in found.result().descriptors}

    # --- services -------------------------------------------------------------------------------

    def call(self, kind: Any, name: str, seconds: float = PATIENCE, *, node: str = "", **fields: Any) -> Any:
        """Call a service, ``driver/get_state`` say, and return its response.

        ``node`` offers it; by default that is the first part of its name.
        """
        client = self.node.create_client(kind, f"{self.namespace}/{name}")
        assert self.until(client.service_is_ready), f"no service {name}\n{self.output()}"
        self._introduce(node or name.partition("/")[0])
        future = client.call_async(kind.Request(**fields))
        assert self.until(future.done, seconds), f"{name} does not answer\n{self.output()}"
        self.node.destroy_client(client)
        return future.result()

    def transition(self, node: str, label: str) -> bool:
        """Ask a node for a transition of its lifecycle; whether it was made."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        ids = {
            "configure": Transition.TRANSITION_CONFIGURE,
            "activate": Transition.TRANSITION_ACTIVATE,
            "deactivate": Transition.TRANSITION_DEACTIVATE,
            "cleanup": Transition.TRANSITION_CLEANUP,
            "shutdown from active": Transition.TRANSITION_ACTIVE_SHUTDOWN,
            "nonsense": 77,
        }
        return bool(
            self.call(ChangeState, f"{node}/change_state", transition=Transition(id=ids[label])).success
        )

    def state(self, node: str) -> str:
        """Return the lifecycle state of a node."""
        from lifecycle_msgs.srv import GetState

        return str(self.call(GetState, f"{node}/get_state").current_state.label)

    def diagnostics(self) -> Diagnosed:
        """Return the last status of each check, as they come."""
        from diagnostic_msgs.msg import DiagnosticArray

        return Diagnosed(self.collect(DiagnosticArray, "/diagnostics"))

    def _client(self, node: str) -> AsyncParameterClient:
        # one for each node: a node remembers every client that it has ever met, and each has six services
        client = self._clients.get(node)
        if client is None:
            client = self._clients[node] = AsyncParameterClient(self.node, f"{self.namespace}/{node}")
            assert self.until(client.services_are_ready), f"no node {node}\n{self.output()}"
            self._introduce(node)
        return client

    def _introduce(self, node: str) -> None:
        """Wait until a node knows every client that was made so far.

        A client sees a service before the service sees the client, and rmw_fastrtps drops a response whose
        client is not discovered within 100 ms. Clients are discovered in the order in which they were made:
        where one is answered, those before it are known. Its request may be repeated, others may not.
        """
        client = self.node.create_client(GetParameters, f"{self.namespace}/{node}/get_parameters")
        assert self.until(client.service_is_ready), f"no node {node}\n{self.output()}"
        end = time.monotonic() + PATIENCE
        while not self.until(client.call_async(GetParameters.Request()).done, 2.0):
            assert time.monotonic() < end, f"{node} does not answer\n{self.output()}"
        self.node.destroy_client(client)


class Chain:
    """A driver and a correction from which nothing is lost: all frames, and what became of them.

    ``driver`` and ``correction`` are the nodes' parameters. The driver ends after its last frame. With
    ``together`` both are in one process, with the parameters of both.
    """

    def __init__(
        self,
        world: World,
        *,
        driver: dict[str, Any],
        correction: dict[str, Any],
        together: bool = False,
    ) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import Image, PointCloud2, Range, Temperature

        self._world = world
        ends = {"exit_at_end": True, "wait_for_subscribers": 3}
        given = {**LOSSLESS_DRIVER, **ends, **driver}
        if together:
            self.driver = self.correction = world.start(
                "camera_node", **{**LOSSLESS_CORRECTION, **given, **correction}
            )
        else:
            self.correction = world.start("correction_node", **{**LOSSLESS_CORRECTION, **correction})
        self.points = world.collect(PointCloud2, "points")
        self.sigma = world.collect(Image, "sigma/image")
        self.flags = world.collect(Image, "flags/image")
        corrected = (self.points, self.sigma, self.flags)
        assert world.until(lambda: all(one.matched for one in corrected)), world.output()
        self._readings = {
            "body_temperature": world.collect(Temperature, "temperature"),
            "ambient_temperature": world.collect(Temperature, "ambient_temperature"),
            "reference_distance": world.collect(Range, "reference"),
        }
        self.frame_info = world.collect(DiagnosticArray, "frame_info")
        self.amplitude = world.collect(Image, "amplitude/image_raw")
        self.distance = world.collect(Image, "distance/image_raw")
        if not together:
            self.driver = world.start("driver_node", **given)
        # A publisher knows of a subscriber before that subscriber knows of it, and frames in between are
        # lost. The third subscriber, for which the driver waits, comes when the others know.
        raw = (self.frame_info, self.amplitude, self.distance)
        if world.until(lambda: all(one.matched for one in raw) or not self.driver.running):
            kinds = (DiagnosticArray, Image, Image)
            self._start = [
                world.collect(kind, one.topic, START) for kind, one in zip(kinds, raw, strict=True)
            ]

    def finish(self, seconds: float = 120.0) -> None:
        """Wait until the driver has ended and all that it published has come back corrected."""
        world = self._world
        assert world.until(lambda: not self.driver.running, seconds), world.output()
        assert self.driver.wait() == 0, world.output()
        assert world.until(lambda: len(self.flags) >= len(self.distance) > 0), (
            f"{len(self.distance)} frames, {len(self.flags)} corrected\n{world.output()}"
        )

    def raw_frames(self) -> list[RawFrame]:
        """Return the raw frames as the messages hold them, those with all their parts."""
        infos, amplitudes = self.frame_info.by_stamp(), self.amplitude.by_stamp()
        readings = {name: one.by_stamp() for name, one in self._readings.items()}
        frames = []
        for message in self.distance:
            stamp = stamp_of(message)
            settings, device = settings_from(infos[stamp])
            values: dict[str, float | None] = {}
            for name, by_stamp in readings.items():
                read = range_from if name == "reference_distance" else temperature_from
                values[name] = read(by_stamp[stamp]) if stamp in by_stamp else None
            frames.append(
                RawFrame(
                    stamp=stamp,
                    distance=image_array(message),
                    amplitude=image_array(amplitudes[stamp]),
                    settings=Settings(
                        integration_time=settings.integration_time,
                        modulation_frequency=settings.modulation_frequency,
                        uptime=settings.uptime,
                        **values,
                        extra=settings.extra,
                    ),
                    device=device,
                )
            )
        return frames

    def clouds(self) -> dict[int, np.ndarray[Any, np.dtype[np.float32]]]:
        """Return the clouds (H, W, 4) by stamp in ns."""
        return {stamp: points_array(one) for stamp, one in self.points.by_stamp().items()}
