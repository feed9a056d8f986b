"""Counts and times of a node, findings in words, and which findings are logged; no ROS in here."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

#: Seconds over which rates, latencies and losses are stated, and the most frames that are kept for that.
WINDOW = 5.0
_KEPT = 4096
#: The lack of frames is an error after this time [s], and after so many periods of the frames. The first
#: frame may take longer [s]: a driver must start and be discovered (up to 2.4 s, see docs/reliability.md).
_SILENT, _SILENT_PERIODS, _STARTING = 1.0, 3.0, 5.0
#: Number of steps between frames whose median is the period, and the longest period that is assumed [s].
_STEPS, _LONGEST_PERIOD = 15, 10.0
#: Latencies [s] above this come from stamps that are not of the present (those of a recording).
_OF_NOW = 60.0


class Level(IntEnum):
    """Levels by what a robot should do: go on; go on with care and report it; do not rely on the camera."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Finding:
    """One line of diagnostics: its message consists of the sentences of its highest level."""

    level: Level = Level.OK
    values: dict[str, str] = field(default_factory=dict)
    _sentences: list[tuple[Level, str]] = field(default_factory=list)

    def worse(self, level: Level, sentence: str) -> None:
        """Add a sentence on what is wrong, at a level."""
        self.level = max(self.level, level)
        self._sentences.append((level, sentence))

    def note(self, sentence: str) -> None:
        """Add a sentence for the case that nothing is wrong."""
        self._sentences.append((Level.OK, sentence))

    @property
    def message(self) -> str:
        return "; ".join(text for level, text in self._sentences if level == self.level) or "fine"


class Flow:
    """Rate, latency and jitter of frames over the last `WINDOW` seconds.

    All ``now`` are in seconds of a clock that never jumps.
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
        """Return the frames per second; 0 where none came recently."""
        times = [one[0] for one in self._recent(now)]
        if len(times) < 2:
            return 0.0
        # the rate falls as soon as the flow stops, not only when the window is empty
        span = max(times[-1] - times[0], (now - times[0]) * (len(times) - 1) / len(times))
        return (len(times) - 1) / span if span > 0 else 0.0

    def silent(self, now: float, *, begun: float) -> float:
        """Return for how long [s] no frame has come if that is an error, else 0; ``begun``: since when."""
        since = now - max(self.last or 0.0, begun)
        if self.last is None or self.last < begun:
            return since if since > _STARTING else 0.0
        # the period of the frames that came: a flow that has stopped has no rate
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
    """Counts by reason, and their increase over the last `WINDOW` seconds."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, Counter[str]]] = deque()

    def recent(self, counts: Mapping[str, int], now: float) -> Counter[str]:
        """Return the increase of each count over the window; to be called about once a second."""
        current = Counter(counts)
        self._history.append((now, current))
        while len(self._history) > 1 and now - self._history[1][0] > WINDOW:
            self._history.popleft()
        return current - self._history[0][1]


class Hysteresis:
    """A state that begins beyond one limit and ends at another; values between the two do not change it.

    With ``begin`` above ``end`` it holds for large values, else for small ones.
    """

    def __init__(self, *, begin: float, end: float) -> None:
        self._sign = 1.0 if begin > end else -1.0
        self._begin, self._end = self._sign * begin, self._sign * end
        self._holds = False

    def holds(self, value: float) -> bool:
        """Take a new value, and return whether the state holds."""
        value *= self._sign
        self._holds = value >= self._end if self._holds else value > self._begin
        return self._holds


#: A level is over when it has not occurred for this time [s]: what comes and goes faster is one state, and is
#: logged once. These are five rounds of the diagnostics, and the window over which losses are counted.
SETTLED = 5.0
#: Least time [s] between two lines of a check at the same level: a warning that returns within a minute is
#: nothing new; an error may be, but six lines a minute are enough to act on.
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
    """Decides which findings of each check are logged.

    A warning or an error is logged when it begins, and ``fine again`` once it has been gone for `SETTLED`,
    but not more often than `QUIET`. A line that was held back is logged after that time if its state still
    holds.
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
