"""Angle of incidence from a frame's own distances: planes fitted over 5 x 5 pixels.

On a plane n . X = p the inverse distance is linear in the ray, 1 / d = m . ray with m = n / p. So m
follows from sums over the window that box filters deliver, with one fixed 3 x 3 inverse per window.
Windows stand at every second pixel. One whose residuals exceed the noise holds a step and is not used;
a pixel beside a step takes the plane of a window near it that passes through it (Kahlmann 2007,
sec. 3.3.6: the surface is smooth in parts).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: Side of the window in pixels, and the step from window to window.
WINDOW = 5
STRIDE = 2
#: A window holds a step if its residuals are above this many metres RMS ...
RESIDUAL = 0.006
#: ... and above this many times the noise.
EXCESS = 1.15
#: The plane of a window beside it serves a pixel if it passes within this many metres of it, or two
#: standard deviations of its distance; the nearest one without a search within SURE, or 1.5 of them.
NEAR = 0.03
SURE = 0.004
#: Farthest such window, in windows.
REACH = 2

_DIRECTIONS = np.array([(-2, 0), (2, 0), (0, -2), (0, 2), (-2, -2), (-2, 2), (2, -2), (2, 2)])


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
        # a pixel without a ray is never valid; NaN would spread along the box filter's running sums
        rays = np.nan_to_num(rays)
        self._rays = np.ascontiguousarray(rays.transpose(2, 0, 1))
        self._rays32 = self._rays.astype(np.float32)
        self._rays_by_pixel = np.ascontiguousarray(rays.reshape(-1, 3), np.float32)
        half = WINDOW // 2
        self._centres = (slice(half, height - half, STRIDE), slice(half, width - half, STRIDE))
        product = np.einsum("vui,vuj->ijvu", rays, rays)
        sums = np.array([[_box(product[i, j])[self._centres] for j in range(3)] for i in range(3)])
        self._inverse = np.linalg.pinv(sums.transpose(2, 3, 0, 1), hermitian=True).transpose(2, 3, 0, 1).copy()
        self._grid = self._inverse.shape[2:]
        # the window of each pixel: the one whose centre is nearest
        row = np.clip((np.arange(height) - half + STRIDE // 2) // STRIDE, 0, self._grid[0] - 1)
        column = np.clip((np.arange(width) - half + STRIDE // 2) // STRIDE, 0, self._grid[1] - 1)
        self._row, self._column = row, column
        self._window = (row[:, None] * self._grid[1] + column).astype(np.intp)
        self._square = cv2.getStructuringElement(cv2.MORPH_RECT, (WINDOW, WINDOW))

    def cosine(self, distance: NDArray[Any], sigma: NDArray[Any] | float = 0.0) -> NDArray[np.float32]:
        """Return |ray . normal| (H, W) for distances in metres; NaN where no plane is found.

        ``sigma`` [m] of one distance, (H, W) or one number: noise is not taken for a step.
        """
        if not self._usable:
            return np.full(self.shape, np.nan, np.float32)
        valid = distance > 0
        # float64, because the residuals of a window are a small difference of large sums
        inverse = np.zeros(self.shape)
        np.divide(1.0, distance, out=inverse, where=valid)
        sums = [_box(inverse * ray)[self._centres] for ray in self._rays]
        m = [
            self._inverse[i, 0] * sums[0] + self._inverse[i, 1] * sums[1] + self._inverse[i, 2] * sums[2]
            for i in range(3)
        ]
        good = self._good_windows(inverse, valid, sums, m, sigma)
        planes = np.stack(m, axis=-1).reshape(-1, 3).astype(np.float32)
        norm = np.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
        norm[~good | (norm == 0)] = np.nan
        cosine = np.zeros(self.shape, np.float32)
        for part, ray in zip(m, self._rays32, strict=True):
            normal = np.take((part / norm).astype(np.float32), self._window)
            normal *= ray
            cosine += normal
        np.abs(cosine, out=cosine)
        beside = np.flatnonzero(valid & ~np.take(good, self._window))
        if beside.size and good.any():
            noise = np.take(sigma, beside) if np.ndim(sigma) else np.full(beside.size, sigma)
            cosine.ravel()[beside] = self._beside_steps(
                beside, np.take(distance, beside), noise.astype(np.float32), planes, good
            )
        np.minimum(cosine, np.float32(1.0), out=cosine)
        cosine[~valid] = np.nan
        return cosine

    def _good_windows(
        self,
        inverse: NDArray[Any],
        valid: NDArray[np.bool_],
        sums: list[NDArray[Any]],
        m: list[NDArray[Any]],
        sigma: NDArray[Any] | float,
    ) -> NDArray[np.bool_]:
        """Windows of valid pixels whose plane leaves no more than the noise explains."""
        square = _box(inverse * inverse)[self._centres] - sum(a * b for a, b in zip(m, sums, strict=True))
        if np.ndim(sigma):
            variance = np.nan_to_num(np.square(sigma), nan=0.0, posinf=0.0)
            mean_variance = _box(variance)[self._centres] / WINDOW**2
        else:
            mean_variance = np.square(sigma)
        # residuals of 1 / d times d^2 are metres; 25 observations, 3 unknowns
        scale = np.square(_box(inverse)[self._centres] / WINDOW**2)
        limit = np.maximum(RESIDUAL**2, EXCESS**2 * mean_variance) * scale * scale * (WINDOW**2 - 3)
        whole = cv2.erode(valid.view(np.uint8), self._square, borderType=cv2.BORDER_REPLICATE)
        result: NDArray[np.bool_] = (square <= limit) & (whole[self._centres] > 0)
        return result

    def _beside_steps(
        self,
        pixel: NDArray[np.intp],
        own: NDArray[Any],
        noise: NDArray[np.float32],
        planes: NDArray[np.float32],
        good: NDArray[np.bool_],
    ) -> NDArray[np.float32]:
        """Return the cosines at pixels without a good window of their own, NaN where none beside fits.

        The nearest good window first; where its plane misses the pixel (it lies on the other side of
        a step) the best of those four pixels away in the eight directions.
        """
        _, labels = cv2.distanceTransformWithLabels(
            (~good).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
        )
        at_good = np.flatnonzero(good)
        window_of = np.empty(int(labels.max()) + 1, np.intp)
        window_of[labels.ravel()[at_good]] = at_good
        width = self._grid[1]
        v, u = np.divmod(pixel, self.shape[1])
        row, column = self._row[v], self._column[u]
        nearest = window_of[labels[row, column]]
        far = np.maximum(np.abs(nearest // width - row), np.abs(nearest % width - column)) > REACH
        rays = np.take(self._rays_by_pixel, pixel, axis=0)
        found = np.take(planes, nearest, axis=0)
        miss = _miss(found, rays, own)
        miss[far] = np.inf
        open_ = np.flatnonzero(~(miss < np.maximum(np.float32(SURE), np.float32(1.5) * noise)))
        if open_.size:
            rows = np.clip(row[open_] + _DIRECTIONS[:, :1], 0, self._grid[0] - 1)
            at = rows * width + np.clip(column[open_] + _DIRECTIONS[:, 1:], 0, width - 1)
            candidates = np.take(planes, at, axis=0)
            error = _miss(candidates, rays[open_], own[open_])
            error[~np.take(good, at)] = np.inf
            choice = np.argmin(error, axis=0)
            least = error[choice, np.arange(open_.size)]
            better = np.flatnonzero(least < miss[open_])
            miss[open_[better]] = least[better]
            found[open_[better]] = candidates[choice[better], better]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.abs(np.einsum("ij,ij->i", found, rays)) / np.sqrt(np.einsum("ij,ij->i", found, found))
        along[~(miss < np.maximum(np.float32(NEAR), 2 * noise))] = np.nan
        return along


def _miss(m: NDArray[Any], rays: NDArray[Any], own: NDArray[Any]) -> NDArray[Any]:
    """Metres along the ray between pixels' points and planes (..., 3); inf where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        result: NDArray[Any] = np.abs(1.0 / np.einsum("...j,...j->...", m, rays) - own)
    result[np.isnan(result)] = np.inf
    return result


def _box(values: NDArray[Any]) -> NDArray[Any]:
    return cv2.boxFilter(
        np.ascontiguousarray(values), -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_REPLICATE
    )
