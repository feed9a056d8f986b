"""What one setting of the camera folds into tables, so that a frame costs look-ups instead of formulas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.base import Context, DistanceTerm, Image, solve_terms
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.frame import Flag
from rim_camera_ros.noise import sigma_amplitude

#: Entries of the table of distance: half a step times the slope of the cyclic error stays below 0.01 mm.
_DISTANCES = 1 << 17
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
    """Solves d + sum of terms(d) = y, for terms of the distance (and, for the cyclic error, the pixel).

    Without a gradient of the phase, or with one and a single harmonic, the solution is a table of y
    over the ambiguity range: a shift of the phase by psi is a shift of y by psi L / (2 pi order), and
    a scale divides y and amplitude. Otherwise Newton's first step and fixed-point steps.
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
        self._table: NDArray[np.float32] | None = None
        self._shift: NDArray[np.float32] | None = None
        self._index = np.empty(camera.shape, np.int32)
        self._work = np.empty(camera.shape, np.float32)
        if not exact and self.terms:
            self._tabulate(context)

    def _tabulate(self, context: Context) -> None:
        cyclic = next((one for one in self.terms if isinstance(one, CyclicError)), None)
        shifted = cyclic is not None and any(cyclic.gradient)
        if shifted:
            assert cyclic is not None
            others = [one for one in self.terms if one is not cyclic]
            if len(cyclic.harmonics) != 1 or not all(isinstance(one, DistanceScale) for one in others):
                return
            if others and not self._wraps:
                return
        scale = 1.0 + sum(one.scale for one in self.terms if isinstance(one, DistanceScale))
        y = np.arange(_DISTANCES) * (self._range / _DISTANCES)
        amplitude = np.ones_like(y)
        if shifted:
            assert cyclic is not None
            harmonic = cyclic.harmonics[0]
            plain = CyclicError(harmonics=cyclic.harmonics)
            reach = self._ambiguity / (2 * np.pi * harmonic.order)
            self._shift = (cyclic.phase_shift(context) * reach).astype(np.float32)
            # d (1 + s) + c(d + shift) = y: in x = d + shift, x + c(x) / (1 + s) = y / (1 + s) + shift
            x = solve_terms(y, lambda d: plain.term(d, amplitude, context) / scale, context)
            self._scale = np.float32(1.0 / scale)
        else:
            x = solve_terms(y, lambda d: self._term(d, amplitude), context)
            self._scale = np.float32(1.0)
        correction = y - x
        if self._wraps:
            correction -= self._ambiguity * np.rint(correction / self._ambiguity)
        self._table = correction.astype(np.float32)

    def _term(self, distance: Image, amplitude: Image) -> Image | float:
        total: Image | float = 0.0
        for one in self.terms:
            total = total + one.term(distance, amplitude, self._context)
        return total

    def solve(self, y: Image) -> Image:
        """Return d for y (H, W) in metres; not wrapped. NaN stays NaN."""
        if not self.terms:
            return y
        if self._exact:
            return solve_terms(y, lambda d: self._term(d, d), self._context)
        if self._table is None:
            return self._iterate(y)
        work, index = self._work, self._index
        if self._shift is not None:
            y = y * self._scale if self._scale != 1 else y
            np.add(y, self._shift, out=work)
            np.multiply(work, np.float32(_DISTANCES / self._range), out=work)
        else:
            np.multiply(y, np.float32(_DISTANCES / self._range), out=work)
        if self._wraps:
            work += np.float32(_DISTANCES + 0.5)
            np.copyto(index, work, casting="unsafe")
            np.bitwise_and(index, _DISTANCES - 1, out=index)
        else:
            work += np.float32(0.5)
            np.copyto(index, work, casting="unsafe")
        np.take(self._table, index, out=work, mode="clip")
        return y - work

    def _iterate(self, y: Image) -> Image:
        """Newton's first step on the cyclic error, then fixed-point steps, in float32."""
        d = y
        cyclic = next((one for one in self.terms if isinstance(one, CyclicError)), None)
        if cyclic is not None:
            term, slope = self._cyclic32(cyclic, y, slope=True)
            d = y - term / (np.float32(1.0) + slope)
        others = [one for one in self.terms if one is not cyclic]
        for _ in range(3):
            total = self._cyclic32(cyclic, d, slope=False)[0] if cyclic is not None else np.float32(0.0)
            for one in others:
                total = total + np.asarray(one.term(self._principal(d), d, self._context), np.float32)
            d = y - total
        return d

    def _principal(self, d: Image) -> Image:
        if not self._wraps:
            return d
        length = np.float32(self._ambiguity)
        return d - length * np.floor(d / length)

    def _cyclic32(self, cyclic: CyclicError, d: Image, *, slope: bool) -> tuple[Any, Any]:
        shift = np.asarray(cyclic.phase_shift(self._context), np.float32)
        wave = 2 * np.pi / self._ambiguity
        total: Any = np.float32(0.0)
        rise: Any = np.float32(0.0)
        for h in cyclic.harmonics:
            angle = d * np.float32(h.order * wave) + (shift + np.float32(h.phase))
            total = total + np.float32(h.amplitude) * np.sin(angle)
            if slope:
                rise = rise + np.float32(h.amplitude * h.order * wave) * np.cos(angle)
        return total, rise


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
