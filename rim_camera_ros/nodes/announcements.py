"""Which findings of a node's checks are logged: what begins and what is over, seldom; no ROS in here."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rim_camera_ros.nodes.statistics import Finding, Level

#: Seconds [s] without a level after which it is over: what comes and goes faster is one state, and is logged
#: once. Five looks of the diagnostics, and the window over which losses are counted.
SETTLED = 5.0
#: Seconds [s] between two lines of a check at the same level: a warning that comes back within a minute tells
#: nobody anything new; an error may, but ten lines a minute are enough to act on.
QUIET = {Level.WARN: 60.0, Level.ERROR: 10.0}


@dataclass
class _Check:
    logged: Level = Level.OK
    left_out: int = 0
    seen: dict[Level, float] = field(default_factory=dict)
    lines: dict[Level, float] = field(default_factory=dict)

    def holds(self, now: float) -> Level:
        """Return the highest level that is not over."""
        return max((one for one, at in self.seen.items() if now - at < SETTLED), default=Level.OK)


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
        check.left_out += begins
        if now - check.lines.get(level, -math.inf) < QUIET[level]:
            return None
        more, check.left_out = check.left_out - 1, 0
        check.logged, check.lines[level] = level, now
        return level, f"{name}: {finding.message}" + (f" [{more} more like it]" if more > 0 else "")
