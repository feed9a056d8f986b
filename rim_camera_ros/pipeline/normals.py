"""Angle of incidence from a frame's own distances: planes fitted over 5 x 5 pixels.

On a plane n . X = p the inverse depth W = 1 / z is linear in the ray's ideal image coordinates,
W = m . (x, y, 1) with m = n / p. Mean and slopes of W over a window are linear in W, so that m follows
from them with the mean and the slopes of x and y over the same window, exactly, also for a distorted
lens. Windows stand at every third pixel. One whose residuals exceed the noise holds a step and is
not used; a pixel beside a step takes the plane of a window near it that passes through it
(Kahlmann 2007, sec. 3.3.6: the surface is smooth in parts).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: Side of the window in pixels, and the step from window to window.
WINDOW = 5
STRIDE = 3
#: A window holds a step if its residuals are above this many metres RMS ...
RESIDUAL = 0.006
#: ... and above this many times the noise.
EXCESS = 1.15
#: The plane of a window beside it serves a pixel if it passes within this many metres of it, or three
#: standard deviations of its distance; the nearest one without a search within SURE, or as many of them.
NEAR = 0.03
SURE = 0.004
SIGMAS = 3.0
#: Where windows are searched for such a plane: six pixels away along the diagonals.
_DIRECTIONS = ((-2, -2), (-2, 2), (2, -2), (2, 2))
#: Rows and columns of the window whose noise stands for all.
_SAMPLES = ((0, 4), (2, 2), (4, 0))
_SQUARE_3, _SQUARE_5 = (np.ones((n, n), np.uint8) for n in (3, 5))
_TINY = np.float32(1e-20)
_PIXELS = WINDOW**2
#: Sum over the window of the squares of a pixel's column (or row) beside the centre.
_SPREAD = 50.0
_Plane = NDArray[np.float32]


class IncidenceEstimator:
    """Estimates the cosine of the angle of incidence for one camera geometry.

    ``rays``: unit rays (H, W, 3). A sensor below 5 x 5 pixels gives NaN everywhere.
    """

    def __init__(self, rays: NDArray[np.float64]) -> None:
        self.shape = rays.shape[:2]
        height, width = self.shape
        self._usable = height >= WINDOW and width >= WINDOW
        if not self._usable:
            return
        self._rays = np.ascontiguousarray(rays.transpose(2, 0, 1), np.float32)
        self._fits = fits = _Fits(self.shape, np.float32)
        rows, columns, stride = fits.rows, fits.columns, fits.stride
        x, y = (_Fits(self.shape, np.float64).of(rays[..., i] / rays[..., 2]) for i in (0, 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = x.along_row * y.along_column - x.along_column * y.along_row
            self._inverse = tuple(
                (part / determinant).astype(np.float32)
                for part in (y.along_column, -y.along_row, -x.along_column, x.along_row)
            )
        self._mean = x.mean.astype(np.float32), y.mean.astype(np.float32)
        half = WINDOW // 2
        self._centre_z = np.ones((rows, stride), np.float32)
        self._centre_z[:, :columns] = self._rays[2, half::STRIDE, half::STRIDE][:rows, :columns]
        # the window of each pixel: the one whose centre is nearest
        row = np.clip((np.arange(height) - half + STRIDE // 2) // STRIDE, 0, rows - 1)
        column = np.clip((np.arange(width) - half + STRIDE // 2) // STRIDE, 0, columns - 1)
        self._window = (row[:, None] * stride + column).astype(np.intp)
        self._window += 1
        v, u = np.divmod(np.arange(rows * stride), stride)
        around = [
            np.clip(v + dv, 0, rows - 1) * stride + np.clip(u + du, 0, columns - 1) + 1
            for dv, du in _DIRECTIONS
        ]
        # entry 0 of the windows is none
        self._neighbours = np.zeros((len(_DIRECTIONS), rows * stride + 1), np.intp)
        self._neighbours[:, 1:] = around
        self._numbers = np.arange(1.0, rows * stride + 1, dtype=np.float32).reshape(rows, stride)
        self._level = 1 << (rows * stride + 1).bit_length()
        self._windows = np.full(rows * stride + 1, complex(np.nan, np.nan))
        self._fetched = np.empty(self.shape, np.complex128)
        self._parts = [np.empty(self.shape, np.float32) for _ in range(4)]

    def cosine(self, distance: NDArray[Any], sigma: NDArray[Any] | float = 0.0) -> NDArray[np.float32]:
        """Return |ray . normal| (H, W) for distances in metres; NaN where no plane is found.

        ``sigma`` [m] of one distance, (H, W) or one number: noise is not taken for a step.
        """
        if not self._usable:
            return np.full(self.shape, np.nan, np.float32)
        distance = distance.astype(np.float32, copy=False)
        # a pixel without distance makes everything of its windows NaN
        inverse = distance * self._rays[2]
        np.divide(np.float32(1.0), inverse, out=inverse)
        missing = ~(distance > 0)
        if missing.any():
            inverse[missing] = np.nan
        good = self._planes(inverse, sigma)
        # 16 bytes a window: one access per pixel fetches all of it
        np.take(self._nearest_good(good), self._window, out=self._fetched, mode="wrap")
        x, y, z, scale = cv2.split(self._fetched.view(np.float32).reshape(*self.shape, 4), self._parts)
        x *= self._rays[0]
        y *= self._rays[1]
        z *= self._rays[2]
        z += x
        z += y
        cosine: NDArray[np.float32] = z * scale
        np.abs(cosine, out=cosine)
        unsure = ~(scale > 0)
        if unsure.any():
            miss = np.divide(np.float32(1.0), z, out=z)
            miss -= distance
            np.abs(miss, out=miss)
            noise = np.asarray(sigma, np.float32)
            unsure &= ~((miss < noise * np.float32(SIGMAS)) | (miss < np.float32(SURE)))
            unsure &= ~missing
            at = np.flatnonzero(unsure)
            noise = noise.ravel()[at] if noise.ndim else noise
            cosine.ravel()[at] = self._search(
                at, cosine.ravel()[at], miss.ravel()[at], distance.ravel()[at], noise
            )
        return np.minimum(cosine, np.float32(1.0), out=cosine)

    def _planes(self, inverse: _Plane, sigma: NDArray[Any] | float) -> NDArray[np.bool_]:
        """Fit all windows: m, 0 where noise does not explain the residuals, 1 / |m|; return where it does."""
        fit = self._fits.of(inverse)
        a, b, c, d = self._inverse
        m_x = a * fit.along_row + b * fit.along_column
        m_y = c * fit.along_row + d * fit.along_column
        m_z = fit.mean - m_x * self._mean[0]
        m_z -= m_y * self._mean[1]
        # a change of W by W^2 z is a metre along a ray of that z; 25 observations, 3 unknowns
        scale = fit.mean * fit.mean
        scale *= self._centre_z
        scale *= scale
        scale *= np.float32(_PIXELS - 3)
        scale *= self._greatest_variance(sigma)
        good: NDArray[np.bool_] = fit.residual <= scale
        good[:, self._fits.columns :] = False
        bad = ~good
        for part in (m_x, m_y, m_z):
            np.copyto(part, np.float32(0.0), where=bad)
        norm = np.sqrt(m_x * m_x + m_y * m_y + m_z * m_z)
        norm += _TINY
        np.divide(np.float32(1.0), norm, out=norm)
        entries = self._windows[1:].view(np.float32).reshape(*good.shape, 4)
        cv2.merge([m_x, m_y, m_z, norm], entries)
        return good

    def _greatest_variance(self, sigma: NDArray[Any] | float) -> _Plane | np.float32:
        """Return the greatest mean square of residuals in m^2 that noise explains, by window."""
        if not np.ndim(sigma):
            return np.float32(max(RESIDUAL**2, EXCESS**2 * float(sigma) ** 2))
        # its mean over a few of the window's pixels: the centre would do but for a texture
        height, width = self.shape
        sigma = np.asarray(sigma)
        mean = np.zeros((self._fits.rows, self._fits.stride), np.float32)
        for v, u in _SAMPLES:
            part = sigma[v : height - WINDOW + 1 + v : STRIDE, u : width - WINDOW + 1 + u : STRIDE]
            mean[:, : part.shape[1]] += part * part
        mean *= np.float32(EXCESS**2 / len(_SAMPLES))
        np.clip(mean, np.float32(RESIDUAL**2), np.float32(np.inf), out=mean)
        return mean

    def _nearest_good(self, good: NDArray[np.bool_]) -> NDArray[np.complex128]:
        """Return the windows with bad ones replaced by a good one within reach, 1 / |m| negative in those.

        Without a good one within reach a window is NaN. By maximum filters instead of a distance
        transform: those need no branches, which nobody could predict here.
        """
        if good[:, : self._fits.columns].all():
            return self._windows
        level = np.float32(self._level)
        # numbers of windows from 1, bad ones far below 0; near ones one level above those farther off
        number: _Plane = np.where(good, self._numbers, np.float32(-10.0) * level)
        nearest: Any = cv2.dilate(number, _SQUARE_5)
        next_: Any = cv2.dilate(number, _SQUARE_3)
        next_ += level
        np.maximum(nearest, next_, out=nearest)
        number += level + level
        np.maximum(nearest, number, out=nearest)
        # none within reach: entry 0
        nearest *= nearest > 0
        source = np.zeros(good.size + 1, np.int32)
        source[1:] = nearest.ravel()
        source &= self._level - 1
        result = np.take(self._windows, source)
        scale = result.view(np.float32)[7::4]
        scale *= good.ravel() * np.float32(2.0) - np.float32(1.0)
        return result

    def _search(
        self,
        at: NDArray[np.intp],
        cosine: NDArray[np.float32],
        miss: NDArray[np.float32],
        distance: NDArray[np.float32],
        noise: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the cosines of pixels whose nearest good window may lie on the other side of a step.

        The best plane of it and of the good windows six pixels away along the diagonals; NaN where none
        fits. ``cosine`` and ``miss`` [m] are those of the nearest.
        """
        if at.size == 0:
            return np.empty(0, np.float32)
        around = np.take(self._neighbours, np.take(self._window, at), axis=1)
        entries = np.take(self._windows, around).view(np.float32).reshape(*around.shape, 4)
        x, y, z, scale = cv2.split(entries)
        rays = np.take(self._rays.reshape(3, -1), at, axis=1)
        x *= rays[0]
        y *= rays[1]
        z *= rays[2]
        z += x
        z += y
        scale *= z
        error = np.divide(np.float32(1.0), z, out=z)
        error -= distance
        np.abs(error, out=error)
        least = error.min(axis=0)
        # of the best
        scale *= error == least
        found = np.abs(scale).max(axis=0)
        found = np.where(miss <= least, cosine, found)
        fits = np.fmin(least, miss) < np.maximum(noise * np.float32(SIGMAS), np.float32(NEAR))
        found[~fits] = np.nan
        return found


class _Fits:
    """Planes through an image of W over all windows: mean, slopes per pixel, sum of squares about the plane.

    Relative to the window's centre, so that float32 suffices. The grid of windows is (rows, stride):
    all sums run over flat arrays, in which the last columns of the grid mix rows; they are no windows.
    """

    def __init__(self, shape: tuple[int, int], dtype: Any) -> None:
        width = shape[1]
        self.rows, self.columns = ((n - WINDOW) // STRIDE + 1 for n in shape)
        self.stride = -(-width // STRIDE)
        self._shape = shape
        self._size = self.rows * self.stride
        # every STRIDE-th row, so that a window's rows are slices; columns and rows more that shifts run into
        spare = (WINDOW - 1) // STRIDE
        self._apart = np.zeros((STRIDE, self.rows + spare, STRIDE * self.stride), dtype)
        # of the five rows of a window, by column: middle, sum, slope, sum of squares
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
        """Sum what the columns hold over the five columns of a window."""
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
