"""Terms of the distance as tables, so that a frame is corrected by look-ups instead of formulas."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.effects import HarmonicError
from rim_camera_ros.effects.base import DistanceTerm, solve_terms
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.pipeline import kernels

#: Entries of the table of distance per ambiguity range: half a step squared times half the curvature of the
#: cyclic error stays below 0.003 mm.
_DISTANCES = 1 << 12
#: Largest error [m] by a step of the phase, and largest step [rad] where there are other terms: it smears
#: their jump at the end of the ambiguity range.
_PHASE_ERROR = 2e-6
_PHASE_STEP = 0.05
#: All rows of the sensor.
WHOLE = slice(None)


class DistanceSolver:
    """Solves d + sum of terms(d) = y, for terms of the distance and the cyclic error.

    With ``exact`` it iterates. Otherwise y - d is looked up in a table over y, whose entries hold the value
    and its slope. Where the phase of the cyclic error changes over the array, the table has a row for each
    step of the phase, and the slope along the phase. Its columns are y plus the distance by which the phase
    shifts the strongest harmonic: then the phase only matters as far as it shifts other harmonics by other
    distances.
    """

    def __init__(
        self, camera: Camera, terms: Sequence[DistanceTerm], context: Context, *, exact: bool
    ) -> None:
        self.terms = list(terms)
        self._context = context
        self._ambiguity = camera.sensor.ambiguity
        self._wraps = camera.sensor.wraps
        self._exact = exact
        #: None where functions are not compiled, or there are no terms to tabulate
        self.compiled: kernels.CompiledSolver | None = None
        self._cyclic = next((term for term in self.terms if isinstance(term, HarmonicError)), None)
        if not exact and self.terms:
            self._tabulate(camera)

    def _tabulate(self, camera: Camera) -> None:
        step = self._ambiguity / _DISTANCES
        phase, per_rad, step_phase = self._phases(camera.shape)
        low, span = float(phase.min()), float(np.ptp(phase))
        rows = int(np.ceil(span / step_phase)) + 1
        position = (phase - low) / step_phase
        nearest = np.rint(position)
        #: entries per metre, and the entries by which each pixel's phase shifts y, plus a half for rounding
        self._scale = np.float32(1 / step)
        self._shift = ((phase - low) * (per_rad / step) + 0.5).astype(np.float32)
        #: for each pixel: its phase less that of its row of the table, in steps
        self._beside = (position - nearest).astype(np.float32) if rows > 1 else None
        length = _DISTANCES
        if not self._wraps:
            length = int(np.ceil((FULL_SCALE * camera.sensor.lsb + span * per_rad) / step)) + 1
        self._last = length - 1
        self._row = nearest.astype(np.int32) * length
        table = np.zeros((rows, length, 4), np.float32)
        grid = np.arange(length) * step

        def solved(y: Image, row: float) -> NDArray[np.float64]:
            rad = row * step_phase
            return self._solved(y - rad * per_rad, low + rad)

        for row, entries in enumerate(table):
            entries[:, 0] = solved(grid, row)
            entries[:, 1] = solved(grid + step / 2, row) - solved(grid - step / 2, row)
            if rows > 1:
                entries[:, 2] = solved(grid, row + 0.5) - solved(grid, row - 0.5)
        # slopes apply from the lower edge of an entry, and the correction is added to y
        table[..., 0] -= table[..., 1] / 2
        table *= -1
        # 16 bytes an entry: one access per pixel fetches all of it
        self._entries = table.view(np.complex128).ravel()
        self._slope = np.zeros(camera.shape, np.float32)
        if kernels.LIBRARY is not None:
            self.compiled = kernels.CompiledSolver(
                shift=self._shift,
                row=self._row,
                beside=self._beside,
                entries=self._entries,
                scale=float(self._scale),
                length=length,
                wraps=self._wraps,
                slope=self._slope,
            )
            return
        self._at, self._edge = (np.empty(camera.shape, np.float32) for _ in range(2))
        self._entry = np.empty(camera.shape, np.int32)
        self._index = np.empty(camera.shape, np.intp)
        self._fetched = np.empty(camera.shape, np.complex128)
        others = [np.empty(camera.shape, np.float32) for _ in range(3)]
        self._planes = [others[0], self._slope, *others[1:]]

    def _phases(self, shape: tuple[int, int]) -> tuple[NDArray[np.float64], float, float]:
        """Return phases (H, W) [rad], shift of the strongest harmonic by phase [m/rad], and step [rad]."""
        cyclic = self._cyclic
        if cyclic is None or not any(cyclic.gradient):
            return np.zeros(shape), 0.0, 1.0
        harmonics = sorted(cyclic.harmonics, key=lambda harmonic: -abs(harmonic.amplitude))
        order = harmonics[0].order
        curvature = sum(
            abs(harmonic.amplitude) * (1 - harmonic.order / order) ** 2 for harmonic in harmonics[1:]
        )
        greatest = np.inf if len(self.terms) == 1 else _PHASE_STEP
        phase = np.broadcast_to(cyclic.phase_shift(self._context), shape)
        step = min(
            max(float(np.ptp(phase)), 1e-6), np.sqrt(8 * _PHASE_ERROR / max(curvature, 1e-9)), greatest
        )
        return phase, self._ambiguity / (2 * np.pi * order), float(step)

    def _solved(self, y: Image, phase: float) -> NDArray[np.float64]:
        """Return y - d over a grid of y for one phase."""
        cyclic = self._cyclic
        terms = [
            cyclic.shifted(phase) if term is cyclic and cyclic is not None else term for term in self.terms
        ]
        context = self._context
        d = solve_terms(y, lambda x: sum(term.term(x, x, context) for term in terms), context, tolerance=1e-8)
        correction: NDArray[np.float64] = y - d
        if self._wraps:
            correction -= self._ambiguity * np.rint(correction / self._ambiguity)
        return correction

    def solve(self, y: Image, *, rows: slice = WHOLE, out: Image | None = None) -> Image:
        """Return d for y (H, W) in metres of some rows; not wrapped. NaN stays NaN.

        A new array, or ``out``, which may be y.
        """
        if not self.terms:
            return _copied(y, out)
        if self._exact:
            # its terms are those of the whole array
            assert rows == WHOLE
            terms, context = self.terms, self._context
            found = solve_terms(y, lambda d: sum(term.term(d, d, context) for term in terms), context)
            return _copied(found, out)
        if self.compiled is not None:
            return self.compiled.solve(y, first=self._slope[: rows.start or 0].size, out=out)
        # buffers are the same for all bands of rows, so that they stay in the processor's cache
        first = slice(len(y))
        at, edge, entry = self._at[first], self._edge[first], self._entry[first]
        index, fetched = self._index[first], self._fetched[first]
        cv2.scaleAdd(y, float(self._scale), self._shift[rows], dst=at)
        np.floor(at, out=edge)
        at -= edge
        # NaN becomes an arbitrary entry
        np.copyto(entry, edge, casting="unsafe")
        if self._wraps:
            entry &= _DISTANCES - 1
        else:
            np.clip(entry, 0, self._last, out=entry)
        np.add(entry, self._row[rows], out=index)
        # the index is in range: "clip" and "wrap" are the modes without a check before
        np.take(self._entries, index, out=fetched, mode="wrap")
        planes = [plane[rows] for plane in self._planes]
        cv2.split(fetched.view(np.float32).reshape(*y.shape, 4), planes)
        value, slope, by_phase, _ = planes
        cv2.accumulateProduct(slope, at, value)
        if self._beside is not None:
            cv2.accumulateProduct(by_phase, self._beside[rows], value)
        return np.add(y, value, out=out)

    @property
    def slope(self) -> tuple[Image, float] | None:
        """Slopes (H, W), and a factor: their product plus 1 is `gain` in real time; None without terms."""
        return (self._slope, float(self._scale)) if self.terms else None

    def gain(self, distance: Image) -> Image | None:
        """Return dd / dy (H, W) at the ``distance`` that was solved last; None without terms."""
        if not self.terms:
            return None
        if not self._exact:
            gain = self._slope * self._scale
            gain += np.float32(1.0)
            return gain
        context, step = self._context, 1e-4
        up, down = (
            sum(term.term(d, d, context) for term in self.terms) for d in (distance + step, distance - step)
        )
        return np.asarray(1.0 / (1.0 + (up - down) / (2 * step)))


def _copied(values: Image, out: Image | None) -> Image:
    if out is None:
        return values.copy()
    if out is not values:
        np.copyto(out, values)
    return out


class PlaneTable:
    """Terms of pixel and distance that are linear between knots of the distance, and constant outside.

    They are base + slope * d + the sum of bend_k * |d - k| over the inner knots k, with base, slope and bends
    of each pixel, and d limited to the range from the first to the last knot.
    """

    def __init__(self, camera: Camera, terms: Sequence[DistanceTerm], context: Context) -> None:
        knots = sorted({float(k) for term in terms for k in term.distance_knots()})
        amplitude = np.ones(camera.shape)
        values = []
        for knot in knots:
            distance = np.full(camera.shape, knot)
            total = np.zeros(camera.shape)
            for term in terms:
                total = total + term.term(distance, amplitude, context)
            values.append(total)
        slopes = [
            (above - below) / (k1 - k0)
            for k0, k1, below, above in zip(knots, knots[1:], values, values[1:], strict=False)
        ] or [np.zeros(camera.shape)]
        bends = [(after - before) / 2 for before, after in pairwise(slopes)]
        slope = (slopes[0] + slopes[-1]) / 2
        base = values[0] - slope * knots[0]
        for knot, bend in zip(knots[1:], bends, strict=False):
            base -= bend * (knot - knots[0])
        self._first, self._last = np.float32(knots[0]), np.float32(knots[-1])
        self._base, self._slope = base.astype(np.float32), slope.astype(np.float32)
        self._knots = np.array(knots[1:-1], np.float32)
        self._bends = np.array(bends, np.float32).reshape(-1, *camera.shape)

    def term(self, distance: Image) -> Image:
        """Return the sum of the terms in metres at distances (H, W) in metres."""
        if kernels.LIBRARY is not None:
            return kernels.plane_table(
                distance,
                base=self._base,
                slope=self._slope,
                knots=self._knots,
                bends=self._bends,
                first=float(self._first),
                last=float(self._last),
            )
        held = np.clip(distance, self._first, self._last)
        total: Image = held * self._slope
        total += self._base
        for knot, bend in zip(self._knots, self._bends, strict=True):
            beside = held - knot
            np.abs(beside, out=beside)
            beside *= bend
            total += beside
        return total
