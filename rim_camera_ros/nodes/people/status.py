"""The diagnostics of the node that follows people; no ROS in here."""

from __future__ import annotations

import time
from collections import Counter

from rim_camera_ros.nodes.common.findings import Finding, Flow, Level, Tally
from rim_camera_ros.nodes.common.lifecycle import ACTIVE
from rim_camera_ros.tracking.people import PeopleTracker

#: Share of moving pixels above which the camera must have moved, not people.
_ALL_MOVES = 0.5


class PeopleStatus:
    """Counts of frames, and findings on frames and people."""

    def __init__(self) -> None:
        self.phase = ""
        self.flow = Flow()
        self.refused: Counter[str] = Counter()
        self._begun = time.monotonic()
        self._tally = Tally()

    def begin(self) -> None:
        """Expect frames from now on."""
        self._begun = time.monotonic()

    def taken(self, *, stamp: int, processing: float) -> None:
        """Count a frame; ``stamp`` in ns, ``processing`` in s."""
        latency = (time.time_ns() - stamp) / 1e9
        self.flow.add(time.monotonic(), stamp=stamp, latency=latency, processing=processing)

    def frames(self, dropped: int, waiting_for: str) -> Finding:
        """Return whether frames come; ``waiting_for``: the topic that nobody publishes, or ''."""
        now = time.monotonic()
        finding = Finding(values=self.flow.values(now))
        counts = {f"refused {role}": count for role, count in self.refused.items()}
        counts["cloud or sigma without the other"] = dropped
        finding.values |= {
            "refused_messages": str(self.refused.total()),
            "dropped_frames": str(dropped),
        }
        lately = self._tally.recent(counts, now)
        if self.phase != ACTIVE:
            finding.note(f"no frames: the node is {self.phase}")
            return finding
        if silent := self.flow.silent(now, begun=self._begun):
            why = f" (nobody publishes {waiting_for})" if waiting_for else ""
            finding.worse(Level.ERROR, f"no frame for {silent:.1f} s{why}")
        for reason, count in sorted(lately.items()):
            if count:
                finding.worse(Level.WARN, f"{reason}: {count} lately")
        finding.note(f"{self.flow.rate(now):.1f} frames per second")
        return finding

    def people(self, tracker: PeopleTracker) -> Finding:
        """Return how many people are followed, and whether the background is still valid."""
        finding = Finding()
        people = tracker.people
        finding.values = {
            "people": str(len(people)),
            "hidden": str(sum(person.hidden for person in people)),
            "moving_share": f"{tracker.moving:.4f}",
            "missing_background_frames": str(tracker.missing_frames),
        }
        if tracker.missing_frames:
            finding.worse(
                Level.WARN, f"the background is learnt: {tracker.missing_frames} frames more are needed"
            )
        if tracker.moving > _ALL_MOVES:
            finding.worse(
                Level.WARN,
                f"{100 * tracker.moving:.0f} % of the pixels move: the camera was moved; "
                "call the service learn_background",
            )
        finding.note(f"{len(people)} people")
        return finding
