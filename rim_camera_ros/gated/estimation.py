"""Images of gates -> distance, amplitude, precision, from ratios of the light that the gates transmit.

The counts of gate i are q_i = A g_i(d) + B w_i: the light A of the pulse with the share g_i(d), and
unmodulated light B in proportion to the gate's width. A cancels in the direction of the vector q. B is
eliminated if there are three gates or more, else it must be known. The direction that fits q best gives a
first distance; Fisher scoring with the noise of photons and read-out gives the final one. Its precision is
the inverse of the Fisher information sum_i dq_i/dtheta dq_i/dtheta' / var_i.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.gated.gates import GatedShutter
from rim_camera_ros.phasor import SPEED_OF_LIGHT

Array = NDArray[Any]

#: Entries of the table of shares over the ambiguity range, and of the grid of the first search.
_ENTRIES, _COARSE = 4096, 256
#: Steps of Fisher's scoring from the grid.
_STEPS = 4
#: Least change of the gates' ratios with distance, and least transmitted light, at a usable distance, as
#: shares of their largest values.
_TELLS, _SEES = 0.02, 0.05
#: Share of the light that a second gate must transmit, within this part of the pulse's depth.
_SHARED, _NEAR = 0.01, 0.05
#: Least variance of an image [counts^2]: that of rounding.
ROUNDING = 1.0 / 12.0
_TINY = 1e-30


@dataclass(frozen=True)
class GateEstimates:
    """Estimates from the images, all (pixels,): distance [m], NaN where the gates do not determine it.

    ``amplitude`` [counts]: light of the pulse. ``sigma`` [m]: Cramer-Rao bound of the distance's standard
    deviation.
    """

    distance: Array
    amplitude: Array
    sigma: Array


class GateEstimator:
    """Evaluates the images of one shutter.

    ``background``: unmodulated light [counts per pulse width], which two gates alone do not determine.

    Raises ValueError if gates do not overlap: then no ratio of them determines a distance.
    """

    def __init__(self, shutter: GatedShutter, *, background: float = 0.0) -> None:
        self.shutter = shutter
        self._step = shutter.ambiguity / _ENTRIES
        #: depth [m] of the pulse, for its way there and back
        self._depth = shutter.pulse_width * SPEED_OF_LIGHT / 2.0
        at = np.arange(_ENTRIES) * self._step
        self._shares = shutter.shares(at)
        small = 1e-3 * self._step
        self._slopes = (shutter.shares(at + small) - shutter.shares(at - small)) / (2.0 * small)
        self._windows = shutter.windows
        self._known = background if len(shutter.gates) < 3 else None
        projection = np.eye(len(shutter.gates))
        if self._known is None:
            unit = self._windows / np.linalg.norm(self._windows)
            projection -= np.outer(unit, unit)
        seen, change = projection @ self._shares, projection @ self._slopes
        length = np.linalg.norm(seen, axis=0)
        # how fast the direction of the vector of the gates turns with distance
        along = (seen * change).sum(axis=0) / np.maximum(length, _TINY)
        turn = np.sqrt(np.maximum((change * change).sum(axis=0) - along**2, 0.0)) / np.maximum(length, _TINY)
        lit = length > _SEES * max(float(length.max()), _TINY)
        turn[~lit] = 0.0
        #: whether gates determine a distance of the table, by more than the tail of an edge in a second gate
        second = np.sort(self._shares, axis=0)[-2]
        near = max(round(_NEAR * self._depth / self._step), 1)
        from scipy.ndimage import maximum_filter1d  # takes a good part of a node's start

        shared = maximum_filter1d(second, 2 * near + 1, mode="wrap") > _SHARED
        self.usable = lit & shared & (turn * self._depth > _TELLS)
        if not self.usable.any():
            raise ValueError("the gates do not overlap: at no distance do two of them see the same pulse")
        chosen = np.flatnonzero(self.usable)
        self._coarse = chosen[:: max(len(chosen) // _COARSE, 1)]
        self._directions = (seen / np.maximum(length, _TINY))[:, self._coarse].astype(np.float32)
        self._projection = projection

    @property
    def limits(self) -> tuple[float, float]:
        """Least and greatest distance [m] that the gates determine."""
        found = np.flatnonzero(self.usable)
        # gates may begin before the pulse: a period ends at the widest gap
        widths = np.diff(found, append=found[0] + _ENTRIES)
        last = int(widths.argmax())
        begin = found[(last + 1) % len(found)]
        begin = 0 if begin > found[last] else begin
        return float(begin * self._step), float(found[last] * self._step)

    def estimate(self, images: Array) -> GateEstimates:
        """Return the estimates of images (gates, pixels) in counts above the black level.

        Raises ValueError for another number of images.
        """
        if images.ndim != 2 or len(images) != len(self.shutter.gates):
            raise ValueError(f"images of shape {images.shape}, expected ({len(self.shutter.gates)}, pixels)")
        q = images.astype(float)
        if self._known is not None:
            q -= self._known * self._windows[:, None]
        fits = (self._projection @ q).astype(np.float32).T @ self._directions
        best = fits.argmax(axis=1)
        distance = self._coarse[best] * self._step
        for _ in range(_STEPS):
            distance, amplitude, variance = self._scored(q, distance)
        entry = np.rint(distance / self._step).astype(int) % _ENTRIES
        near = self.usable[entry] & (fits.max(axis=1) > 0) & (amplitude > 0) & (distance >= 0)
        # where the error may be as large as the pulse there is no measurement
        near &= variance < self._depth**2
        return GateEstimates(
            distance=np.where(near, distance, np.nan),
            amplitude=np.where(near, amplitude, np.maximum(q.sum(axis=0), 0.0)),
            sigma=np.where(near, np.sqrt(variance), np.nan),
        )

    def bound(self, distance: Array, *, amplitude: float) -> Array:
        """Return the Cramer-Rao bound [m] of the standard deviation at distances [m], without other light."""
        light = amplitude * self.shutter.shares(distance)
        return np.asarray(np.sqrt(self._scored(light, distance)[2]))

    def _at(self, distance: Array) -> tuple[Array, Array]:
        """Return shares and slopes (gates, pixels) at distances [m], linear between entries."""
        place = distance / self._step
        below = np.floor(place)
        part = place - below
        entry = below.astype(int) % _ENTRIES
        following = (entry + 1) % _ENTRIES
        one, two = self._shares[:, entry], self._shares[:, following]
        slope = self._slopes[:, entry] * (1.0 - part) + self._slopes[:, following] * part
        # the parabola with both slopes: half the change of the slope over the step
        bend = (self._slopes[:, following] - self._slopes[:, entry]) * (
            part * (part - 1.0) * 0.5 * self._step
        )
        return one * (1.0 - part) + two * part + bend, slope

    def _scored(self, q: Array, distance: Array) -> tuple[Array, Array, Array]:
        """Return distance after one step of scoring, amplitude, and the variance of a distance [m^2]."""
        g, slope = self._at(distance)
        w = np.broadcast_to(self._windows[:, None], g.shape)
        extra = 0.0 if self._known is None else self._known * w
        weight = 1.0 / (np.maximum(q + extra, 0.0) + self.shutter.read_noise**2 + ROUNDING)

        def inner(one: Array, two: Array) -> Array:
            return np.asarray((weight * one * two).sum(axis=0))

        if self._known is None:
            ww = np.maximum(inner(w, w), _TINY)
            g, slope, q = (one - w * (inner(one, w) / ww) for one in (g, slope, q))
        gg = np.maximum(inner(g, g), _TINY)
        amplitude = inner(g, q) / gg
        slope = slope - g * (inner(slope, g) / gg)
        ss = np.maximum(inner(slope, slope), _TINY)
        move = inner(slope, q) / (ss * np.where(np.abs(amplitude) > _TINY, amplitude, np.inf))
        most = 0.25 * self._depth
        variance = 1.0 / np.maximum(ss * amplitude**2, _TINY)
        return distance + np.clip(move, -most, most), amplitude, variance
