"""Pairs of clouds and sigma images of the same stamp, as they come; no ROS in here."""

from __future__ import annotations

from typing import Any

POINTS, SIGMA = "points", "sigma"
#: Frames that may wait for their other half.
CAPACITY = 8


class CloudPairing:
    """Pairs the cloud and the sigma image of a stamp; ``dropped`` counts those that found no partner."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: dict[int, dict[str, Any]] = {}
        self._begun = False

    def add(self, role: str, stamp: int, value: Any) -> tuple[Any, Any] | None:
        """Take one half of the frame at ``stamp`` [ns]; return cloud and sigma when both are there.

        Halves that came before a complete frame wait no longer.
        """
        parts = self._waiting.setdefault(stamp, {})
        parts[role] = value
        if len(parts) == 2:
            for older in list(self._waiting):
                del self._waiting[older]
                if older == stamp:
                    break
                self._drop()
            self._begun = True
            return parts[POINTS], parts[SIGMA]
        while len(self._waiting) > CAPACITY:
            del self._waiting[next(iter(self._waiting))]
            self._drop()
        return None

    def _drop(self) -> None:
        # a node that starts late receives only one half of the first frame, which is no fault
        if self._begun:
            self.dropped += 1
