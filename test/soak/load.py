"""One process for long, and clouds under a processor that is full: what is lost, and how old clouds are."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil

from test.ros.harness import World
from test.soak.faults import Figures, summary
from test.soak.watch import Listener, descriptors, resident

#: The diagnostics whose counts are compared, with those that are.
COUNTS = {
    "/camera/driver: frames": ("frames", "skipped", "not_published"),
    "/camera/correction: frames": ("frames", "dropped_frames", "refused_messages", "not corrected"),
}


@contextlib.contextmanager
def ahead() -> Iterator[int]:
    """Put this process, whose threads are made within, before others, where the system allows it.

    Yields the niceness that it had, which it has again afterwards.
    """
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, before - 10)
    try:
        yield before
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


@contextlib.contextmanager
def busy(count: int, *, niceness: int | None = None) -> Iterator[None]:
    """Keep so many processes busy, at this process' priority or another."""
    made = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        for one in made:
            if niceness is not None:
                psutil.Process(one.pid).nice(niceness)
        yield
    finally:
        for one in made:
            one.kill()
            one.wait()


def load_between(values: list[float]) -> dict[str, float]:
    """Return least, mean and greatest of the load averages that were seen."""
    return {"least": min(values), "mean": float(np.mean(values)), "most": max(values)}


def endurance(folder: Path, *, seconds: float, rate: float = 50.0) -> Figures:
    """Driver and correction in one process at ``rate`` [Hz].

    Counts of the nodes' own diagnostics over the time: ``dropped_frames`` is what the correction dropped,
    ``skipped`` what the simulated camera did not make for lack of processor. Latency (stamp to listener)
    [ms], memory [MB] and processor time [ms] for each frame by quarters of the time.
    """
    with World(folder) as world:
        process = world.start("camera_node", scene="wall", frame_rate=rate)
        listener = Listener(world, raw=False, keep=1.0)
        said = world.diagnostics()
        assert world.until(lambda: listener.points_count > rate), world.output()
        said.clear()
        assert world.until(lambda: all(said.values(one) for one in COUNTS))
        before = {name: said.values(name) for name in COUNTS}
        listener.latency.clear()
        count, opened = listener.points_count, descriptors(process.pid)
        seen: list[tuple[float, float, float]] = []
        begun = time.monotonic()
        while (now := time.monotonic() - begun) < seconds:
            used = psutil.Process(process.pid).cpu_times()
            seen.append((resident(process.pid), used.user + used.system, os.getloadavg()[0]))
            said.clear()
            listener.arrived.clear()
            world.until(lambda: False, min(1.0, seconds - now))
        said.clear()
        assert world.until(lambda: all(said.values(one) for one in COUNTS)), world.output()[-3000:]
        grown = {
            name: {key: int(said.values(name)[key]) - int(before[name].get(key, 0)) for key in keys}
            for name, keys in COUNTS.items()
        }
        late = np.array_split(np.array([one for _, one in listener.latency]) * 1e3, 4)
        memory, used_s, loads = (list(one) for one in zip(*seen, strict=True))
        steps = np.array_split(np.array(used_s), 4)
        return {
            "seconds": time.monotonic() - begun,
            "counts": grown,
            "seen": listener.points_count - count,
            "median_ms": [float(np.median(one)) for one in late],
            "p99_ms": [float(np.percentile(one, 99)) for one in late],
            "worst_ms": [float(one.max()) for one in late],
            "memory_mb": [float(np.mean(one)) for one in np.array_split(np.array(memory), 4)],
            "cpu_cores": [float((one[-1] - one[0]) / max(len(one) - 1, 1)) for one in steps],
            "descriptors": [opened, descriptors(process.pid)],
            "load": load_between(loads),
            "tracebacks": process.text.count("Traceback"),
        }


def latency(folder: Path, *, seconds: float, rate: float = 25.0) -> Figures:
    """From the stamp of a frame of the room to its cloud at a listener [ms], in one process and in two."""
    figures: Figures = {}
    for name, nodes in (("one process", ("camera_node",)), ("two", ("driver_node", "correction_node"))):
        with World(folder) as world:
            for node in nodes:
                options = {} if node == "correction_node" else {"scene": "room", "frame_rate": rate}
                world.start(node, **options)
            listener = Listener(world, raw=False, keep=1.0)
            assert world.until(lambda own=listener: own.points_count > 4 * rate), world.output()
            listener.latency.clear()
            world.until(lambda: False, seconds)
            late = np.array([one for _, one in listener.latency]) * 1e3
            figures[name] = summary(late.tolist())
    return figures


def overload(folder: Path, *, seconds: float, maximum_age: float | None = 0.1, processes: int = 6) -> Figures:
    """Driver and correction at 25 Hz while processes are always busy: ages of the clouds [ms].

    The processes come and go: five seconds each. ``older``: clouds that arrive later than ``maximum_age`` [s]
    after their stamp (None: the node's default, which compares stamps with the newest only, so that none
    counts); this listener has a higher priority than the nodes where the system allows it.
    """
    limit = {} if maximum_age is None else {"maximum_age": maximum_age}
    with ahead() as niceness, World(folder) as world:
        nodes = [
            world.start("driver_node", scene="wall", frame_rate=25.0),
            world.start("correction_node", **limit),
        ]
        for one in nodes:
            psutil.Process(one.pid).nice(niceness)
        listener = Listener(world, keep=1.0)
        said = world.diagnostics()
        assert world.until(lambda: listener.points_count > 25), world.output()
        listener.latency.clear()
        begun = time.monotonic()
        loads = []
        while time.monotonic() - begun < seconds:
            for count in (processes, 0):
                with busy(count, niceness=niceness):
                    world.until(lambda: False, 5.0)
                loads.append(os.getloadavg()[0])
        name = "/camera/correction: frames"
        said.clear()
        assert world.until(lambda: said.values(name)), world.output()[-3000:]
        late = np.array([one for _, one in listener.latency])
        return {
            "clouds": len(late),
            "older": 0 if maximum_age is None else int((late > maximum_age).sum()),
            "age_ms": summary([1e3 * one for one in late]),
            "frames": {key: said.values(name)[key] for key in COUNTS[name]},
            "dropped": {
                key: value for key, value in said.values(name).items() if key.startswith("dropped: ")
            },
            "running": all(one.running for one in nodes),
            "tracebacks": world.output().count("Traceback"),
            "load": load_between(loads),
        }
