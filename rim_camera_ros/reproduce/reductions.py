"""From measurements to the numbers that the thesis prints: fits and statistics, without any camera file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import curve_fit, least_squares

from rim_camera_ros.errors import RimError

Array = NDArray[np.float64]


# --- statistics ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gaussian:
    """a exp(-((x - b) / c)^2) fitted to a histogram (eq. 3.5); ``determination`` is R^2, b and c in m."""

    a: float
    b: float
    c: float
    determination: float

    @property
    def sigma(self) -> float:
        """Standard deviation in m: c / sqrt(2)."""
        return self.c / math.sqrt(2.0)


def fit_histogram(values: ArrayLike, *, bin_width: float) -> Gaussian:
    """Fit eq. 3.5 to the histogram of distances (N,) in m, with bins of ``bin_width`` m.

    Raises `RimError` where fewer than five bins are occupied, or the fit does not converge.
    """
    x = np.asarray(values, float)
    low = math.floor(float(x.min()) / bin_width) - 2
    high = math.ceil(float(x.max()) / bin_width) + 2
    edges = np.arange(low, high + 1) * bin_width
    counts, _ = np.histogram(x, edges)
    if np.count_nonzero(counts) < 5:
        raise RimError(
            f"a histogram with {np.count_nonzero(counts)} occupied bins cannot be fitted",
            remedy="give narrower bins",
        )
    centres = (edges[1:] + edges[:-1]) / 2

    def shape(at: Array, a: float, b: float, c: float) -> Array:
        result: Array = a * np.exp(-(((at - b) / c) ** 2))
        return result

    start = (float(counts.max()), float(x.mean()), math.sqrt(2.0) * float(x.std()))
    (a, b, c), _ = curve_fit(shape, centres, counts, p0=start)
    left = float(np.sum((counts - shape(centres, a, b, c)) ** 2))
    return Gaussian(
        float(a), float(b), abs(float(c)), 1 - left / float(np.sum((counts - counts.mean()) ** 2))
    )


@dataclass(frozen=True)
class NoiseModel:
    """sigma^2 = floor^2 + (slope / A)^2; ``floor`` in m, ``slope`` in m counts (or m times the unit of A)."""

    floor: float
    slope: float


def fit_noise(amplitude: ArrayLike, sigma: ArrayLike) -> NoiseModel:
    """Fit the noise model to standard deviations [m] at amplitudes, all with the same relative weight."""
    a, s = np.asarray(amplitude, float), np.asarray(sigma, float)

    def left(p: Array) -> Array:
        result: Array = np.log(np.sqrt(p[0] ** 2 + (p[1] / a) ** 2)) - np.log(s)
        return result

    start = (float(s.min()) * 0.7, float(np.max(a * s)) * 0.7)
    found = least_squares(left, start, x_scale=start, xtol=1e-14, ftol=1e-14)
    return NoiseModel(abs(float(found.x[0])), abs(float(found.x[1])))


# --- amplitude, angle of incidence -----------------------------------------------------------------


@dataclass(frozen=True)
class HyperbolaFit:
    """d = a / (A - b) + c (eq. 3.6): a [m counts], b [counts], c [m], with 1-sigma."""

    a: float
    b: float
    c: float
    a_sigma: float
    b_sigma: float

    def offset(self, amplitude: Array) -> Array:
        """Return a / (A - b) in m, NaN where A <= b."""
        usable = amplitude > self.b
        return np.where(usable, self.a / np.where(usable, amplitude - self.b, 1.0), np.nan)


def fit_hyperbola(
    amplitude: ArrayLike, distance: ArrayLike, *, distance_sigma: ArrayLike, amplitude_sigma: ArrayLike
) -> HyperbolaFit:
    """Fit eq. 3.6 to mean distances [m] at mean amplitudes [counts], both with their 1-sigma.

    The errors of the amplitudes enter by the slope of the curve (effective variance, three rounds). The pole
    stays below the smallest amplitude. The returned sigmas follow from the stated errors.
    """
    x, y, y_sigma, x_sigma = (
        np.asarray(buffer, float) for buffer in (amplitude, distance, distance_sigma, amplitude_sigma)
    )
    scale = float(np.ptp(y)) / float(1 / x.min() - 1 / x.max())
    found = np.array([scale, 0.0, float(y.min())])
    bounds = ((0.0, -np.inf, -np.inf), (np.inf, float(x.min()) * 0.999, np.inf))
    covariance = np.eye(3)
    for _ in range(3):
        slope = found[0] / (x - found[1]) ** 2
        found, covariance = curve_fit(
            lambda at, a, b, c: a / (at - b) + c,
            x,
            y,
            p0=found,
            sigma=np.hypot(y_sigma, slope * x_sigma),
            absolute_sigma=True,
            bounds=bounds,
            x_scale=(scale, 10.0, 0.01),
        )
    a_sigma, b_sigma, _ = np.sqrt(np.diag(covariance))
    a, b, c = (float(one) for one in found)
    return HyperbolaFit(a, b, c, float(a_sigma), float(b_sigma))


def fit_quartic(gon: ArrayLike, correction: ArrayLike, sigma: ArrayLike | None = None) -> Array:
    """Fit eq. 3.8 with a5 = 0 and return a1 a2 a3 a4 (4,) for the additive correction [m] over gon."""
    x, y = np.asarray(gon, float), np.asarray(correction, float)
    weight = np.ones_like(x) if sigma is None else 1.0 / np.asarray(sigma, float)
    columns = np.stack([(x / 100.0) ** n for n in (4, 3, 2, 1)], axis=1)
    solution = np.linalg.lstsq(columns * weight[:, None], y * weight, rcond=None)[0]
    result: Array = solution / 100.0 ** np.array([4, 3, 2, 1])
    return result


def quartic(gon: ArrayLike, coefficients: ArrayLike) -> Array:
    """Return eq. 3.8 with a5 = 0 in m at angles in gon."""
    x, a = np.asarray(gon, float), np.asarray(coefficients, float)
    result: Array = x * (a[3] + x * (a[2] + x * (a[1] + x * a[0])))
    return result


def fold_angles(gon: ArrayLike, values: ArrayLike) -> tuple[Array, Array]:
    """Return |angle| (n,) and the mean of the values at +angle and -angle, without incomplete pairs."""
    x, y = np.round(np.asarray(gon, float), 6), np.asarray(values, float)
    angles = np.unique(np.abs(x))
    folded = np.array([y[x == angle].sum() / 2 + y[x == -angle].sum() / 2 for angle in angles])
    complete = np.array([(x == angle).any() and (x == -angle).any() for angle in angles]) & np.isfinite(
        folded
    )
    return angles[complete], folded[complete]


# --- linearity -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CyclicFit:
    """offset + slope d + amplitude sin(order 2 pi d / L + phase): m, -, m, rad; 1-sigma of the last two.

    ``chi2``: weighted sum of squared residuals; ``rms`` [m]: root mean square of the residuals, unweighted.
    """

    offset: float
    slope: float
    amplitude: float
    phase: float
    order: int
    amplitude_sigma: float
    phase_sigma: float
    rms: float
    chi2: float

    def cyclic(self, distance: Array, ambiguity: float) -> Array:
        """Return the sinusoid alone in m at distances in m."""
        return self.amplitude * np.sin(self.order * 2 * np.pi / ambiguity * distance + self.phase)


def fit_cyclic(
    distance: ArrayLike, error: ArrayLike, *, ambiguity: float, order: int = 4, sigma: ArrayLike | None = None
) -> CyclicFit:
    """Least squares of the errors [m] over nominal distances [m]; NaN are excluded.

    ``sigma`` (N,) [m] gives weights; the returned sigmas are scaled by the residuals. Raises `RimError` for
    fewer than eight points.
    """
    d, y = np.asarray(distance, float), np.asarray(error, float)
    s = np.ones_like(d) if sigma is None else np.asarray(sigma, float)
    keep = np.isfinite(d) & np.isfinite(y) & np.isfinite(s)
    d, y, s = d[keep], y[keep], s[keep]
    if d.size < 8:
        raise RimError(f"a sinusoid cannot be fitted to {d.size} points", remedy="measure more distances")
    angle = order * 2 * np.pi / ambiguity * d
    middle = float(d.mean())
    columns = np.stack([np.ones_like(d), d - middle, np.sin(angle), np.cos(angle)], axis=1)
    weighted = columns / s[:, None]
    solution, _, _, _ = np.linalg.lstsq(weighted, y / s, rcond=None)
    left = y - columns @ solution
    covariance = np.linalg.inv(weighted.T @ weighted) * float(np.sum((left / s) ** 2)) / (d.size - 4)
    p, q = float(solution[2]), float(solution[3])
    size = math.hypot(p, q)
    along, turned = np.array([p, q]) / size, np.array([-q, p]) / size
    part = covariance[2:, 2:]
    return CyclicFit(
        offset=float(solution[0] - solution[1] * middle),
        slope=float(solution[1]),
        amplitude=size,
        phase=math.atan2(q, p),
        order=order,
        amplitude_sigma=math.sqrt(float(along @ part @ along)),
        phase_sigma=math.sqrt(float(turned @ part @ turned)) / size,
        rms=float(np.sqrt(np.mean(left**2))),
        chi2=float(np.sum((left / s) ** 2)),
    )


def strongest_order(
    distance: ArrayLike, error: ArrayLike, *, ambiguity: float, orders: range, sigma: ArrayLike | None = None
) -> int:
    """Return the number of periods in the ambiguity range whose sinusoid leaves the smallest residuals.

    Offset and slope are fitted with each. Residuals decide and not amplitudes, as a long wave is nearly a
    line.
    """
    left = {
        order: fit_cyclic(distance, error, ambiguity=ambiguity, order=order, sigma=sigma).chi2
        for order in orders
    }
    return min(left, key=lambda order: left[order])


@dataclass(frozen=True)
class Plane:
    """value = constant + by_row row + by_column column, with the RMS of the residuals."""

    constant: float
    by_row: float
    by_column: float
    rms: float

    def at(self, row: ArrayLike, column: ArrayLike) -> Array:
        """Return the plane at rows and columns."""
        result: Array = (
            self.constant + self.by_row * np.asarray(row, float) + self.by_column * np.asarray(column, float)
        )
        return result


def fit_plane(row: ArrayLike, column: ArrayLike, values: ArrayLike, sigma: ArrayLike) -> Plane:
    """Least squares of a plane through values (N,) at rows and columns, weighted by their 1-sigma."""
    r, c, y, s = (np.asarray(buffer, float) for buffer in (row, column, values, sigma))
    columns = np.stack([np.ones_like(r), r, c], axis=1)
    constant, by_row, by_column = np.linalg.lstsq(columns / s[:, None], y / s, rcond=None)[0]
    left = y - columns @ np.array([constant, by_row, by_column])
    return Plane(float(constant), float(by_row), float(by_column), float(np.sqrt(np.mean(left**2))))


# --- drifts ----------------------------------------------------------------------------------------


def settled_after(time: ArrayLike, values: ArrayLike, *, final: float, tolerance: float) -> float:
    """Return the time from which on the values stay within ``tolerance`` of ``final``, interpolated.

    ``time`` (N,) increasing, ``values`` (N,). Returns the first time if they never leave the tolerance, NaN
    if they never settle.
    """
    t, away = np.asarray(time, float), np.abs(np.asarray(values, float) - final)
    outside = np.flatnonzero(away > tolerance)
    if outside.size == 0:
        return float(t[0])
    last = int(outside[-1])
    if last == len(t) - 1:
        return float("nan")
    share = (away[last] - tolerance) / (away[last] - away[last + 1])
    return float(t[last] + share * (t[last + 1] - t[last]))


def moving_mean(values: ArrayLike, width: int) -> Array:
    """Return the running mean over ``width`` values (odd), over fewer at the ends."""
    y = np.asarray(values, float)
    kernel = np.ones(width)
    result: Array = np.convolve(y, kernel, "same") / np.convolve(np.ones_like(y), kernel, "same")
    return result


def half_range(values: ArrayLike) -> float:
    """Return half of the largest minus the smallest value, the x in the thesis' "+-x"."""
    y = np.asarray(values, float)
    y = y[np.isfinite(y)]
    return float(y.max() - y.min()) / 2


def root_mean_square(values: ArrayLike) -> float:
    """Return the root of the mean square of the finite values."""
    y = np.asarray(values, float)
    return float(np.sqrt(np.mean(y[np.isfinite(y)] ** 2)))
