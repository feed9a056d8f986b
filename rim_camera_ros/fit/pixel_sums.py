"""Sums per pixel of the products of all columns of a design with a column of the pixel's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.channels import Products

Array = NDArray[Any]

#: Number of common rows of groups whose products are added at a time.
_AT_A_TIME = 32


class PixelSums:
    """Sums per pixel of the products of all columns with a column of the pixel's own.

    They are the largest arrays of an adjustment. Room is allocated once for about all of them; parts that are
    never written take no memory. Where the room does not suffice, a larger one is allocated and filled.
    """

    def __init__(self, count: int, pixels: int, rows: Array) -> None:
        self._rows_of = rows
        self._sums: Array = np.zeros((count, pixels))
        self._y: Array = np.zeros(pixels)
        self._written = count
        # shares of groups, and the products of their common rows
        self._common: list[tuple[Array, Array]] = []
        self._first = 0

    def make_room(self, size: int) -> None:
        """Make room for so many rows."""
        if size > len(self._sums):
            room = np.zeros((size, self._sums.shape[1]))
            room[: self._written] = self._sums[: self._written]
            self._sums = room

    def add(self, part: Products, places: Sequence[int]) -> None:
        """Add products; ``places`` are the rows here of all columns but the last, the observations."""
        size = max(places, default=-1) + 1
        self.make_room(size)
        self._written = max(self._written, size)
        channel = part.channel
        rows = self._rows_of[channel.pixels]
        buffer = np.empty(rows.size)
        for number, row in zip(channel.index.tolist(), channel.dense, strict=True):
            target = self._sums[places[number]] if number < len(places) else self._y
            target[rows] += np.multiply(row, part.factor, out=buffer)
        groups = channel.groups
        if groups is None:
            return
        mine = np.flatnonzero(groups.number >= 0)
        # each pixel has one of them: no place occurs twice
        self._sums[groups.first + groups.number[mine], rows[mine]] += groups.value[mine] * part.factor[mine]
        if groups.common is not None:
            products = np.zeros(len(self._y))
            products[rows] = groups.common * part.factor
            self._first = groups.first
            self._common.append((groups.share, products))
            if len(self._common) == _AT_A_TIME:
                self._add_common()

    def _add_common(self) -> None:
        if self._common:
            shares = np.stack([share for share, _ in self._common], axis=1)
            own = slice(self._first, self._first + len(shares))
            self._sums[own] += shares @ np.stack([products for _, products in self._common])
            self._common.clear()

    def all(self, size: int) -> Array:
        """Return the sums (P, ``size``), the observations last; column by column, as they were summed."""
        self._add_common()
        self.make_room(size)
        self._sums[size - 1] = self._y
        return self._sums[:size].T
