"""The faults: kills, hostile messages, reconfiguration, slow and many readers, clock jumps, full disks."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import Image, PointCloud2, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera
from test.devices.conftest import SOURCE
from test.devices.standin import CONTROL_VARIABLE, Control
from test.helpers_bags import STEP, exposure, stamp_at, write_bag
from test.ros.harness import (
    BEST_EFFORT,
    LOSSLESS_CORRECTION,
    LOSSLESS_DRIVER,
    RELIABLE,
    Process,
    World,
    stamp_of,
)
from test.soak.watch import Listener, descriptors, resident

Figures = dict[str, Any]


def stand_in(folder: Path) -> str:
    """Compile the stand-in of the vendor's library; '' without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return ""
    built = folder / "libmesasr.so"
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", str(built), str(SOURCE)], check=True)
    return str(built)


def kills(folder: Path, *, count: int, seed: int = 1) -> Figures:
    """Kill driver, correction or acquisition process at random; a killed node is started anew at once.

    ``back_s``: from then until points come (of a frame that was taken after it); ``up_s``: until the node
    says that it works, what follows is the middleware's. ``stale``: clouds that came after it of frames older
    than 0.5 s before it. ``wrong``: clouds that are not those of their raw frame.
    """
    rng = random.Random(seed)
    library = stand_in(folder)
    figures: Figures = {"kills": 0, "back_s": [], "up_s": []}
    figures |= {"stale": 0, "backwards": 0, "paired": 0, "wrong": 0}
    with World(folder) as world:
        parameters: dict[str, Any] = {"frame_rate": 25.0}
        if library:
            control = Control(folder)
            world.environment[CONTROL_VARIABLE] = str(control.path)
            # without pyusb nobody looks for a camera on the bus
            (folder / "usb.py").write_text("raise ImportError\n")
            world.environment["PYTHONPATH"] = str(folder)
            parameters |= {"source": "sr3000", "library": library, "integration_time": 100}
        else:
            parameters |= {"scene": "wall"}
        listener = Listener(world, keep=1.0)
        starts = {"driver": ("driver_node", parameters), "correction": ("correction_node", {})}
        nodes = {name: world.start(node, **given) for name, (node, given) in starts.items()}
        assert world.until(lambda: listener.points_count > 5), world.output()
        for _ in range(count):
            victim = rng.choice(["driver", "correction", "acquisition"] if library else list(nodes))
            world.until(lambda: False, rng.uniform(0.0, 0.3))
            # what waits in this listener's own queue is not what a node publishes late
            assert world.until(lambda: time.time() - max(listener.points) / 1e9 < 0.2), world.output()[-3000:]
            if victim == "acquisition":
                children = psutil.Process(nodes["driver"].pid).children(recursive=True)
                if not children:
                    continue
                begun = time.time()
                children[-1].send_signal(signal.SIGKILL)
            else:
                nodes[victim].kill()
                begun = time.time()
                nodes[victim] = world.start(starts[victim][0], **starts[victim][1])
            figures["kills"] += 1
            newest = max(listener.points)

            def back(begun: float = begun, newest: int = newest) -> bool:
                return max(listener.points) > max(newest, int(begun * 1e9))

            if victim != "acquisition":
                working = {"driver": "publishing ", "correction": "correcting "}[victim]
                assert world.until(lambda: working in nodes[victim].text), nodes[victim].text  # noqa: B023
                figures["up_s"].append((victim, time.time() - begun))
            assert world.until(back), f"{victim} did not come back\n{world.output()[-3000:]}"
            figures["back_s"].append((victim, time.time() - begun))
            figures["stale"] += sum(
                at > begun and stamp / 1e9 < begun - 0.5 for stamp, at in listener.arrived.items()
            )
            world.until(lambda: False, 0.3)
            paired, wrong = listener.wrong_pairs()
            figures["paired"] += paired
            figures["wrong"] += wrong
        figures["summary_s"] = {
            f"{victim} {what}": summary([s for one, s in figures[what] if one == victim])
            for what in ("back_s", "up_s")
            for victim in ("driver", "correction", "acquisition")
        }
        figures["load"] = os.getloadavg()
        figures["backwards"] = listener.backwards
        figures["tracebacks"] = world.output().count("Traceback")
    return figures


def summary(values: list[float]) -> dict[str, float]:
    """Return number, median, 99th percentile and greatest of some values."""
    if not values:
        return {"count": 0}
    median, p99 = np.percentile(values, (50, 99))
    return {"count": len(values), "median": float(median), "p99": float(p99), "worst": max(values)}


class Sender:
    """Publishes raw frames, good and hostile ones."""

    def __init__(self, world: World) -> None:
        self._of = {
            "frame_info": world.publisher(DiagnosticArray, "frame_info", RELIABLE),
            "amplitude": world.publisher(Image, "amplitude/image_raw", RELIABLE),
            "distance": world.publisher(Image, "distance/image_raw", RELIABLE),
        }
        self._temperature = world.publisher(Temperature, "ambient_temperature", RELIABLE)

    @property
    def ready(self) -> bool:
        return all(one.get_subscription_count() > 0 for one in self._of.values())

    def good(self, stamp: int) -> None:
        """Publish a frame at a stamp in ns."""
        head = header(stamp)
        info = DiagnosticStatus(values=[KeyValue(key="integration_time", value="100")])
        self._of["frame_info"].publish(DiagnosticArray(header=head, status=[info]))
        self._of["amplitude"].publish(whole(head))
        self._of["distance"].publish(whole(head))

    def hostile(self, rng: random.Random, stamp: int) -> None:
        """Publish one message of which nothing good can come."""
        head = header(rng.choice([stamp, 0, 2**31 * 10**9 - 1, stamp + 3600 * 10**9, stamp - 3600 * 10**9]))
        kind = rng.randrange(10)
        role = rng.choice(["distance", "amplitude"])
        if kind == 0:
            self._of[role].publish(
                Image(header=head, height=2, width=2, encoding="16UC1", step=4, data=bytes(8))
            )
        elif kind == 1:
            self._of[role].publish(
                Image(header=head, height=2**31, width=2**31, encoding="16UC1", step=2**32 - 1, data=b"x")
            )
        elif kind == 2:
            self._of[role].publish(
                Image(header=head, height=144, width=176, encoding="\udce9rgb8"[1:], step=352)
            )
        elif kind == 3:
            self._of[role].publish(
                Image(header=head, height=144, width=176, encoding="16UC1", step=1, data=b"ab")
            )
        elif kind == 4:
            nan = np.full((144, 176), np.nan, np.float32).tobytes()
            self._of[role].publish(
                Image(
                    header=head,
                    height=144,
                    width=176,
                    encoding="32FC1",
                    step=704,
                    data=nan[: rng.randrange(400)],
                )
            )
        elif kind == 5:
            value = rng.choice(["", "nan", "-1", "inf", "1e400", "x" * 5000])
            status = DiagnosticStatus(values=[KeyValue(key="integration_time", value=value)])
            self._of["frame_info"].publish(DiagnosticArray(header=head, status=[status]))
        elif kind == 6:
            self._of["frame_info"].publish(DiagnosticArray(header=head, status=[]))
        elif kind == 7:
            late = header(0)
            late.stamp.sec = -5
            self._of[role].publish(Image(header=late, height=0, width=0, encoding="16UC1"))
        elif kind == 8:
            late = header(stamp + 10**12)
            self._temperature.publish(
                Temperature(header=late, temperature=rng.choice([float("nan"), 1e300, 20.0]))
            )
        else:
            self._of[role].publish(whole(head))  # without a partner


def header(stamp: int) -> Header:
    head = Header(frame_id="optical")
    head.stamp.sec, head.stamp.nanosec = divmod(max(stamp, 0), 10**9)
    return head


_PIXELS = np.full((144, 176), 10240, np.uint16).tobytes()


def whole(head: Header) -> Image:
    from array import array

    data = array("B")
    data.frombytes(_PIXELS)
    return Image(header=head, height=144, width=176, encoding="16UC1", step=352, data=data)


def hostile(folder: Path, *, seconds: float, rate: float = 1000.0, seed: int = 2) -> Figures:
    """Flood the correction with hostile messages between good frames at 10 Hz."""
    rng = random.Random(seed)
    with World(folder) as world:
        correction = world.start("correction_node", **{"qos.input": "reliable"})
        listener = Listener(world, raw=False, keep=1e9)
        listener.points.clear()
        said = world.diagnostics()
        sender = Sender(world)
        assert world.until(lambda: sender.ready), world.output()
        good: list[int] = []
        sent = 0
        first = _settled(world, sender, listener)
        memory = [resident(correction.pid)]
        begun = time.monotonic()
        while (now := time.monotonic() - begun) < seconds:
            stamp = time.time_ns()
            if len(good) < now * 10:
                good.append(stamp)
                sender.good(stamp)
            while sent < now * rate and time.monotonic() - begun - now < 0.02:
                sender.hostile(rng, stamp + 1 + sent % 1000)
                sent += 1
            world.until(lambda: True)
            world._executor.spin_once(timeout_sec=0)
            if now > len(memory) * max(seconds / 20, 1.0):
                memory.append(resident(correction.pid))
        assert world.until(lambda: good[-1] in listener.arrived, 20), world.output()[-3000:]
        world.until(lambda: False, 2.0)
        values = said.values("/camera/correction: frames")
        return {
            "good": len(good),
            "good_corrected": sum(stamp in listener.arrived for stamp in good),
            "hostile": sent,
            "hostile_per_s": sent / seconds,
            "refused": int(values["refused_messages"]),
            "dropped": int(values["dropped_frames"]),
            "memory_mb": [memory[0], max(memory[len(memory) // 4 :]), memory[-1]],
            "running": correction.running,
            "tracebacks": correction.text.count("Traceback"),
            "log_lines": len(correction.text.splitlines()),
            "first": first,
        }


def _settled(world: World, sender: Sender, listener: Listener) -> int:
    """Send good frames until one comes back corrected."""
    for _ in range(200):
        stamp = time.time_ns()
        sender.good(stamp)
        if world.until(lambda: listener.arrived, 0.1):
            return stamp
    raise AssertionError(world.output())


def reconfiguration(folder: Path, *, seconds: float, rate: float = 50.0, seed: int = 3) -> Figures:
    """Change a parameter every second while frames flow at ``rate``; latencies [ms] by quarters of the time.

    A frame counts as lost by a node where the correction left it out or did not correct it, or the driver did
    not publish or skipped it; frames that the middleware lost on the way to this listener are ``unseen``.
    """
    rng = random.Random(seed)
    shipped = find_camera("sr3000")
    for file in shipped.parent.glob("sr3000*"):
        if file.is_file():
            (folder / file.name).write_bytes(file.read_bytes())
    with World(folder) as world:
        # reliable between the two nodes: what is lost then was lost by a node, not on the way
        driver = world.start(
            "driver_node", scene="wall", frame_rate=rate, **{"qos.images": "reliable", "qos.info": "reliable"}
        )
        correction = world.start("correction_node", folders=str(folder), **{"qos.input": "reliable"})
        listener = Listener(world, raw=False, keep=2.0)
        said = world.diagnostics()
        assert world.until(lambda: listener.points_count > rate), world.output()
        names = ("/camera/driver: frames", "/camera/correction: frames")
        assert world.until(lambda: all(said.values(one) for one in names))
        listener.latency.clear()
        before = [said.values(one) for one in names]
        count = listener.points_count
        memory = []
        opened = [descriptors(driver.pid), descriptors(correction.pid)]
        changes = refused = 0
        begun = time.monotonic()
        while time.monotonic() - begun < seconds:
            node, values = rng.choice(
                [
                    ("driver", {"integration_time": rng.choice([16.0, 60.0, 100.0, 80.0])}),
                    ("driver", {"frame_id": rng.choice(["camera_optical_frame", "other_frame"])}),
                    ("correction", {"minimum_amplitude": rng.choice([-1.0, 100.0, 500.0])}),
                    ("correction", {"effects.scattering": rng.random() < 0.5}),
                    ("correction", {"camera": rng.choice(["sr3000", str(folder / "sr3000.yaml")])}),
                    ("correction", {"camera": "nonsense"}),
                ]
            )
            changes += 1
            refused += bool(world.set(node, **values))
            memory.append((resident(driver.pid), resident(correction.pid)))
            said.clear() if len(said.of(names[0])) > 20 else None
            world.until(lambda: False, max(0.0, changes - (time.monotonic() - begun)))
        elapsed = time.monotonic() - begun
        said.clear()
        assert world.until(lambda: all(said.values(one) for one in names))
        after = [said.values(one) for one in names]
        grown = [
            {key: int(new[key]) - int(old.get(key, 0)) for key in keys if key in new}
            for old, new, keys in (
                (before[0], after[0], ("frames", "skipped", "not_published")),
                (before[1], after[1], ("frames", "dropped_frames", "refused_messages", "not corrected")),
            )
        ]
        late = np.array([one for _, one in listener.latency]) * 1e3
        quarters = np.array_split(late, 4)
        return {
            "seconds": elapsed,
            "changes": changes,
            "refused": refused,
            "driver": grown[0],
            "correction": grown[1],
            "seen": listener.points_count - count,
            "median_ms": [float(np.median(one)) for one in quarters],
            "p99_ms": [float(np.percentile(one, 99)) for one in quarters],
            "worst_ms": [float(one.max()) for one in quarters],
            "memory_mb": {
                name: [float(np.mean(part)) for part in np.array_split(np.array(memory)[:, i], 4)]
                for i, name in enumerate(("driver", "correction"))
            },
            "descriptors": [opened, [descriptors(driver.pid), descriptors(correction.pid)]],
            "load": os.getloadavg(),
            "tracebacks": world.output().count("Traceback"),
        }


def playback(folder: Path, *, minutes: float, rate: float = 10.0) -> Figures:
    """Play so many minutes of a recording at 5 Hz back, ``rate`` times faster, with simulated time.

    ``missing``: recorded frames, from the first that came, without a cloud of their stamp; ``others``: clouds
    of a stamp that was not recorded. Memory by quarters of the time.
    """
    every = 5  # steps of helpers_bags: 0.2 s
    count = int(minutes * 60e9 / (every * STEP))
    bag = write_bag(folder / "day", (one for i in range(count) for one in exposure(every * i, (144, 176))))
    recorded = [stamp_at(every * i) for i in range(count)]
    stamps: list[int] = []
    with World(folder) as world:
        correction = world.start("correction_node", use_sim_time=True, **LOSSLESS_CORRECTION)
        world.node.create_subscription(
            PointCloud2, f"{world.namespace}/points", lambda one: stamps.append(stamp_of(one)), RELIABLE
        )
        assert world.until(lambda: world.node.count_publishers(f"{world.namespace}/points") == 1)
        world.until(lambda: False, 1.0)
        driver = world.start(
            "driver_node",
            use_sim_time=True,
            source="playback",
            recording=str(bag),
            playback_rate=rate,
            loop=False,
            stamps="recorded",
            publish_clock=True,
            wait_for_subscribers=1,
            **LOSSLESS_DRIVER,
        )
        assert world.until(lambda: stamps), world.output()
        begun = time.monotonic()
        memory = []
        while "is at its end" not in driver.text:
            world.until(lambda: False, 1.0)
            memory.append((resident(driver.pid), resident(correction.pid)))
            assert time.monotonic() - begun < 120 * minutes / rate + 60, world.output()[-3000:]
        took = time.monotonic() - begun
        world.until(lambda: stamps[-1] == recorded[-1], 5.0)
        return {
            "frames": count,
            "seconds": took,
            "clouds": len(stamps),
            "missing": len(set(recorded[recorded.index(stamps[0]) :]) - set(stamps)),
            "others": len(set(stamps) - set(recorded)),
            "before_first": recorded.index(stamps[0]),
            "in_order": stamps == sorted(stamps),
            "memory_mb": {
                name: [float(np.mean(part)) for part in np.array_split(np.array(memory)[:, i], 4)]
                for i, name in enumerate(("driver", "correction"))
            },
            "descriptors": [descriptors(driver.pid), descriptors(correction.pid)],
            "tracebacks": world.output().count("Traceback"),
            "load": os.getloadavg(),
        }


_READERS = """
import sys, rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2
rclpy.init()
node = rclpy.create_node("readers")
best = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
for i in range(int(sys.argv[1])):
    kind, topic = ((Image, "distance/image_raw"), (PointCloud2, "points"))[i % 2]
    node.create_subscription(kind, "/camera/" + topic, lambda message: None, best)
print("ready", flush=True)
rclpy.spin(node)
"""


def readers(folder: Path, *, seconds: float, count: int = 20) -> Figures:
    """20 subscribers in addition to this one, then one process of them that is stopped and reads no more."""
    with World(folder) as world:
        nodes = [world.start("driver_node", scene="wall", frame_rate=25.0), world.start("correction_node")]
        listener = Listener(world, raw=False)
        assert world.until(lambda: listener.points_count > 10), world.output()
        figures: Figures = {"alone_hz": _rate(world, listener, seconds)}
        made = Process(
            [sys.executable, "-c", _READERS, str(count)], world.environment, folder / "readers.txt"
        )
        try:
            assert world.until(lambda: "ready" in made.text), made.text
            world.until(lambda: False, 2.0)
            figures["with_readers_hz"] = _rate(world, listener, seconds)
            figures["memory_mb"] = [sum(resident(one.pid) for one in nodes)]
            for process in (psutil.Process(made.pid), *psutil.Process(made.pid).children(recursive=True)):
                process.suspend()
            figures["never_reading_hz"] = _rate(world, listener, seconds)
            figures["memory_mb"].append(sum(resident(one.pid) for one in nodes))
        finally:
            os.killpg(made.pid, signal.SIGKILL)
            made.wait()
        figures["running"] = all(one.running for one in nodes)
    return figures


def _rate(world: World, listener: Listener, seconds: float) -> float:
    before, begun = listener.points_count, time.monotonic()
    world.until(lambda: False, seconds)
    return (listener.points_count - before) / (time.monotonic() - begun)


def clock_jumps(folder: Path, *, frames: int = 20) -> Figures:
    """Stamps that jump by an hour back and forth, as those of a driver whose clock is set."""
    with World(folder) as world:
        correction = world.start("correction_node", **{"qos.input": "reliable"})
        listener = Listener(world, raw=False, keep=1e9)
        said = world.diagnostics()
        sender = Sender(world)
        assert world.until(lambda: sender.ready), world.output()
        _settled(world, sender, listener)
        sent: list[int] = []
        for jump in (0, 3600, 0, -3600, 0):
            for _ in range(frames):
                sent.append(time.time_ns() + jump * 10**9)
                sender.good(sent[-1])
                assert world.until(lambda: sent[-1] in listener.arrived, 5.0), world.output()
        assert world.until(lambda: int(said.values("/camera/correction: frames").get("stamp_jumps", 0)) >= 4)
        return {
            "frames": len(sent),
            "corrected": sum(one in listener.arrived for one in sent),
            "jumps_counted": int(said.values("/camera/correction: frames")["stamp_jumps"]),
            "tracebacks": correction.text.count("Traceback"),
        }


def full_disk(folder: Path) -> Figures:
    """Files that may not grow (as on a full disk) and a folder that cannot be written."""
    files = folder / "files"
    with World(folder) as world:
        correction = world.start("correction_node", folders=str(files))
        assert world.set("correction", save_as="kept") == ""
        assert world.call(Trigger, "correction/save_camera").success
        kept = (files / "kept.yaml").read_bytes()
        assert world.set("correction", minimum_amplitude=321.0) == ""
        limits = resource.prlimit(correction.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(correction.pid, resource.RLIMIT_FSIZE, (1000, limits[1]))
        full = world.call(Trigger, "correction/save_camera")
        whole_still = (files / "kept.yaml").read_bytes() == kept
        left_over = sorted(one.name for one in files.iterdir() if one.suffix not in (".yaml", ".npy"))
        resource.prlimit(correction.pid, resource.RLIMIT_FSIZE, limits)
        again = world.call(Trigger, "correction/save_camera")
        figures: Figures = {
            "refused": not full.success,
            "message": full.message,
            "file_whole": whole_still,
            "left_over": left_over,
            "written_later": again.success and load_camera(files / "kept_2.yaml").minimum_amplitude == 321.0,
            "running": correction.running,
        }
    with World(folder) as world:
        world.start("correction_node", folders="/proc/rim_camera")
        answer = world.call(Trigger, "correction/save_camera")
        figures["read_only"] = (not answer.success, answer.message)
    return figures


__all__ = [
    "BEST_EFFORT",
    "clock_jumps",
    "full_disk",
    "hostile",
    "kills",
    "playback",
    "readers",
    "reconfiguration",
]
