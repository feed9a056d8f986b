"""Rows and columns beside saturated pixels (Kahlmann 2007, sec. 3.3.1, fig. 3.12)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm, Undo
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.discrepancy import SPREADS, Change, DiscrepancyColumn, spread_out
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class SaturationBleed(DistanceTerm):
    """Added to every unsaturated pixel of a row (column) that holds a saturated one; negative = shorter.

    Undone as far as the frame's own saturated pixels show it: saturation occurs after the noise.
    """

    name = "saturation_bleed"
    title = "rows and columns beside saturated pixels"
    observable = "a retro-reflective target that saturates, before a plane"
    refuted_by = "rows with saturated pixels that measure as the rows beside them"
    undo: ClassVar[Undo] = "partial"

    lacking = "no pixel of the recordings is saturated"
    needs_all_pixels = True
    from_saturated = True
    has_discrepancy = True
    drawn_over = ("saturation",)
    planned = False

    row: float = quantity("m", "for pixels of the same row", default=0.0, typical=0.02)
    column: float = quantity("m", "for pixels of the same column", default=0.0, typical=0.02)

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"frame"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        saturated = context.saturated
        if saturated is None or not saturated.any():
            return 0.0
        rows, columns = _beside(saturated)
        return self.row * rows + self.column * columns

    def line_terms(self, saturated: NDArray[np.bool_]) -> tuple[Image, Image]:
        return self.row * saturated.any(axis=1), self.column * saturated.any(axis=0)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        saturated = context.saturated
        if saturated is None:
            saturated = np.zeros(signal.distance.shape, bool)
        rows, columns = _beside(saturated)
        return {"row": (rows, 0.0), "column": (columns, 0.0)}

    def sentence(self) -> str:
        return (
            f"saturation: pixels in the row of a saturated one measure {self.row * 1e3:+.1f} mm, "
            f"in its column {self.column * 1e3:+.1f} mm"
        )

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(row=0.0, column=0.0), {"row": 0.02, "column": 0.02})] if facts.saturated else []

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        """Smooth factors, and a fading with the gap to the nearest saturated pixel of either side."""
        for factor in change.factors:
            yield change.distance * factor, None
        for fading in _fading(change.reading.context, change.distance.shape):
            yield fading, None
        yield from spread_out(change)

    @classmethod
    def example(cls, camera: Camera) -> SaturationBleed:
        return cls(row=-0.021, column=-0.008)


def _beside(saturated: NDArray[np.bool_]) -> tuple[Image, Image]:
    """Return 1.0 for unsaturated pixels of rows, and of columns, that hold a saturated one."""
    free = ~saturated
    rows = saturated.any(axis=1, keepdims=True) & free
    columns = saturated.any(axis=0, keepdims=True) & free
    return rows.astype(float), columns.astype(float)


def _fading(context: Context, shape: tuple[int, ...]) -> list[Image]:
    """Return factors (H, W) that fade with the gap to the nearest saturated pixel of the row or column.

    Each side has its own: a column that is read out downwards need not spread upwards.
    """
    saturated = context.saturated
    if saturated is None or not saturated.any():
        return [np.zeros(shape)] * (4 * len(SPREADS))
    width = saturated.shape[1]
    found = []
    for axis in (0, 1):
        after = _gap(saturated, axis)
        before = np.flip(_gap(np.flip(saturated, axis), axis), axis)
        for gap in (after, before):
            found += [np.where(saturated, 0.0, np.exp(-gap / (share * width))) for share in SPREADS]
    return found


def _gap(marked: NDArray[np.bool_], axis: int) -> Image:
    """Return pixels since the last marked one along an axis, infinite before the first."""
    place = np.arange(marked.shape[axis], dtype=float).reshape((-1, 1) if axis == 0 else (1, -1))
    last = np.maximum.accumulate(np.where(marked, place, -np.inf), axis=axis)
    return np.asarray(place - last)
