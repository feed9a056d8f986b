"""Angle of incidence from a frame's own distances, by planes fitted over windows.

For a pixel next to a step the plane of a nearby window is used that passes through the pixel (Kahlmann 2007,
sec. 3.3.6: the surface is smooth in parts). The thesis fits over 5 x 5 pixels. Where noise would tilt so
small a plane too much, wider windows are used (`rim_camera_ros.pipeline.planes`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.pipeline import kernels, plane_kernels
from rim_camera_ros.pipeline.planes import STRIDE, WINDOW, PlaneWindows

#: The plane of a nearby window is used for a pixel if it passes within this many metres of it, or within
#: three standard deviations of its distance. That of the nearest window is used without a search of others if
#: it passes within SURE, or within as many standard deviations.
NEAR = 0.03
SURE = 0.004
SIGMAS = 3.0
#: Where windows are searched for such a plane: six pixels away along the diagonals.
_DIRECTIONS = ((-2, -2), (-2, 2), (2, -2), (2, 2))


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
        x, y = (rays[..., i] / rays[..., 2] for i in (0, 1))
        self._planes = planes = PlaneWindows(x, y, rays[..., 2])
        rows, columns, stride = planes.rows, planes.columns, planes.stride
        half = WINDOW // 2
        # the window of each pixel is the one with the nearest centre
        row = np.clip((np.arange(height) - half + STRIDE // 2) // STRIDE, 0, rows - 1)
        column = np.clip((np.arange(width) - half + STRIDE // 2) // STRIDE, 0, columns - 1)
        self._window = (row[:, None] * stride + column).astype(np.intp)
        self._window += 1
        v, u = np.divmod(np.arange(rows * stride), stride)
        around = [
            np.clip(v + dv, 0, rows - 1) * stride + np.clip(u + du, 0, columns - 1) + 1
            for dv, du in _DIRECTIONS
        ]
        # entry 0 of the windows stands for no window
        self._neighbours = np.zeros((len(_DIRECTIONS), rows * stride + 1), np.intp)
        self._neighbours[:, 1:] = around
        self._fetched = np.empty(self.shape, np.complex128)
        self._parts = [np.empty(self.shape, np.float32) for _ in range(4)]

    def cosine(self, distance: NDArray[Any], sigma: NDArray[Any] | float = 0.0) -> NDArray[np.float32]:
        """Return |ray . normal| (H, W) for distances in metres; NaN where no plane is found.

        ``sigma`` [m] of one distance, (H, W) or one number, by which noise is distinguished from a step.
        """
        if not self._usable:
            return np.full(self.shape, np.nan, np.float32)
        distance = distance.astype(np.float32, copy=False)
        # a pixel without distance makes all values of its windows NaN
        inverse = distance * self._rays[2]
        np.divide(np.float32(1.0), inverse, out=inverse)
        missing = ~(distance > 0)
        if missing.any():
            inverse[missing] = np.nan
        entries = self._planes.planes(inverse, sigma)
        if kernels.LIBRARY is not None:
            return plane_kernels.cosine(
                distance,
                sigma,
                rays=self._rays,
                entries=entries,
                window=self._window,
                neighbours=self._neighbours,
                near=NEAR,
                sure=SURE,
                sigmas=SIGMAS,
            )
        # 16 bytes a window: one access per pixel fetches all of it
        np.take(entries, self._window, out=self._fetched, mode="wrap")
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

    def _search(
        self,
        at: NDArray[np.intp],
        cosine: NDArray[np.float32],
        miss: NDArray[np.float32],
        distance: NDArray[np.float32],
        noise: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the cosines of pixels whose nearest good window may lie on the other side of a step.

        The plane that fits best is used, of this window and of the good windows six pixels away along the
        diagonals; NaN where none fits. ``cosine`` and ``miss`` [m] are those of the nearest window.
        """
        if at.size == 0:
            return np.empty(0, np.float32)
        around = np.take(self._neighbours, np.take(self._window, at), axis=1)
        entries = np.take(self._planes.entries, around).view(np.float32).reshape(*around.shape, 4)
        x, y, z, scale = cv2.split(entries)
        rays = np.take(self._rays.reshape(3, -1), at, axis=1)
        x *= rays[0]
        y *= rays[1]
        z *= rays[2]
        z += x
        z += y
        scale *= z
        with np.errstate(divide="ignore"):  # a ray parallel to the plane never meets it
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
