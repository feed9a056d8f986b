"""Runs all faults for a time while processes are busy, prints what was measured and what is beyond its limit.

``python -m test.soak --duration SECONDS``; status 1 where a figure is beyond its limit (`limits`).
"""

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

from test.soak import faults, limits, load, mutations

#: Processes in addition to the nodes, which with these make a load of about 4.
BUSY = 3


def rows(duration: float) -> dict[str, Callable[[Path], Any]]:
    """Return the faults, sized so that all of them take about ``duration`` seconds."""
    share = duration / 100.0
    return {
        "kills": lambda folder: faults.kills(folder, count=max(3, min(50, int(20 * share / 4)))),
        "hostile": lambda folder: faults.hostile(folder, seconds=max(5.0, 10 * share)),
        "endurance": lambda folder: load.endurance(folder, seconds=max(10.0, 20 * share)),
        "latency": lambda folder: load.latency(folder, seconds=max(5.0, 10 * share)),
        "overload": lambda folder: load.overload(folder, seconds=max(10.0, 10 * share)),
        "overload_default": lambda folder: load.overload(
            folder, seconds=max(10.0, 5 * share), maximum_age=None
        ),
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
    """Run; status 1 where a fault was not survived (an assertion of it failed) or a limit is exceeded."""
    parser = argparse.ArgumentParser(prog="soak", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--duration", type=float, default=300.0, help="seconds, about (default: 300)")
    parser.add_argument(
        "--beside",
        type=int,
        default=BUSY,
        help=f"processes that are always busy beside the nodes ({BUSY}: a load of about 4 with the nodes; "
        "none beside latency, which is that of a quiet machine)",
    )
    parser.add_argument("--only", action="append", help="run only this fault; may be given several times")
    given = parser.parse_args()
    failed = False
    for name, run in rows(given.duration).items():
        if given.only and name not in given.only:
            continue
        begun = time.monotonic()
        beside = 0 if name == "latency" else given.beside
        with tempfile.TemporaryDirectory() as folder, load.busy(beside):
            try:
                figures = run(Path(folder))
            except AssertionError as error:
                failed = True
                figures = {"FAILED": str(error)[-2000:]}
        average = os.getloadavg()[0]
        took = f"{time.monotonic() - begun:.0f} s, load {average:.1f}"
        print(f"{name} ({took}): {json.dumps(figures, default=str)}", flush=True)
        if not limits.is_judged(name, load=average):
            print(
                f"{name}: NOT JUDGED, its limits are those of a load up to {limits.QUIET_LOAD:g}", flush=True
            )
        if "FAILED" not in figures:
            for sentence in limits.beyond(name, figures, load=average):
                failed = True
                print(f"{name}: BEYOND ITS LIMIT: {sentence}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
