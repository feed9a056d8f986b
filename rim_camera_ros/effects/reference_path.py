"""Internal reference path (Kahlmann 2007, chapter 4, eqs. 4.1-4.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Effect, Undo
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class ReferencePath(Effect):
    """A path of known length that drifts like the external one, by 1 / scale of it.

    The reference measures nominal + drift / scale, drift being the sum of ``warm_up_drift`` and
    ``ambient_temperature``, in ``pixels`` (u0 v0 u1 v1, inclusive) or on the reference topic. The
    correction subtracts scale * (measured reference - nominal) (eqs. 4.4, 4.5) in place of those two
    terms where the frame has a reference, and falls back on them where it has not. Eq. 4.6 prints the
    linearity correction of the reference as a factor; it is additive, and constant up to the drift.
    """

    name = "reference_path"
    title = "internal reference path"
    observable = "a fixed scene while the camera warms up, with the reference recorded"
    refuted_by = "a reference that does not follow the drift of the scene"
    undo: ClassVar[Undo] = "partial"

    estimated = "elsewhere"
    estimated_elsewhere = "no reading of an internal reference was recorded, or it was not requested"
    predictable = False
    shows_on_a_wall = False
    from_one_pose = True
    follows_frames = True
    needs_all_pixels = True
    stated_by_pixels = True

    nominal: float = quantity("m", "length of the path", minimum=0.0)
    scale: float = quantity("-", "external drift over the reference's", default=1.0, above=0.0, typical=0.2)
    pixels: tuple[int, int, int, int] | None = quantity("px", "u0 v0 u1 v1, inclusive", default=None)

    def check(self, camera: Camera) -> None:
        if self.pixels is None:
            return
        u0, v0, u1, v1 = self.pixels
        if not (0 <= u0 <= u1 < camera.sensor.width and 0 <= v0 <= v1 < camera.sensor.height):
            raise ValueError(
                f"pixels {list(self.pixels)} do not lie within {camera.shape[1]} x {camera.shape[0]}"
            )

    def region(self) -> tuple[slice, slice] | None:
        """Return the rows and columns of the reference pixels."""
        if self.pixels is None:
            return None
        u0, v0, u1, v1 = self.pixels
        return slice(v0, v1 + 1), slice(u0, u1 + 1)

    def reading(self, drift: float) -> float:
        """Return what the reference measures in metres, without noise, for a drift in metres."""
        return self.nominal + drift / self.scale

    def drift(self, reading: float) -> float:
        """Return the drift of the external path in metres for a reading in metres (eqs. 4.3-4.5)."""
        return self.scale * (reading - self.nominal)

    def simulate(self, signal: Signal, context: Context) -> Signal:
        """Leave the external path as it is; the simulator lays the reading into the reference's pixels."""
        return signal

    def sentence(self) -> str:
        return (
            f"reference path: {self.nominal:.3f} m inside the camera; the scene drifts {self.scale:.2g} "
            "times as much as it"
        )

    @classmethod
    def example(cls, camera: Camera) -> ReferencePath:
        w, h = camera.sensor.width, camera.sensor.height
        return cls(nominal=0.85, scale=0.9, pixels=(max(w - 3, 0), 0, w - 1, min(1, h - 1)))


def mean_reading(values: np.ndarray[tuple[int, ...], np.dtype[np.floating]]) -> float | None:
    """Return the mean of the reference pixels' valid distances in metres, None where none is valid."""
    valid = values[np.isfinite(values)]
    return float(valid.mean()) if valid.size else None


# --- scale --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """y = intercept + slope x; ``centre`` is the x at which slope and level are uncorrelated.

    Sigmas are those of the stated errors; ``chi2`` is per degree of freedom.
    """

    intercept: float
    slope: float
    intercept_sigma: float
    slope_sigma: float
    centre: float
    level_sigma: float
    chi2: float


def fit_line(x: ArrayLike, y: ArrayLike, *, x_sigma: ArrayLike, y_sigma: ArrayLike) -> Line:
    """Return the least-squares line through points with errors in both coordinates.

    York et al. 2004, Am. J. Phys. 72, 367, without correlations. ``x``, ``y`` (N,); the sigmas (N,) or
    numbers. An ordinary fit of y on x would find the slope too small by the share of noise in x.

    Raises ValueError for less than three points, or where one has no error in either coordinate.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    vx = np.broadcast_to(np.square(np.asarray(x_sigma, float)), x.shape)
    vy = np.broadcast_to(np.square(np.asarray(y_sigma, float)), x.shape)
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(f"a line needs as many x as y, not {x.shape} and {y.shape}")
    if x.size < 3:
        raise ValueError("a line needs three points or more")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and (vx + vy > 0).all()):
        raise ValueError("a line needs finite points, each with a sigma in one coordinate")
    if np.ptp(x) == 0:
        raise ValueError("a line needs points at different x")
    slope = float(np.polyfit(x - x.mean(), y - y.mean(), 1)[0])
    if slope == 0 and not (vy > 0).all():
        raise ValueError("a line without slope needs errors in y")
    for _ in range(200):
        weight = 1.0 / (vy + slope**2 * vx)
        xm, ym = np.average(x, weights=weight), np.average(y, weights=weight)
        u, v = x - xm, y - ym
        beta = weight * (u * vy + slope * v * vx)
        previous, slope = slope, float(np.sum(weight * beta * v) / np.sum(weight * beta * u))
        if abs(slope - previous) <= 1e-13 * abs(slope):
            break
    total = float(np.sum(weight))
    intercept = float(ym - slope * xm)
    centre = float(np.average(xm + beta, weights=weight))
    slope_sigma = 1.0 / math.sqrt(float(np.sum(weight * (xm + beta - centre) ** 2)))
    return Line(
        intercept=intercept,
        slope=slope,
        intercept_sigma=math.sqrt(1 / total + centre**2 * slope_sigma**2),
        slope_sigma=slope_sigma,
        centre=centre,
        level_sigma=1 / math.sqrt(total),
        chi2=float(np.sum(weight * (y - intercept - slope * x) ** 2)) / (x.size - 2),
    )


@dataclass(frozen=True)
class ReferenceScale:
    """Scale and nominal length [m] of a reference path with 1-sigma, and the RMS [m] of the residuals."""

    scale: float
    scale_sigma: float
    nominal: float
    nominal_sigma: float
    rms: float


#: Relative sigma of the scale above which it is not determined.
_UNDETERMINED = 0.5


def estimate_reference_scale(
    *, drift: ArrayLike, reading: ArrayLike, drift_sigma: ArrayLike, reading_sigma: ArrayLike
) -> ReferenceScale:
    """Return the scale of eq. 4.5: least squares of the drift of a fixed scene on the reference's reading.

    ``drift`` (N,) [m]: measured minus expected distance of a fixed scene, for example the mean over its
    pixels, with every other effect undone; ``reading`` (N,) [m]: the reference at the same frames; their
    1-sigma [m], numbers or (N,). drift = scale (reading - nominal), so that ``nominal`` is the reading
    without drift; where ``drift`` is known up to a constant only, nominal absorbs that constant. No lag is
    assumed. Sigmas are those of the stated errors, raised where the residuals are larger than they; a lag
    or other error that lasts over many frames makes the true ones larger still.

    Raises `InputError` where the drift does not determine the scale, or is opposite to the reading.
    """
    x, y = np.asarray(reading, float), np.asarray(drift, float)
    remedy = "record a fixed scene from power-on, or through a change of temperature"
    try:
        line = fit_line(x, y, x_sigma=reading_sigma, y_sigma=drift_sigma)
    except ValueError as error:
        raise InputError(f"the scale of the reference path: {error}", remedy=remedy) from None
    grown = math.sqrt(max(line.chi2, 1.0))
    scale, scale_sigma = line.slope, line.slope_sigma * grown
    if not scale_sigma < _UNDETERMINED * abs(scale):
        raise InputError(
            f"the reference moves too little to determine its scale ({scale:.2g}, sigma {scale_sigma:.2g})",
            remedy=remedy,
        )
    if scale < 0:
        raise InputError(
            f"the scene drifts against the reference (scale {scale:.2g})",
            remedy="the scene must be fixed and each reading that of its frame",
        )
    nominal = -line.intercept / scale
    return ReferenceScale(
        scale=scale,
        scale_sigma=scale_sigma,
        nominal=nominal,
        nominal_sigma=math.hypot(line.level_sigma * grown, (line.centre - nominal) * scale_sigma) / scale,
        rms=float(np.sqrt(np.mean((y - scale * (x - nominal)) ** 2))),
    )
