"""Runs all faults for a given time, prints what was measured: ``python -m test.soak --duration SECONDS``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from test.soak import faults, load, mutations


def rows(duration: float) -> dict[str, Callable[[Path], Any]]:
    """Return the faults, sized so that all of them take about ``duration`` seconds."""
    share = duration / 100.0
    return {
        "kills": lambda folder: faults.kills(folder, count=max(3, min(50, int(20 * share / 4)))),
        "hostile": lambda folder: faults.hostile(folder, seconds=max(5.0, 10 * share)),
        "endurance": lambda folder: load.endurance(folder, seconds=max(10.0, 20 * share)),
        "latency": lambda folder: load.latency(folder, seconds=max(5.0, 10 * share)),
        "overload": lambda folder: load.overload(folder, seconds=max(10.0, 10 * share)),
        "readers": lambda folder: faults.readers(folder, seconds=max(3.0, 3 * share)),
        "clock_jumps": lambda folder: faults.clock_jumps(folder),
        "full_disk": lambda folder: faults.full_disk(folder),
        # ten times as fast as recorded
        "playback": lambda folder: faults.playback(folder, minutes=max(1.0, min(30.0, share * 10 / 6))),
        "damaged_files": lambda folder: mutations.run(
            folder, count=max(150, min(10_000, int(20 * share * 25)))
        ),
        "damaged_parameter_files": lambda folder: mutations.parameter_files(
            folder, count=max(5, min(200, int(5 * share / 2)))
        ),
        "reconfiguration": lambda folder: faults.reconfiguration(folder, seconds=max(10.0, 40 * share)),
    }


def main() -> int:
    """Run; status 1 where a fault could not be survived at all (an assertion of it failed)."""
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("--duration", type=float, default=300.0, help="seconds, about (default: 300)")
    parser.add_argument(
        "--beside", type=int, default=0, help="processes that are always busy beside the nodes (default: 0)"
    )
    parser.add_argument("--only", action="append", help="run only this fault; may be given several times")
    given = parser.parse_args()
    failed = False
    for name, run in rows(given.duration).items():
        if given.only and name not in given.only:
            continue
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder, load.busy(given.beside):
            try:
                figures = run(Path(folder))
            except AssertionError as error:
                failed = True
                figures = {"FAILED": str(error)[-2000:]}
        took = f"{time.monotonic() - begun:.0f} s, load {os.getloadavg()[0]:.1f}"
        print(f"{name} ({took}): {json.dumps(figures, default=str)}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
