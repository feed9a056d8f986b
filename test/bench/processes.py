"""``python -m test.bench.processes``: processor time of one process against a process for each node.

A camera is played back from a recording that is made first, so that the driver's own work is small, as it
is with a camera on USB. This process listens to ``points``, and its own time does not count. The two ways are
measured in turn (A B A B ...). Printed is the CPU time of all processes of a way for each cloud
that came, the ratio of the two in each round, the share of a core that the separate correction takes, the
frames that came, and what else the machine did meanwhile. Status 1 where a figure is beyond its limit.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import psutil
from sensor_msgs.msg import PointCloud2

from rim_camera_ros.bags.writer import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import save_camera_apart
from rim_camera_ros.frame import NANOSECONDS
from test.bench import cases
from test.ros.harness import BEST_EFFORT, World

#: Frames of the recording, which is repeated: so many, of which so many differ.
FRAMES, DIFFERENT = 100, 5
#: Clouds that come before the measurement begins: discovery and tables are over then.
BEFORE = 20
#: Most CPU time of one process over that of two, by size and rate, and most of a core that the separate
#: correction may take.
MOST_TOGETHER = {("176x144", 25.0): 0.6}
MOST_OF_A_CORE = {("640x480", 30.0): 0.2}


@dataclass(frozen=True)
class Measured:
    """CPU time for each cloud [ms], cores that the correction's process took, clouds a second, and how many
    cores all else kept busy.
    """

    cpu: float
    correction: float
    clouds: float
    others: float


def recorded(folder: Path, camera: Camera, rate: float) -> tuple[Path, Path]:
    """Write a camera file and a recording of the room at a rate [Hz]; return both paths."""
    file, bag = folder / "camera.yaml", folder / "bag"
    save_camera_apart(camera, file)
    simulation, exposure = cases.room(camera)
    frames = [simulation.frame(exposure) for _ in range(DIFFERENT)]
    with RecordingWriter(bag) as writer:
        for i in range(FRAMES):
            stamp = exposure.stamp + round(i * NANOSECONDS / rate)
            writer.write_raw(replace(frames[i % DIFFERENT], stamp=stamp))
    return file, bag


def measured(folder: Path, file: Path, bag: Path, *, together: bool, seconds: float) -> Measured:
    """Start the nodes and measure them for so many seconds."""
    with World(folder) as world:
        clouds = world.collect(PointCloud2, "points", BEST_EFFORT)
        driver = {"source": "playback", "recording": str(bag), "loop": True}
        if together:
            pids = [world.start("camera_node", camera=str(file), **driver).pid]
        else:
            pids = [
                world.start("correction_node", camera=str(file)).pid,
                world.start("driver_node", **driver).pid,
            ]
        if not world.until(lambda: len(clouds) >= BEFORE, 60.0):
            raise SystemExit(f"no clouds come\n{world.output()}")
        processes = [psutil.Process(pid) for pid in pids]
        count, begun = len(clouds), time.monotonic()
        before, all_before = [used(one) for one in processes], busy()
        world.until(lambda: time.monotonic() - begun >= seconds, seconds + 1.0)
        took = time.monotonic() - begun
        each = [used(one) - at for one, at in zip(processes, before, strict=True)]
        cpu, everything = sum(each), busy() - all_before
        came = len(clouds) - count
        return Measured(1e3 * cpu / max(came, 1), each[0] / took, came / took, (everything - cpu) / took)


def used(process: psutil.Process) -> float:
    """Return the CPU seconds that a process has used."""
    times = process.cpu_times()
    return float(times.user + times.system)


def busy() -> float:
    """Return the CPU seconds that all processes of the machine have used, this one among them."""
    times = psutil.cpu_times()
    return float(times.user + times.nice + times.system)


def main() -> int:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rate", type=float, nargs="+", default=[25.0, 30.0, 50.0], help="frames per s [Hz]")
    parser.add_argument("--size", nargs="+", default=["176x144", "640x480"], help="pixels, WIDTHxHEIGHT")
    parser.add_argument(
        "--camera", choices=["sr3000", "plain"], default="plain", help="its effects; sr3000: 176x144 only"
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each measurement [s]")
    parser.add_argument("--rounds", type=int, default=3, help="measurements of each way")
    given = parser.parse_args()
    print(
        f"CPU ms of driver and correction for each cloud, {given.camera}; {given.rounds} rounds of "
        f"{given.seconds:g} s; other: of {psutil.cpu_count()} cores, busy with all else and this listener"
    )
    print(
        f"{'size':>9s} {'Hz':>4s}   separate   together   ratio (of the rounds)       clouds / s     other"
        "   correction, of a core"
    )
    beyond = []
    for size, rate in itertools.product(given.size, given.rate):
        width, height = (int(one) for one in size.split("x"))
        camera = (
            cases.plain(width, height)
            if given.camera == "plain"
            else cases.camera_of("sr3000", width, height)
        )
        camera = replace(camera, covariance=None)  # it names the parameters of every effect
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            file, bag = recorded(folder, camera, rate)
            rounds = [
                [measured(folder, file, bag, together=way, seconds=given.seconds) for way in (False, True)]
                for _ in range(given.rounds)
            ]
        ratios = [together.cpu / separate.cpu for separate, together in rounds]
        middle = [statistics.median(one.cpu for one in way) for way in zip(*rounds, strict=True)]
        clouds = [statistics.median(one.clouds for one in way) for way in zip(*rounds, strict=True)]
        others = [one.others for pair in rounds for one in pair]
        print(
            f"{size:>9s} {rate:4.0f} {middle[0]:10.2f} {middle[1]:10.2f}   {statistics.median(ratios):.2f} "
            f"({' '.join(f'{one:.2f}' for one in ratios)})".ljust(70)
            + f"{clouds[0]:5.1f} {clouds[1]:5.1f}   {min(others):.1f}-{max(others):.1f}"
            + f"   {' '.join(f'{one.correction:.3f}' for one, _ in rounds)}",
            flush=True,
        )
        for what, found, most in (
            ("one process over two", statistics.median(ratios), MOST_TOGETHER.get((size, rate))),
            (
                "correction, of a core",
                statistics.median(separate.correction for separate, _ in rounds),
                MOST_OF_A_CORE.get((size, rate)),
            ),
        ):
            if most is not None and found > most:
                beyond.append(f"{size} at {rate:g} Hz: {what} {found:.2f}, more than {most:g}")
    print("\n".join(beyond))
    return int(bool(beyond))


if __name__ == "__main__":
    sys.exit(main())
