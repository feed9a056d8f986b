"""Stamps of messages without decoding them, and pairs of stamps that belong to one exposure."""

from __future__ import annotations

import bisect
import struct

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import NANOSECONDS

_CDR_LITTLE, _CDR_BIG = struct.Struct("<4xiI"), struct.Struct(">4xiI")
_ROS1 = struct.Struct("<4xII")


def header_stamp(data: bytes, *, ros1: bool) -> int | None:
    """Return the stamp in ns of a serialised message that begins with a header; None if it is too short."""
    if len(data) < 12:
        return None
    kind = _ROS1 if ros1 else (_CDR_LITTLE if data[1] & 1 else _CDR_BIG)
    seconds, nanoseconds = kind.unpack_from(data)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


class Series:
    """Numbers of a whole recording by stamp in ns."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, float]] = []
        self._sorted = True

    def add(self, stamp: int, value: float) -> None:
        """Add a number, in any order of the stamps."""
        self._sorted = self._sorted and (not self._rows or stamp >= self._rows[-1][0])
        self._rows.append((stamp, value))

    def latest(self, stamp: int) -> float | None:
        """Return the last number at or before a stamp, None without one."""
        if not self._sorted:
            self._rows.sort(key=lambda row: row[0])
            self._sorted = True
        place = bisect.bisect_right(self._rows, stamp, key=lambda row: row[0])
        return self._rows[place - 1][1] if place else None


def half_period(stamps: NDArray[np.int64]) -> int:
    """Return half of the median step between stamps in ns; half a second for a single one."""
    steps = np.diff(np.unique(stamps))
    return int(np.median(steps)) // 2 if steps.size else NANOSECONDS // 2


def pairs(first: NDArray[np.int64], second: NDArray[np.int64], *, tolerance: int) -> dict[int, int]:
    """Return, by stamp of ``first``, the stamp of ``second`` that belongs to it.

    Each is the nearest to the other, and they are at most ``tolerance`` ns apart.
    """
    first, second = np.unique(first), np.unique(second)
    if not first.size or not second.size:
        return {}
    forth, back = _nearest(first, second), _nearest(second, first)
    mutual = back[forth] == np.arange(first.size)
    close = np.abs(second[forth] - first) <= tolerance
    return {int(first[i]): int(second[forth[i]]) for i in np.flatnonzero(mutual & close)}


def _nearest(values: NDArray[np.int64], among: NDArray[np.int64]) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(among, values), 0, among.size - 1)
    before = np.clip(after - 1, 0, among.size - 1)
    nearer = np.abs(among[before] - values) <= np.abs(among[after] - values)
    return np.where(nearer, before, after)
