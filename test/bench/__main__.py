"""``python -m test.bench``: print the table of speeds, on one thread.

Each work is timed in turn with its baseline (A B A B ...), and the medians are compared. The exit
status is 1 where something falls short of what is required. The latency between processes over DDS is
measured by the demonstration, which starts them.
"""

# ruff: noqa: E402 - the number of threads is read when numpy is imported
from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2

from rim_camera_ros.pipeline.correct import Correction
from test.bench import cases, joint
from test.bench.rows import Row, all_rows, parts_of_every_effect

Clock = Callable[[], float]

#: Rounds of A B, and least seconds of one A or B.
ROUNDS = 9
SECONDS = 0.05
#: The complete correction may take this many times the sum of its parts.
PARTS = 1.3
#: Share of a correction that sigma and flags may take, where effects are undone that need other pixels.
JUDGED = 0.1
#: Frames whose correction must not let the memory grow by more than this many MB.
FRAMES = 10_000
GROWTH = 5.0
#: The joint adjustment against a general one: times faster, times less memory, farthest apart in sigma.
FASTER, SMALLER, SAME = 20.0, 10.0, 0.01


def repetitions(work: Callable[[], Any], clock: Clock) -> int:
    """Return how often the work fits into `SECONDS`."""
    work()
    start = clock()
    work()
    return max(1, round(SECONDS / max(clock() - start, 1e-6)))


def seconds(work: Callable[[], Any], number: int, clock: Clock) -> float:
    """Return the time of one run in seconds."""
    start = clock()
    for _ in range(number):
        work()
    return (clock() - start) / number


def medians(works: list[Callable[[], Any]], *, clock: Clock = time.perf_counter) -> list[float]:
    """Return the median time in seconds, by a clock, of works that are run in turn."""
    numbers = [repetitions(one, clock) for one in works]
    rounds = [
        [seconds(one, number, clock) for one, number in zip(works, numbers, strict=True)]
        for _ in range(ROUNDS)
    ]
    return [statistics.median(one) for one in zip(*rounds, strict=True)]


def line(work: str, size: str, naive: str, ours: str, result: str, required: str, verdict: str) -> str:
    return f"{work:24s}{size:>11s}{naive:>12s}{ours:>12s}{result:>14s}{required:>14s}  {verdict}"


def measured(row: Row) -> bool:
    """Measure and print a row; return whether it is fast enough."""
    size = f"{row.size[0]} x {row.size[1]}"
    if row.naive is None:
        (ours,) = medians([row.ours])
        rate = 1 / ours
        ok = row.required is None or rate >= row.required
        required = "" if row.required is None else f"{row.required:.0f} / s"
        print(line(row.work, size, "", f"{ours * 1e3:.3f}", f"{rate:.0f} / s", required, verdict(ok)))
        return ok
    ours, naive = medians([row.ours, row.naive])
    ratio = naive / ours
    ok = row.required is None or ratio >= row.required
    required = "" if row.required is None else f"{row.required:g} x"
    cells = (f"{naive * 1e3:.3f}", f"{ours * 1e3:.3f}", f"{ratio:.1f} x", required)
    print(line(row.work, size, *cells, "" if row.required is None else verdict(ok)))
    return ok


def verdict(ok: bool) -> str:
    return "ok" if ok else "short"


def parts() -> bool:
    """Compare the complete correction with the sum of its parts."""
    rows = parts_of_every_effect()
    camera = cases.every_effect()
    frame, complete = cases.frame_of(camera), Correction(camera)
    none, *each, whole = medians([*(one.ours for one in rows), lambda: complete.correct(frame)])
    total = none + sum(max(one - none, 0.0) for one in each)
    ok = whole <= PARTS * total
    cells = (f"{total * 1e3:.3f}", f"{whole * 1e3:.3f}", f"{whole / total:.2f} of it", f"<= {PARTS}")
    print(line("all effects: sum of parts", "", *cells, verdict(ok)))
    return ok


def judgement() -> bool:
    """Compare the correction with sigma and flags with that without them, in processor time."""
    ok = True
    size = cases.SIZES[0]
    for name, camera, limit in (
        ("plain", cases.plain(*size), None),
        ("sr3000", cases.camera_of("sr3000", *size), JUDGED),
        ("every effect", cases.every_effect(), JUDGED),
    ):
        frame, correction = cases.frame_of(camera), Correction(camera)
        whole, alone = medians(
            [
                lambda frame=frame, correction=correction: correction.correct(frame),
                lambda frame=frame, correction=correction: correction.correct_distance(frame),
            ],
            clock=time.process_time,
        )
        share = 1 - alone / whole
        fits = limit is None or share <= limit
        cells = (f"{alone * 1e3:.3f}", f"{whole * 1e3:.3f}", f"{100 * share:.0f} % of it")
        required = "" if limit is None else f"<= {100 * limit:.0f} %"
        judged = "" if limit is None else verdict(fits)
        print(line(f"sigma, flags: {name}", f"{size[0]} x {size[1]}", *cells, required, judged))
        ok &= fits
    return ok


def adjustment() -> bool:
    """Compare the joint adjustment of a million samples with scipy's least squares: time, memory, result."""
    given = joint.work()
    (a, sigma), ours, ours_memory = joint.measured(lambda: joint.ours(given))
    b, naive, naive_memory = joint.measured(lambda: joint.naive(given))
    ratio, memories = naive / ours, naive_memory / ours_memory
    same = float(abs((a - b) / sigma).max())
    fast, small = ratio >= FASTER and same < SAME, memories >= SMALLER
    work = f"adjustment, {given.samples / 1e6:.1f}e6 samples"
    cells = (f"{naive * 1e3:.0f}", f"{ours * 1e3:.0f}", f"{ratio:.0f} x", f"{FASTER:.0f} x")
    print(line(work, "", *cells, verdict(fast)))
    cells = (f"{naive_memory:.0f} MB", f"{ours_memory:.1f} MB", f"{memories:.0f} x", f"{SMALLER:.0f} x")
    print(line("  its memory", "", *cells, verdict(small)))
    print(line("  farthest apart", "", "", "", f"{same:.4f} sigma", f"<= {SAME}", verdict(same < SAME)))
    return fast and small


def memory() -> bool:
    """Correct many frames and compare the memory before and after."""
    camera = cases.every_effect()
    frame, correction = cases.frame_of(camera), Correction(camera)
    for _ in range(100):
        correction.cloud(correction.correct(frame))
    before = resident()
    for _ in range(FRAMES):
        correction.cloud(correction.correct(frame))
    after = resident()
    ok = after - before <= GROWTH
    cells = (f"{before:.1f} MB", f"{after:.1f} MB", f"{after - before:+.1f} MB", f"<= {GROWTH:.0f} MB")
    print(line(f"memory, {FRAMES} frames", "", *cells, verdict(ok)))
    return ok


def resident() -> float:
    """Return the resident memory of this process in MB."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:  # not Linux: the greatest so far
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> int:
    """Print the table."""
    cv2.setNumThreads(1)
    print(line("work (one thread)", "size", "naive [ms]", "ours [ms]", "result", "required", ""))
    results = [measured(row) for row in all_rows()]
    results.append(parts())
    results.append(judgement())
    results.append(memory())
    results.append(adjustment())
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
