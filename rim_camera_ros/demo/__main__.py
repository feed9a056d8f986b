"""``make demo``: driver, correction, recorder and listener as processes, then the comparison."""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera_file import draw_parameters, load_camera, save_camera
from rim_camera_ros.demo.evaluate import Comparison, Share, compare, effect_shares, recorded_exposure
from rim_camera_ros.demo.picture import draw
from rim_camera_ros.errors import RimError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import CorrectedFrame, RawFrame
from rim_camera_ros.scene import load_scene

SIMULATED = "sr3000_every_effect"
SCENE = "room"
RATE = 25.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; 1 where a process failed."""
    parser = argparse.ArgumentParser(prog="make demo", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("demo_output"), help="folder, replaced (demo_output)"
    )
    parser.add_argument("--frames", type=int, default=150, help="frames to record (150, at 25 Hz)")
    parser.add_argument("--seed", type=int, help="seed of the correction's parameters (default: fresh)")
    given = parser.parse_args(argv)
    seed = given.seed if given.seed is not None else secrets.randbelow(2**31)
    try:
        run(given.out, frames=given.frames, seed=seed)
    except RimError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return 130
    return 0


def run(out: Path, *, frames: int, seed: int) -> None:
    """Simulate, correct and record over DDS, then print the table and write the picture."""
    started = time.monotonic()
    _fresh_folder(out)
    simulated = load_camera(find_camera(SIMULATED))
    scene = load_scene(find_scene(SCENE))
    correcting = draw_parameters(simulated, np.random.default_rng(seed))
    correcting_file = out / "correction_camera.yaml"
    save_camera(correcting, correcting_file, comment=f"{SIMULATED} with parameters drawn, seed {seed}")
    print(
        f"A simulated SR-3000 with every effect on looks at a room ({frames} frames at {RATE:g} Hz).\n"
        f"It is corrected with parameters drawn within their stated sigma (seed {seed}); driver,\n"
        "correction, recorder and listener are four processes over DDS.",
        flush=True,
    )
    recording, live = _record(out, correcting_file, frames=frames, seed=seed)
    comparison = compare(_pairs(recording), simulated, scene)
    with Recording(recording) as bag:
        first = next(iter(bag.frames()))
    shares = effect_shares(
        recorded_exposure(first, scene), simulated=simulated, correcting=correcting, scene=scene
    )
    picture = out / "demo.png"
    draw(comparison, picture)
    _print_table(comparison, shares, live)
    print(f"\nrecording       {recording}\npicture         {picture.resolve()}")
    print(f"all of it took  {time.monotonic() - started:.0f} s")


def _fresh_folder(out: Path) -> None:
    if out.exists():
        if any(out.iterdir()) and not (out / "correction_camera.yaml").exists():
            raise RimError("exists and is not from an earlier demo", file=out, remedy="give another --out")
        shutil.rmtree(out)
    out.mkdir(parents=True)


def _record(out: Path, camera: Path, *, frames: int, seed: int) -> tuple[Path, dict[str, Any]]:
    """Run the processes; return the recording and the summary of the listener."""
    environment = dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    environment["ROS_DOMAIN_ID"] = str(1 + secrets.randbelow(100))
    recording, summary = out / "recording", out / "live.json"

    def start(name: str, *arguments: str) -> subprocess.Popen[bytes]:
        log = (out / f"{name}.log").open("wb")
        return subprocess.Popen(
            [sys.executable, "-m", *arguments], stdout=log, stderr=subprocess.STDOUT, env=environment
        )

    def node(name: str, **parameters: Any) -> subprocess.Popen[bytes]:
        given = [part for key, value in parameters.items() for part in ("-p", f"{key}:={value}")]
        return start(name, f"rim_camera_ros.nodes.{name.replace('_', '.')}", "--ros-args", *given)

    processes = {"correction_node": node("correction_node", camera=camera)}
    processes["recorder"] = start(
        "recorder",
        "rim_camera_ros.cli",
        "record",
        "--out",
        str(recording),
        "--frames",
        str(frames),
        "--quiet",
    )
    processes["listener"] = start(
        "listener",
        "rim_camera_ros.nodes.common.latency_monitor",
        "--frames",
        str(frames),
        "--json",
        str(summary),
    )
    processes["driver_node"] = node(
        "driver_node", source="simulator", camera=SIMULATED, scene=SCENE, frame_rate=RATE, loop="true",
        seed=seed % 10_000,
    )  # fmt: skip
    try:
        for name in ("recorder", "listener"):
            _wait(processes, name, out, deadline=time.monotonic() + 45 + frames / RATE)
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
    return recording, json.loads(summary.read_text())


def _wait(processes: dict[str, subprocess.Popen[bytes]], name: str, out: Path, *, deadline: float) -> None:
    """Wait until one process ends with success while the others run; otherwise `RimError` names the log."""
    while (status := processes[name].poll()) is None:
        for other, process in processes.items():
            if other.endswith("_node") and process.poll() is not None:
                raise RimError(f"{other} ended with status {process.returncode}", file=out / f"{other}.log")
        if time.monotonic() > deadline:
            raise RimError(f"{name} did not end in time", file=out / f"{name}.log")
        time.sleep(0.05)
    if status != 0:
        raise RimError(f"{name} ended with status {status}", file=out / f"{name}.log")


def _pairs(recording: Path) -> Iterator[tuple[RawFrame, CorrectedFrame]]:
    """Yield the recorded raw frames with the corrected frames that the correction node published."""
    with Recording(recording) as raw_bag, Recording(recording) as corrected_bag:
        corrected = {frame.stamp: frame for frame in corrected_bag.corrected_frames()}
        for raw in raw_bag.frames():
            if raw.stamp in corrected:
                yield raw, corrected[raw.stamp]


def _print_table(c: Comparison, shares: Any, live: dict[str, Any]) -> None:
    print(f"\nerror against the known scene [mm], {c.before.count} values of {c.frames} frames")
    print(f"({c.valid_share:.0%} of the pixels: bright enough, not saturated, not mixed)\n")
    print(f"{'':16}{'bias':>9}{'RMS':>9}{'median |e|':>12}{'RMS of mean frames':>20}")
    for name, error, mean in (
        ("before", c.before, c.systematic_before),
        ("after", c.after, c.systematic_after),
    ):
        row = (error.bias, error.rms, error.median, mean)
        print("{:16}{:9.1f}{:9.1f}{:12.1f}{:20.1f}".format(name, *(1e3 * value for value in row)))
    print(f"{'predicted sigma':16}{'':9}{c.noise * 1e3:9.1f}   (noise of one frame, after)")
    print("\nshare of each effect [mm; 68 % of the pixels stay below it; one frame without noise]\n")
    print(f"{'effect':26}{'before':>9}{'after':>9}")
    ranked: list[tuple[str, Share]] = sorted(shares.items(), key=lambda item: -item[1].before)
    for name, share in ranked:
        print(f"{name:26}{share.before * 1e3:9.2f}{share.after * 1e3:9.2f}")
    print("\nover DDS")
    print(f"rate            {live.get('rate_hz', float('nan')):.2f} Hz")
    for name, words in (("raw", "driver -> here"), ("points", "driver -> correction -> here")):
        late = live.get(f"{name}_latency_ms")
        if late:
            print(
                f"latency         {words}: median {late['median']:.1f} ms, p99 {late['p99']:.1f} ms "
                "(from the frame's stamp)"
            )
    print(
        f"frames          {live['raw_frames']} raw seen, {live.get('missing_in_raw', 0)} missing "
        f"between them, {live['without_points']} without points "
        f"(and {live['before_first_points']} before the first points)"
    )


if __name__ == "__main__":
    sys.exit(main())
