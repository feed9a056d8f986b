"""Planes fitted to the inverse depth over windows of 5 x 5 pixels, wider where noise is high.

On a plane n . X = p the inverse depth W = 1 / z is linear in the ray's ideal image coordinates, W = m . (x,
y, 1) with m = n / p. Mean and slopes of W over a window are linear in W, so that m follows from them with the
mean and the slopes of x and y over the same window, exactly, also for a distorted lens. Windows are placed at
every third pixel. One whose residuals exceed the noise contains a step and is not used.

Over few pixels noise tilts a plane by many degrees, and an angle of incidence, which is never negative, is
too large on average. Planes are therefore also fitted to means of 3 x 3 and 9 x 9 pixels, over windows that
are 15 and 45 pixels wide. A plane that is too uncertain is replaced by the next wider one, if that is
consistent with the noise, and with the mean and the slopes of the narrower window.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.pipeline import kernels, plane_kernels

#: Side of the window in pixels, and the step from window to window, which is also the step between scales.
WINDOW = 5
STRIDE = 3
#: A window contains a step if its residuals are above this many metres RMS (a third at each wider scale) ...
RESIDUAL = 0.006
#: ... and above this many times the noise.
EXCESS = 1.15
#: Scales: windows of 5, 15 and 45 pixels.
SCALES = 3
#: 1-sigma of a plane's tilt [rad] above which the next wider window is used.
TILT = 0.02
#: It is used where it passes within so many metres or standard deviations of the window's mean, ...
NEAR = 0.004
SIGMAS = 3.0
#: ... and its slopes agree within this many metres per pixel plus so many standard deviations.
SLOPE = 0.0008
SLOPE_SIGMAS = 4.0
#: Rows and columns of the pixels in a window from which its noise is computed.
_SAMPLES = ((0, 4), (2, 2), (4, 0))
_SQUARE_3, _SQUARE_5 = (np.ones((n, n), np.uint8) for n in (3, 5))
_TINY = np.float32(1e-20)
_PIXELS = WINDOW**2
#: Sum over the window of the squared distance of the pixels' columns (or rows) from the centre.
_SPREAD = 50.0
_Plane = NDArray[np.float32]


class PlaneWindows:
    """Planes over the windows of an image; ``x``, ``y`` (H, W) ideal image coordinates, ``z`` of unit rays.

    ``entries`` (rows * stride + 1) hold m and 1 / |m| of each window as four float32; entry 0 stands for no
    window. The image must have at least 5 x 5 pixels.
    """

    def __init__(
        self, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], *, scale: int = 0
    ) -> None:
        self.shape = x.shape
        self._factor = np.float32(STRIDE**scale)
        self._fits = fits = _Fits(self.shape, np.float32)
        self.rows, self.columns, self.stride = fits.rows, fits.columns, fits.stride
        across, down = (_Fits(self.shape, np.float64).of(one) for one in (x, y))
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = across.along_row * down.along_column - across.along_column * down.along_row
            self._inverse = tuple(
                (part / determinant).astype(np.float32)
                for part in (down.along_column, -down.along_row, -across.along_column, across.along_row)
            )
        slopes = (across.along_row, down.along_row, across.along_column, down.along_column)
        self._slopes = tuple(slope.astype(np.float32) for slope in slopes)
        self._mean = across.mean.astype(np.float32), down.mean.astype(np.float32)
        #: tilt in rad of a plane per relative change of W from pixel to pixel
        self._tilt = np.float32(1.0) / np.sqrt(np.abs(determinant)).astype(np.float32)
        self._centre_z = np.ones((self.rows, self.stride), np.float32)
        half = WINDOW // 2
        self._centre_z[:, : self.columns] = z[half::STRIDE, half::STRIDE][: self.rows, : self.columns]
        numbers = np.arange(1.0, self.rows * self.stride + 1, dtype=np.float32)
        self._numbers = numbers.reshape(self.rows, self.stride)
        self._level = 1 << (self.rows * self.stride + 1).bit_length()
        self.entries = np.full(self.rows * self.stride + 1, complex(np.nan, np.nan))
        self._wider: PlaneWindows | None = None
        if scale + 1 < SCALES and min(self.shape) // STRIDE >= WINDOW:
            self._wider = PlaneWindows(*(_means(one) for one in (x, y, z)), scale=scale + 1)
            v, u = (
                np.clip((np.arange(n) - WINDOW // 2 + STRIDE // 2) // STRIDE, 0, most - 1)
                for n, most in ((self.rows, self._wider.rows), (self.stride, self._wider.columns))
            )
            self._over = (v[:, None] * self._wider.stride + u).astype(np.intp) + 1
        self._compiled = None
        if kernels.LIBRARY is not None:
            self._compiled = plane_kernels.CompiledWindows(
                self.shape,
                columns=self.columns,
                inverse=self._inverse,
                mean=self._mean,
                tilt=self._tilt,
                centre_z=self._centre_z,
                slopes=self._slopes,
                over=None if self._wider is None else self._over,
                entries=self.entries,
            )

    def planes(self, inverse: _Plane, sigma: NDArray[Any] | float) -> NDArray[np.complex128]:
        """Return `entries` of the inverse depth W (H, W), bad ones replaced as `_nearest_good` says.

        ``sigma`` [m] of one distance, (H, W) or one number. W is NaN without a distance, which makes all
        windows of the pixel bad.
        """
        if self._compiled is not None:
            return self._compiled_planes(self._compiled, inverse, sigma)
        fit = self._fits.of(inverse)
        a, b, c, d = self._inverse
        m_x = a * fit.along_row + b * fit.along_column
        m_y = c * fit.along_row + d * fit.along_column
        m_z = fit.mean - m_x * self._mean[0]
        m_z -= m_y * self._mean[1]
        # along a ray with that z, a change of W by W^2 z is one metre
        metre = fit.mean * fit.mean
        metre *= self._centre_z
        variance = self._variance(sigma)
        # 25 observations, 3 unknowns
        most = np.maximum(variance * np.float32(EXCESS**2), np.float32(RESIDUAL / self._factor) ** 2)
        good: NDArray[np.bool_] = fit.residual <= metre * metre * np.float32(_PIXELS - 3) * most
        good[:, self.columns :] = False
        if self._wider is not None:
            noise = np.sqrt(variance)
            noisy = noise * metre * self._tilt > np.float32(TILT * np.sqrt(_SPREAD)) * fit.mean
            noisy &= good
            if noisy.any():
                self._widen((m_x, m_y, m_z), noisy, metre, noise, inverse, sigma)
        bad = ~good
        for part in (m_x, m_y, m_z):
            np.copyto(part, np.float32(0.0), where=bad)
        norm = np.sqrt(m_x * m_x + m_y * m_y + m_z * m_z)
        norm += _TINY
        np.divide(np.float32(1.0), norm, out=norm)
        cv2.merge([m_x, m_y, m_z, norm], self.entries[1:].view(np.float32).reshape(*good.shape, 4))
        return self._nearest_good(good)

    def _widen(
        self,
        plane: tuple[_Plane, _Plane, _Plane],
        noisy: NDArray[np.bool_],
        metre: _Plane,
        noise: _Plane | np.float32,
        inverse: _Plane,
        sigma: NDArray[Any] | float,
    ) -> None:
        """Replace noisy planes by wider ones, where these agree with mean and slopes of the window itself."""
        assert self._wider is not None
        entries = self._wider.planes(_means(inverse), self._sparse(sigma))
        found = np.take(entries, self._over).view(np.float32).reshape(*self._over.shape, 4)
        x, y, z, _ = cv2.split(found)
        fit = self._fits
        mean = x * self._mean[0] + y * self._mean[1] + z
        away = np.abs(mean - fit.mean)
        agrees = away <= metre * np.maximum(
            noise * np.float32(SIGMAS / WINDOW), np.float32(NEAR / self._factor)
        )
        # the tolerance is not so wide that the slopes of any other surface would pass
        most = metre * (
            noise * np.float32(SLOPE_SIGMAS / np.sqrt(_SPREAD)) + np.float32(SLOPE / self._factor)
        )
        x_row, y_row, x_column, y_column = self._slopes
        agrees &= np.abs(x * x_row + y * y_row - fit.along_row) <= most
        agrees &= np.abs(x * x_column + y * y_column - fit.along_column) <= most
        agrees &= noisy
        for part, wide in zip(plane, (x, y, z), strict=True):
            np.copyto(part, wide, where=agrees)

    def _sparse(self, sigma: NDArray[Any] | float) -> NDArray[Any] | float:
        """Return sigma for the next wider scale."""
        if not np.ndim(sigma):
            return sigma
        height, width = (STRIDE * (n // STRIDE) for n in self.shape)
        return np.asarray(sigma)[1:height:STRIDE, 1:width:STRIDE]

    def _compiled_planes(
        self, compiled: plane_kernels.CompiledWindows, inverse: _Plane, sigma: NDArray[Any] | float
    ) -> NDArray[np.complex128]:
        factor = float(self._factor)
        asked = compiled.fit(inverse, sigma, factor=factor, excess=EXCESS, residual=RESIDUAL, tilt=TILT)
        if asked and self._wider is not None:
            compiled.widen(
                self._wider.planes(_means(inverse), self._sparse(sigma)),
                mean_sigmas=SIGMAS / WINDOW,
                near=NEAR / factor,
                slope_sigmas=SLOPE_SIGMAS / float(np.sqrt(_SPREAD)),
                slope=SLOPE / factor,
            )
        return compiled.entries()

    def _variance(self, sigma: NDArray[Any] | float) -> _Plane | np.float32:
        """Return the variance [m^2] of a distance of this scale by window."""
        shrunk = np.float32(1.0) / (self._factor * self._factor)
        if not np.ndim(sigma):
            return np.float32(sigma) ** 2 * shrunk
        # the mean over a few pixels of the window: on a texture the centre alone does not suffice
        height, width = self.shape
        sigma = np.asarray(sigma)
        mean = np.zeros((self.rows, self.stride), np.float32)
        for v, u in _SAMPLES:
            part = sigma[v : height - WINDOW + 1 + v : STRIDE, u : width - WINDOW + 1 + u : STRIDE]
            mean[:, : part.shape[1]] += part * part
        mean *= shrunk / np.float32(len(_SAMPLES))
        return mean

    def _nearest_good(self, good: NDArray[np.bool_]) -> NDArray[np.complex128]:
        """Return the windows, bad ones replaced by a good one nearby, with a negative 1 / |m|.

        Without a good one nearby a window is NaN. This uses maximum filters instead of a distance transform,
        as they need no branches, which would be unpredictable here.
        """
        if good[:, : self.columns].all():
            return self.entries
        level = np.float32(self._level)
        # numbers of windows from 1, bad ones far below 0; near ones one level above those farther away
        number: _Plane = np.where(good, self._numbers, np.float32(-10.0) * level)
        nearest: Any = cv2.dilate(number, _SQUARE_5)
        next_: Any = cv2.dilate(number, _SQUARE_3)
        next_ += level
        np.maximum(nearest, next_, out=nearest)
        number += level + level
        np.maximum(nearest, number, out=nearest)
        # none nearby: entry 0
        nearest *= nearest > 0
        source = np.zeros(good.size + 1, np.int32)
        source[1:] = nearest.ravel()
        source &= self._level - 1
        result = np.take(self.entries, source)
        scale = result.view(np.float32)[7::4]
        scale *= good.ravel() * np.float32(2.0) - np.float32(1.0)
        return result


def _means(image: NDArray[Any]) -> NDArray[Any]:
    """Return the means of blocks of 3 x 3 pixels; NaN where one of them is NaN."""
    height, width = (n // STRIDE for n in image.shape)
    part = np.ascontiguousarray(image[: STRIDE * height, : STRIDE * width])
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA))


class _Fits:
    """Planes through an image of W over all windows: mean, slopes per pixel, sum of squares about the plane.

    Coordinates are relative to the window's centre, so that float32 suffices. The grid of windows is
    (rows, stride). All sums run over flat arrays; the last columns of the grid mix rows and are no windows.
    """

    def __init__(self, shape: tuple[int, int], dtype: Any) -> None:
        width = shape[1]
        self.rows, self.columns = ((n - WINDOW) // STRIDE + 1 for n in shape)
        self.stride = -(-width // STRIDE)
        self._shape = shape
        self._size = self.rows * self.stride
        # every STRIDE-th row, so that a window's rows are slices; spare columns and rows for the shifts
        spare = (WINDOW - 1) // STRIDE
        self._apart = np.zeros((STRIDE, self.rows + spare, STRIDE * self.stride), dtype)
        # by column, over the five rows of a window: middle, sum, slope, sum of squares
        self._down = np.zeros((4, self.rows, STRIDE * self.stride), dtype)
        self._columns = np.zeros((STRIDE, 4 * self._size + spare), dtype)

    def of(self, values: NDArray[Any]) -> _Fits:
        """Fit to the image (H, W)."""
        width = self._shape[1]
        for first, part in enumerate(self._apart):
            rows = values[first::STRIDE][: len(part)]
            part[: len(rows), :width] = rows
        row = [self._apart[i % STRIDE, i // STRIDE :][: self.rows] for i in range(WINDOW)]
        middle, total, slope, square = self._down
        np.copyto(middle, row[2])
        above2, above, below, below2 = (row[i] - middle for i in (0, 1, 3, 4))
        np.add(above2, above, out=total)
        total += below
        total += below2
        np.subtract(below2, above2, out=slope)
        slope += slope
        slope += below
        slope -= above
        np.multiply(above2, above2, out=square)
        for one in (above, below, below2):
            one *= one
            square += one
        self._along_rows()
        return self

    def _along_rows(self) -> None:
        """Sum the values of the columns over the five columns of a window."""
        # every STRIDE-th column, so that a window's columns are slices
        size = self._size
        apart = [part[: 4 * size].reshape(-1, self.stride) for part in self._columns]
        cv2.split(self._down.reshape(4 * self.rows, self.stride, STRIDE), apart)
        middle, total, slope, square = (
            [self._columns[j % STRIDE, k * size + j // STRIDE :][:size] for j in range(WINDOW)]
            for k in range(4)
        )
        centre, first, along_column, second = (one[2].copy() for one in (middle, total, slope, square))
        number = centre.dtype.type
        sums = []
        for j in (0, 1, 3, 4):
            step = middle[j] - centre
            sum_ = step * number(WINDOW)
            sum_ += total[j]
            first += sum_
            along_column += slope[j]
            second += square[j]
            step *= sum_ + total[j]
            second += step
            sums.append(sum_)
        along_row = sums[3] - sums[0]
        along_row += along_row
        along_row += sums[2]
        along_row -= sums[1]
        first *= number(1 / _PIXELS)
        along_row *= number(1 / _SPREAD)
        along_column *= number(1 / _SPREAD)
        second -= number(_PIXELS) * first * first
        second -= number(_SPREAD) * (along_row * along_row + along_column * along_column)
        centre += first
        grid = (self.rows, self.stride)
        self.mean, self.residual = centre.reshape(grid), second.reshape(grid)
        self.along_row, self.along_column = along_row.reshape(grid), along_column.reshape(grid)
