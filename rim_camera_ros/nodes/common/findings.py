"""What a node counts and times, findings of it in words, and which of them are logged; no ROS in here."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

#: Seconds over which rates, latencies and losses are stated, and the most frames that are kept for it.
WINDOW = 5.0
_KEPT = 4096
#: Seconds [s] and periods without a frame after which it is an error, and seconds that the first may take:
#: until a driver has started and both have found each other (up to 2.4 s were measured, docs/reliability.md).
_SILENT, _SILENT_PERIODS, _STARTING = 1.0, 3.0, 5.0
#: Steps from frame to frame of which the median is the period, and the longest [s] that is waited for.
_STEPS, _LONGEST_PERIOD = 15, 10.0
#: Latencies [s] beyond this are of stamps that are not of now (a recording's own).
_OF_NOW = 60.0


class Level(IntEnum):
    """What a robot can act on: go on; go on with care and tell somebody; do not rely on it."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Finding:
    """One line of diagnostics: its message are the sentences of its highest level."""

    level: Level = Level.OK
    values: dict[str, str] = field(default_factory=dict)
    _sentences: list[tuple[Level, str]] = field(default_factory=list)

    def worse(self, level: Level, sentence: str) -> None:
        """Say what is wrong."""
        self.level = max(self.level, level)
        self._sentences.append((level, sentence))

    def note(self, sentence: str) -> None:
        """Say how it is, where nothing is wrong."""
        self._sentences.append((Level.OK, sentence))

    @property
    def message(self) -> str:
        return "; ".join(text for level, text in self._sentences if level == self.level) or "fine"


class Flow:
    """Rate, latency and jitter of frames over the last `WINDOW` seconds.

    ``now`` arguments are seconds of a clock that never jumps.
    """

    def __init__(self) -> None:
        self.total = 0
        self.jumps = 0
        self._times: deque[tuple[float, float, float]] = deque(maxlen=_KEPT)
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._last_stamp: int | None = None
        self.last: float | None = None

    def add(self, now: float, *, stamp: int, latency: float, processing: float) -> None:
        """Count a frame. ``stamp`` [ns]; ``latency`` (stamp to now) and ``processing`` (here) in s."""
        self.total += 1
        if self._last_stamp is not None and not 0 < stamp - self._last_stamp < 10 * 10**9:
            self.jumps += 1
        self._last_stamp = stamp
        if self.last is not None:
            self._steps.append(now - self.last)
        self.last = now
        self._times.append((now, latency, processing))

    def rate(self, now: float) -> float:
        """Return the frames per second; 0 where none came lately."""
        times = [one[0] for one in self._recent(now)]
        if len(times) < 2:
            return 0.0
        # a flow that stops loses its rate at once, not only when the window is empty
        span = max(times[-1] - times[0], (now - times[0]) * (len(times) - 1) / len(times))
        return (len(times) - 1) / span if span > 0 else 0.0

    def silent(self, now: float, *, begun: float) -> float:
        """Return for how long [s] no frame has come where that is an error, else 0; ``begun``: since when."""
        since = now - max(self.last or 0.0, begun)
        if self.last is None or self.last < begun:
            return since if since > _STARTING else 0.0
        # of the frames that came: a flow that stops has no rate
        period = min(float(np.median(self._steps)), _LONGEST_PERIOD) if self._steps else 0.0
        return since if since > max(_SILENT, _SILENT_PERIODS * period) else 0.0

    def values(self, now: float) -> dict[str, str]:
        """Return rate, jitter, latencies as text."""
        recent = self._recent(now)
        result = {"frames": str(self.total), "rate_hz": f"{self.rate(now):.2f}"}
        if len(recent) > 2:
            times, latency, processing = np.array(recent).T
            steps = np.diff(times)
            result["jitter_ms"] = f"{1e3 * float(np.std(steps)):.2f}"
            result["longest_gap_ms"] = f"{1e3 * float(steps.max()):.1f}"
            if np.abs(latency).max() < _OF_NOW:
                result["latency_median_ms"] = f"{1e3 * float(np.median(latency)):.2f}"
                result["latency_p99_ms"] = f"{1e3 * float(np.percentile(latency, 99)):.2f}"
            else:
                result["latency_median_ms"] = "unknown: stamps are not of now"
            result["processing_median_ms"] = f"{1e3 * float(np.median(processing)):.2f}"
            result["processing_p99_ms"] = f"{1e3 * float(np.percentile(processing, 99)):.2f}"
        result["stamp_jumps"] = str(self.jumps)
        return result

    def _recent(self, now: float) -> list[tuple[float, float, float]]:
        while self._times and now - self._times[0][0] > WINDOW:
            self._times.popleft()
        return list(self._times)


class Tally:
    """Counts by reason, and what came to them over the last `WINDOW` seconds."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, Counter[str]]] = deque()

    def recent(self, counts: Mapping[str, int], now: float) -> Counter[str]:
        """Return by how much each count grew lately; to be called about once a second."""
        current = Counter(counts)
        self._history.append((now, current))
        while len(self._history) > 1 and now - self._history[1][0] > WINDOW:
            self._history.popleft()
        return current - self._history[0][1]


class Hysteresis:
    """A state that begins beyond one limit and ends within another: values between them keep it as it is.

    ``begin`` above ``end``: it holds for great values; below: for small ones.
    """

    def __init__(self, *, begin: float, end: float) -> None:
        self._sign = 1.0 if begin > end else -1.0
        self._begin, self._end = self._sign * begin, self._sign * end
        self._holds = False

    def holds(self, value: float) -> bool:
        """Take a value, and return whether the state holds with it."""
        value *= self._sign
        self._holds = value >= self._end if self._holds else value > self._begin
        return self._holds


#: Seconds [s] without a level after which it is over: what comes and goes faster is one state, and is logged
#: once. Five looks of the diagnostics, and the window over which losses are counted.
SETTLED = 5.0
#: Seconds [s] between two lines of a check at the same level: a warning that comes back within a minute tells
#: nobody anything new; an error may, but ten lines a minute are enough to act on.
QUIET = {Level.WARN: 60.0, Level.ERROR: 10.0}


@dataclass
class _Check:
    logged: Level = Level.OK
    suppressed: int = 0
    seen: dict[Level, float] = field(default_factory=dict)
    lines: dict[Level, float] = field(default_factory=dict)

    def holds(self, now: float) -> Level:
        """Return the highest level that is not over."""
        return max((name for name, at in self.seen.items() if now - at < SETTLED), default=Level.OK)


class Announcements:
    """What is to be logged of each check, by its findings as they come.

    A warning or an error is logged when it begins, and ``fine again`` once it has been gone for `SETTLED`; no
    more often than `QUIET`. A line that was held back comes when that time is over, if the state still holds.
    """

    def __init__(self) -> None:
        self._checks: dict[str, _Check] = {}

    def line(self, name: str, finding: Finding, *, now: float) -> tuple[Level, str] | None:
        """Return level and text of the line to log of a check, None for none; ``now`` [s] never jumps."""
        check, level = self._checks.setdefault(name, _Check()), finding.level
        begins = level > check.holds(now)
        check.seen |= {one: now for one in QUIET if level >= one}
        holds = check.holds(now)
        if holds < check.logged:
            check.logged = holds
            return (Level.OK, f"{name}: fine again") if holds == Level.OK else None
        if level <= check.logged:
            return None
        check.suppressed += begins
        if now - check.lines.get(level, -math.inf) < QUIET[level]:
            return None
        more, check.suppressed = check.suppressed - 1, 0
        check.logged, check.lines[level] = level, now
        return level, f"{name}: {finding.message}" + (f" [{more} more like it]" if more > 0 else "")
