"""Term, sigma and flags of a pixel as functions of its published amplitude alone; tabulated for counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.effects.base import DistanceTerm, ResponseEffect
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.frame import Flag
from rim_camera_ros.noise import sigma_amplitude
from rim_camera_ros.pipeline import kernels

#: Relative step of the numerical slope of the amplitude terms.
_STEP = 1e-4


@dataclass(frozen=True)
class ByAmplitude:
    """All that depends on the published amplitude alone.

    ``amplitude`` after undoing the compression; ``term`` [m], NaN where nothing can be measured; ``sigma``
    [m] of a distance, including the noise of the term; ``flags``.
    """

    amplitude: Image
    term: Image
    sigma: Image
    flags: NDArray[np.uint8]

    def astype(self, dtype: Any) -> ByAmplitude:
        """Return a copy in another precision."""
        amplitude, term, sigma = (
            one.astype(dtype, copy=False) for one in (self.amplitude, self.term, self.sigma)
        )
        return ByAmplitude(amplitude, term, sigma, self.flags)


class AmplitudeModel:
    """Evaluates `ByAmplitude` for float amplitudes, and tabulates it for counts."""

    def __init__(
        self,
        camera: Camera,
        terms: Sequence[DistanceTerm],
        response: ResponseEffect | None,
        context: Context,
        minimum: float | None,
    ) -> None:
        self._camera = camera
        self._terms = terms
        self._context = context
        self._response = response
        self.minimum = self._default_minimum() if minimum is None else minimum

    def _term(self, amplitude: Image) -> Image:
        total = np.zeros_like(amplitude)
        for term in self._terms:
            total = total + term.term(total, amplitude, self._context)
        return total

    def _slope(self, amplitude: Image) -> Image:
        upper, lower = amplitude * (1 + _STEP), amplitude * (1 - _STEP)
        with np.errstate(invalid="ignore", divide="ignore"):
            result: Image = (self._term(upper) - self._term(lower)) / (upper - lower)
        return result

    def _default_minimum(self) -> float:
        """Return the greatest amplitude at which the amplitude term's noise exceeds the range noise.

        That is |d term / dA| * 2 pi A / R > 1, R = L with noise circular in the complex plane.
        """
        if not self._terms:
            return 0.0
        amplitude = np.arange(1.0, FULL_SCALE)
        excess = np.abs(self._slope(amplitude)) * (2 * np.pi / self._camera.noise_range) * amplitude
        noisy = np.flatnonzero(~(excess <= 1.0))
        return float(amplitude[noisy[-1]]) if noisy.size else 0.0

    def evaluate(self, published: Image) -> ByAmplitude:
        """Return all values for published amplitudes in counts (float64 of any shape)."""
        camera = self._camera
        amplitude = published if self._response is None else self._response.expanded(published)
        lit = amplitude > 0
        safe = np.where(lit & np.isfinite(amplitude), amplitude, 1.0)
        term = np.where(lit, self._term(safe), np.nan)
        sigma = camera.sigma_distance(safe)
        if self._terms:
            added = np.nan_to_num(self._slope(safe)) * sigma_amplitude(
                sigma, safe, ambiguity=camera.noise_range
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

    def reading(self, raw: Image, dtype: Any) -> AmplitudeReading:
        """Return the values for amplitudes (H, W): by table for counts and float32, else evaluated."""
        saturated = raw >= self._saturation(raw)
        marked = saturated if saturated.any() else None
        if raw.dtype == np.uint16 and dtype == np.float32:
            table = self.table
            if self._response is None:
                amplitude = raw.astype(np.float32)
            else:
                amplitude = look_up(table.amplitude, raw)
            return AmplitudeReading(amplitude, marked, table, raw)
        exact = self.evaluate(np.nan_to_num(raw.astype(np.float64), posinf=0.0, neginf=0.0)).astype(dtype)
        return AmplitudeReading(exact.amplitude, marked, exact, None)

    def _saturation(self, raw: Image) -> float | int:
        # a whole number, so that counts are not compared as float64
        level = self._camera.sensor.saturation
        return level if raw.dtype.kind == "f" else int(np.ceil(level))

    @cached_property
    def compiled(self) -> kernels.CompiledTable:
        """The table, for the compiled reader."""
        by_amplitude = self.table
        amplitude = None if self._response is None else by_amplitude.amplitude
        return kernels.CompiledTable(
            term=by_amplitude.term, amplitude=amplitude, sigma=by_amplitude.sigma, flags=by_amplitude.flags
        )

    @cached_property
    def table(self) -> ByAmplitude:
        """The values for each of the 65,536 counts, in float32."""
        return self.evaluate(np.arange(FULL_SCALE, dtype=float)).astype(np.float32)


class AmplitudeReading:
    """The values for the published amplitudes (H, W) of one frame, in new arrays.

    ``amplitude`` [counts] as in `ByAmplitude`; ``saturated`` (H, W) bool, None if no pixel is saturated; the
    rest is looked up on first use.
    """

    def __init__(
        self,
        amplitude: Image,
        saturated: NDArray[np.bool_] | None,
        source: ByAmplitude,
        raw: NDArray[np.uint16] | None,
    ) -> None:
        self.amplitude, self.saturated = amplitude, saturated
        self._source, self._raw = source, raw

    def term(self, rows: slice) -> Image:
        """Return the term [m] of some rows."""
        term = self._source.term
        return term[rows] if self._raw is None else look_up(term, self._raw[rows])

    @cached_property
    def sigma(self) -> Image:
        """1-sigma in metres of a distance."""
        return self._source.sigma if self._raw is None else look_up(self._source.sigma, self._raw)

    @cached_property
    def flags(self) -> NDArray[np.uint8]:
        return self._source.flags if self._raw is None else look_up(self._source.flags, self._raw)


def _open_cv_looks_up_counts() -> bool:
    """Whether `cv2.LUT` takes 16-bit indices (OpenCV 5)."""
    try:
        cv2.LUT(np.zeros((1, 1), np.uint16), np.zeros(FULL_SCALE, np.float32))
    except cv2.error:
        return False
    return True


_BY_OPEN_CV = _open_cv_looks_up_counts()


def look_up(table: NDArray[Any], raw: NDArray[np.uint16]) -> NDArray[Any]:
    """Return the entries of a table of 65,536 for counts (H, W), a new array."""
    if _BY_OPEN_CV:
        return cv2.LUT(np.ascontiguousarray(raw), table)
    return np.take(table, raw, mode="wrap")
