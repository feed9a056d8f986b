"""What one setting of the camera folds into tables, so that a frame costs look-ups instead of formulas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.base import Context, DistanceTerm, Image, solve_terms
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.frame import Flag
from rim_camera_ros.noise import sigma_amplitude

#: Entries of the table of distance: half a step times the slope of the cyclic error stays below 0.01 mm.
_DISTANCES = 1 << 17
#: Entries where it is interpolated, and the step in rad of the phase beside it.
_BILINEAR = 1 << 12
_PHASE_STEP = 0.012
#: Relative step of the numerical slope of the amplitude terms.
_STEP = 1e-4


@dataclass(frozen=True)
class ByAmplitude:
    """All that depends on the published amplitude alone.

    ``amplitude`` after undoing the compression, ``term`` [m] (NaN where nothing can be measured),
    ``sigma`` [m] of a distance including what the term adds, ``flags``.
    """

    amplitude: Image
    term: Image
    sigma: Image
    flags: NDArray[np.uint8]


class AmplitudeModel:
    """Evaluates `ByAmplitude` for float amplitudes, and tabulates it for counts."""

    def __init__(
        self, camera: Camera, terms: Sequence[DistanceTerm], context: Context, minimum: float | None
    ) -> None:
        self._camera = camera
        self._terms = terms
        self._context = context
        response = camera.effects.get("amplitude_nonlinearity")
        self._response = response if isinstance(response, AmplitudeNonlinearity) else None
        self.minimum = self._default_minimum() if minimum is None else minimum
        self._table: ByAmplitude | None = None

    def _term(self, amplitude: Image) -> Image:
        total = np.zeros_like(amplitude)
        for one in self._terms:
            total = total + one.term(total, amplitude, self._context)
        return total

    def _slope(self, amplitude: Image) -> Image:
        upper, lower = amplitude * (1 + _STEP), amplitude * (1 - _STEP)
        with np.errstate(invalid="ignore", divide="ignore"):
            result: Image = (self._term(upper) - self._term(lower)) / (upper - lower)
        return result

    def _default_minimum(self) -> float:
        """Return the greatest amplitude at which the amplitude term's noise exceeds the range noise.

        With noise circular in the complex plane that is |d term / dA| * 2 pi A / L > 1.
        """
        if not self._terms:
            return 0.0
        amplitude = np.arange(1.0, FULL_SCALE)
        excess = np.abs(self._slope(amplitude)) * (2 * np.pi / self._camera.sensor.ambiguity) * amplitude
        noisy = np.flatnonzero(~(excess <= 1.0))
        return float(amplitude[noisy[-1]]) if noisy.size else 0.0

    def evaluate(self, published: Image) -> ByAmplitude:
        """Return everything for published amplitudes in counts (float64 of any shape)."""
        camera = self._camera
        amplitude = published if self._response is None else self._response.expanded(published)
        lit = amplitude > 0
        safe = np.where(lit & np.isfinite(amplitude), amplitude, 1.0)
        term = np.where(lit, self._term(safe), np.nan)
        sigma = camera.noise.sigma_distance(safe, background=camera.background)
        if self._terms:
            added = np.nan_to_num(self._slope(safe)) * sigma_amplitude(
                sigma, safe, ambiguity=camera.sensor.ambiguity
            )
            sigma = np.hypot(sigma, added)
        flags = np.zeros(published.shape, np.uint8)
        flags[~(amplitude >= self.minimum) | ~lit] |= Flag.LOW_AMPLITUDE.value
        flags[published >= camera.sensor.saturation] |= Flag.SATURATED.value
        limits = camera.validity.amplitude
        if limits is not None:
            flags[(amplitude < limits[0]) | (amplitude > limits[1])] |= Flag.OUTSIDE_CALIBRATION.value
        term[flags & (Flag.LOW_AMPLITUDE | Flag.SATURATED).value != 0] = np.nan
        amplitude = np.where(np.isfinite(amplitude), amplitude, published)
        return ByAmplitude(amplitude, term, sigma, flags)

    @property
    def table(self) -> ByAmplitude:
        """Everything for each of the 65,536 counts, in float32."""
        if self._table is None:
            exact = self.evaluate(np.arange(FULL_SCALE, dtype=float))
            self._table = ByAmplitude(
                exact.amplitude.astype(np.float32),
                exact.term.astype(np.float32),
                exact.sigma.astype(np.float32),
                exact.flags,
            )
        return self._table


class DistanceSolver:
    """Solves d + sum of terms(d) = y, for terms of the distance and the cyclic error.

    ``exact`` iterates. Else the solution is a table over y: of the nearest entry where the terms depend
    on the distance alone, bilinear in y and in the phase that the gradient adds where they do not.
    """

    def __init__(
        self, camera: Camera, terms: Sequence[DistanceTerm], context: Context, *, exact: bool
    ) -> None:
        self.terms = list(terms)
        self._context = context
        self._ambiguity = camera.sensor.ambiguity
        self._wraps = camera.sensor.wraps
        self._range = self._ambiguity if self._wraps else FULL_SCALE * camera.sensor.lsb
        self._exact = exact
        self._rows: NDArray[np.int32] | None = None
        if not exact and self.terms:
            self._tabulate(context)

    def _tabulate(self, context: Context) -> None:
        cyclic = next((one for one in self.terms if isinstance(one, CyclicError)), None)
        phases = np.zeros(1)
        self._size = _DISTANCES
        if cyclic is not None and any(cyclic.gradient):
            shift = np.asarray(cyclic.phase_shift(context))
            low, high = float(shift.min()), float(shift.max())
            steps = max(2, int(np.ceil((high - low) / _PHASE_STEP)) + 1)
            phases = np.linspace(low, high, steps)
            position = (shift - low) / max(phases[1] - phases[0], 1e-12)
            rows = np.minimum(position.astype(np.int32), steps - 2)
            self._size = _BILINEAR
            self._rows = rows * self._size
            self._share = (position - rows).astype(np.float32)
        y = np.arange(self._size) * (self._range / self._size)
        table = np.stack([self._solved(y, phase, cyclic, context) for phase in phases])
        self._table = np.ascontiguousarray(table.ravel(), np.float32)

    def _solved(
        self, y: Image, phase: float, cyclic: CyclicError | None, context: Context
    ) -> NDArray[np.float64]:
        """Return y - d over a grid of y for one phase."""
        terms = [
            CyclicError(
                harmonics=tuple(replace(h, phase=h.phase + phase) for h in cyclic.harmonics)
            )
            if one is cyclic and cyclic is not None
            else one
            for one in self.terms
        ]
        d = solve_terms(y, lambda x: sum(one.term(x, x, context) for one in terms), context, tolerance=1e-8)
        correction: NDArray[np.float64] = y - d
        if self._wraps:
            correction -= self._ambiguity * np.rint(correction / self._ambiguity)
        return correction

    def solve(self, y: Image) -> Image:
        """Return d for y (H, W) in metres; not wrapped. NaN stays NaN."""
        if not self.terms:
            return y
        if self._exact:
            return solve_terms(
                y, lambda d: sum(one.term(d, d, self._context) for one in self.terms), self._context
            )
        at = y * np.float32(self._size / self._range)
        if self._rows is None:
            at += np.float32(self._size + 0.5 if self._wraps else 0.5)
            index = at.astype(np.int32)
            if self._wraps:
                index &= self._size - 1
            work = np.take(self._table, index, mode="clip")
            return np.subtract(y, work, out=work)
        at += np.float32(self._size if self._wraps else 0)
        index = at.astype(np.int32)
        at -= index
        following = index + 1
        if self._wraps:
            index &= self._size - 1
            following &= self._size - 1
        else:
            np.clip(index, 0, self._size - 2, out=index)
            np.add(index, 1, out=following)
        index += self._rows
        following += self._rows
        near = self._along(index, following, at)
        index += self._size
        following += self._size
        far = self._along(index, following, at)
        far -= near
        far *= self._share
        near += far
        return np.subtract(y, near, out=near)

    def _along(self, index: Image, following: Image, share: Image) -> Image:
        low = np.take(self._table, index, mode="clip")
        high = np.take(self._table, following, mode="clip")
        high -= low
        high *= share
        low += high
        return low


class PlaneTable:
    """Terms of pixel and distance that are linear between knots of the distance, as one stack of maps."""

    def __init__(self, camera: Camera, terms: Sequence[DistanceTerm], context: Context) -> None:
        knots = sorted({float(k) for one in terms for k in distance_knots(one)})
        self._knots = np.array(knots)
        planes = []
        amplitude = np.ones(camera.shape)
        for knot in knots:
            distance = np.full(camera.shape, knot)
            total = np.zeros(camera.shape)
            for one in terms:
                total = total + one.term(distance, amplitude, context)
            planes.append(total)
        self._flat = np.stack(planes).astype(np.float32).ravel()
        self._size = camera.shape[0] * camera.shape[1]
        self._pixel = np.arange(self._size, dtype=np.int32).reshape(camera.shape)
        # position among the knots by distance, tabulated finely enough that its error stays below 1e-3 of a knot
        self._step = max(float(np.diff(self._knots).min()) / 1024 if len(knots) > 1 else 1.0, 1e-4)
        bins = int((self._knots[-1] - self._knots[0]) / self._step) + 2
        at = self._knots[0] + np.arange(bins) * self._step
        self._position = np.interp(at, self._knots, np.arange(len(knots), dtype=float)).astype(np.float32)

    def term(self, distance: Image) -> Image:
        """Return the sum of the terms in metres at distances (H, W) in metres."""
        index = ((distance - np.float32(self._knots[0])) * np.float32(1.0 / self._step)).astype(np.int32)
        position = np.take(self._position, index, mode="clip")
        lower = np.minimum(position.astype(np.int32), len(self._knots) - 2) if len(self._knots) > 1 else 0
        if len(self._knots) == 1:
            return np.take(self._flat, self._pixel)
        share = position - lower
        at = lower * self._size + self._pixel
        below = np.take(self._flat, at, mode="clip")
        above = np.take(self._flat, at + self._size, mode="clip")
        result: Image = below + share * (above - below)
        return result


def distance_knots(term: DistanceTerm) -> tuple[float, ...]:
    """Return the knots of distance of a term that is linear between them, empty where it is not."""
    if isinstance(term, IntegralTable):
        return term.knots[2]
    if isinstance(term, Empirical) and "distance" in term.covariates:
        return term.knots[term.covariates.index("distance")]
    return ()
