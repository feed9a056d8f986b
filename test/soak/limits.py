"""What the figures of a soak are held against; `make soak` ends with status 1 beyond a limit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Figures = Mapping[str, Any]

#: Seconds within which a new cloud comes after a SIGKILL.
BACK_S = 4.0
#: Growth of a process' memory [MB] from the first quarter of the time to the last that counts as none.
FLAT_MB = 5.0
#: Growth of a process' memory [MB] by tables of four integration times, two corrections at a time, or by
#: what waits for the correction.
WITH_TABLES_MB = 40.0
#: Load average up to which a machine with two cores is quiet, and stamp to cloud in one process there [ms].
QUIET_LOAD = 1.0
MEDIAN_MS, P99_MS = 5.0, 12.0


def beyond(name: str, figures: Figures, *, load: float) -> list[str]:
    """Return what of a row's figures is beyond its limit, a sentence each.

    ``load``: load average of the machine, as times from stamp to cloud are those of a quiet one. Rows
    without limits of their own (damaged files) assert what they find.
    """
    found = _LIMITS[name](figures, load) if name in _LIMITS else []
    if not figures.get("running", True):
        found.append("a node has ended")
    if figures.get("tracebacks"):
        found.append(f"{figures['tracebacks']} tracebacks")
    return found


def is_judged(name: str, *, load: float) -> bool:
    """Return whether the figures of a row can be held against limits at a load average."""
    return name != "latency" or load <= QUIET_LOAD


def _kills(figures: Figures, load: float) -> list[str]:
    late = [seconds for _, seconds in figures["back_s"] if seconds > BACK_S]
    found = [f"{len(late)} of {figures['kills']} back after more than {BACK_S:g} s"] if late else []
    return found + [f"{figures[key]} clouds {key}" for key in ("stale", "backwards", "wrong") if figures[key]]


def _hostile(figures: Figures, load: float) -> list[str]:
    lost = figures["good"] - figures["good_corrected"]
    found = [f"{lost} of {figures['good']} good frames not corrected"] if lost else []
    first, _, last = figures["memory_mb"]
    return found + _grown("correction", first, last, WITH_TABLES_MB)


def _endurance(figures: Figures, load: float) -> list[str]:
    driver, correction = figures["counts"].values()
    counts = {
        "frames not published": driver["not_published"],
        "frames dropped": correction["dropped_frames"],
        "messages refused": correction["refused_messages"],
        "frames not corrected": correction["not corrected"],
    }
    found = [f"{count} {what}" for what, count in counts.items() if count]
    return found + _grown("camera_node", figures["memory_mb"][0], figures["memory_mb"][-1], FLAT_MB)


def _latency(figures: Figures, load: float) -> list[str]:
    if not is_judged("latency", load=load):
        return []
    shown = figures["one process"]
    limits = {"median": MEDIAN_MS, "p99": P99_MS}
    return [
        f"{key} {shown[key]:.1f} ms, more than {limit:g} ms"
        for key, limit in limits.items()
        if shown[key] > limit
    ]


def _overload(figures: Figures, load: float) -> list[str]:
    return [f"{figures['older']} clouds older than maximum_age"] if figures["older"] else []


def _clock_jumps(figures: Figures, load: float) -> list[str]:
    lost = figures["frames"] - figures["corrected"]
    return [f"{lost} frames lost"] if lost else []


def _full_disk(figures: Figures, load: float) -> list[str]:
    found = [f"{name} is left over" for name in figures["left_over"]]
    wanted = {
        "refused": "saving on a full disk was not refused",
        "file_whole": "the old file is damaged",
        "written_later": "nothing is written once there is room",
    }
    return found + [sentence for key, sentence in wanted.items() if not figures[key]]


def _playback(figures: Figures, load: float) -> list[str]:
    found = [f"{figures[key]} clouds {key}" for key in ("missing", "others") if figures[key]]
    found += [] if figures["in_order"] else ["clouds out of order"]
    for node, memory in figures["memory_mb"].items():
        found += _grown(node, memory[0], memory[-1], FLAT_MB)
    return found


def _reconfiguration(figures: Figures, load: float) -> list[str]:
    correction = figures["correction"]
    lost = correction["dropped_frames"] + correction["not corrected"] + figures["driver"]["not_published"]
    found = [f"{lost} frames lost"] if lost else []
    for node, memory in figures["memory_mb"].items():
        found += _grown(node, memory[0], memory[-1], WITH_TABLES_MB)
    return found


def _grown(node: str, first: float, last: float, limit: float) -> list[str]:
    grown = last - first
    return [f"memory of {node} grew by {grown:.1f} MB, more than {limit:g} MB"] if grown > limit else []


_LIMITS: Mapping[str, Callable[[Figures, float], list[str]]] = {
    "kills": _kills,
    "hostile": _hostile,
    "endurance": _endurance,
    "latency": _latency,
    "overload": _overload,
    "clock_jumps": _clock_jumps,
    "full_disk": _full_disk,
    "playback": _playback,
    "reconfiguration": _reconfiguration,
}
