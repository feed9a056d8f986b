"""Angle of incidence from a frame's own distances: planes fitted over 5 x 5 pixels.

On a plane n . X = p the inverse distance is linear in the ray, 1 / d = m . ray with m = n / p. So m
follows from sums over the window that box filters deliver, with one fixed 3 x 3 inverse per pixel.
Windows that hold a distance step or an invalid pixel are not used; a pixel beside a step takes m from
the nearest window on its own side (Kahlmann 2007, sec. 3.3.6: the surface is smooth in parts).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: Side of the window in pixels.
WINDOW = 5
#: Second differences above this many metres end a window.
STEP = 0.03
#: A neighbour's plane serves a pixel if it passes within this many metres of it.
NEAR = 0.03



class IncidenceEstimator:
    """Estimates the cosine of the angle of incidence for one camera geometry.

    ``rays``: unit rays (H, W, 3). Works in float32; needs at least 5 x 5 pixels, else everything is NaN.
    """

    def __init__(self, rays: NDArray[np.float64]) -> None:
        self.shape = rays.shape[:2]
        height, width = self.shape
        self._usable = height >= WINDOW and width >= WINDOW
        self._rays = np.ascontiguousarray(rays.transpose(2, 0, 1), np.float32)
        if not self._usable:
            return
        product = np.einsum("vui,vuj->vuij", rays, rays)
        sums = np.empty_like(product)
        for i in range(3):
            for j in range(3):
                sums[..., i, j] = _box(np.ascontiguousarray(product[..., i, j]))
        inner = (slice(2, height - 2), slice(2, width - 2))
        inverse = np.zeros_like(sums)
        inverse[inner] = np.linalg.inv(sums[inner])
        self._inverse = np.ascontiguousarray(inverse.transpose(2, 3, 0, 1), np.float32)
        self._inner = np.zeros(self.shape, bool)
        self._inner[inner] = True
        self._cross = cv2.getStructuringElement(cv2.MORPH_RECT, (WINDOW, WINDOW))

    def cosine(self, distance: NDArray[Any]) -> NDArray[np.float32]:
        """Return |ray . normal| (H, W) for distances in metres; NaN where no plane is found."""
        if not self._usable:
            return np.full(self.shape, np.nan, np.float32)
        d = distance.astype(np.float32, copy=False)
        valid = d > 0
        filled = np.where(valid, d, np.float32(1.0))
        inverse = np.where(valid, 1.0 / filled, np.float32(0.0))
        sums = [_box(inverse * ray) for ray in self._rays]
        m = [sum(self._inverse[i, j] * sums[j] for j in range(3)) for i in range(3)]
        good = self._good_windows(inverse, filled, valid)
        bad = np.flatnonzero(valid & ~good)
        if bad.size:
            self._from_neighbours(m, good, bad, d)
            good.ravel()[bad] = np.isfinite(m[0].ravel()[bad])
        norm = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        along = self._rays[0] * m[0] + self._rays[1] * m[1] + self._rays[2] * m[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = np.abs(along) / norm
        return np.where(good, np.minimum(cosine, np.float32(1.0)), np.float32(np.nan)).astype(np.float32)

    def _good_windows(
        self, inverse: NDArray[Any], filled: NDArray[Any], valid: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Windows without a step, all pixels valid.

        The second difference of 1 / d is small on a plane of any tilt; times d^2 it is metres.
        """
        step = np.zeros(self.shape, np.float32)
        twice = inverse + inverse
        np.abs(inverse[2:] + inverse[:-2] - twice[1:-1], out=step[1:-1])
        across = np.abs(inverse[:, 2:] + inverse[:, :-2] - twice[:, 1:-1])
        np.maximum(step[:, 1:-1], across, out=step[:, 1:-1])
        step *= filled
        step *= filled
        broken = ((step > STEP) | ~valid).view(np.uint8)
        near = cv2.dilate(broken, self._cross, borderType=cv2.BORDER_REPLICATE)
        result: NDArray[np.bool_] = (near == 0) & self._inner
        return result

    def _from_neighbours(
        self, m: list[NDArray[Any]], good: NDArray[np.bool_], bad: NDArray[np.intp], d: NDArray[Any]
    ) -> None:
        """Give bad pixels the plane of the neighbouring window that passes nearest to them."""
        height, width = self.shape
        row, column = np.divmod(bad, width)
        own = d.ravel()[bad]
        rays = [ray.ravel()[bad] for ray in self._rays]
        best = np.full(bad.size, NEAR, np.float32)
        found = [np.full(bad.size, np.nan, np.float32) for _ in range(3)]
        flat = [part.ravel() for part in m]
        usable = good.ravel()
        for reach in (2, 4):
            for dv in (-reach, 0, reach):
                for du in (-reach, 0, reach):
                    if dv == 0 and du == 0:
                        continue
                    at = np.clip(row + dv, 2, height - 3) * width + np.clip(column + du, 2, width - 3)
                    candidate = [part[at] for part in flat]
                    with np.errstate(divide="ignore", invalid="ignore"):
                        there = 1.0 / (
                            candidate[0] * rays[0] + candidate[1] * rays[1] + candidate[2] * rays[2]
                        )
                    error = np.abs(there - own)
                    better = usable[at] & (error < best)
                    best[better] = error[better]
                    for part, value in zip(found, candidate, strict=True):
                        part[better] = value[better]
            # windows two pixels away come first: their planes are the pixel's own where there are any
            if reach == 2:
                open_ = np.isnan(found[0])
                if not open_.any():
                    break
                best[~open_] = 0.0
        for part, value in zip(flat, found, strict=True):
            part[bad] = value


def _box(values: NDArray[Any]) -> NDArray[Any]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_REPLICATE)
