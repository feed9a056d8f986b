"""The compiled functions that fit planes to windows of an image and find angles of incidence from them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.kernels import Image


class _Grid(ctypes.Structure):
    _fields_ = [(name, kernels.WHOLE) for name in ("width", "rows", "columns", "stride")]


class _Geometry(ctypes.Structure):
    _fields_ = [
        ("inverse", kernels.POINTER * 4),
        *[(name, kernels.POINTER) for name in ("mean_x", "mean_y", "tilt", "centre_z")],
        ("slopes", kernels.POINTER * 4),
        ("over", kernels.POINTER),
    ]


class _Windows(ctypes.Structure):
    _fields_ = [
        (name, kernels.POINTER)
        for name in (
            *("mean", "along_row", "along_column", "residual", "x", "y", "z", "metre", "noise"),
            *("good", "noisy"),
        )
    ]


class CompiledWindows:
    """The computation of `rim_camera_ros.pipeline.planes.PlaneWindows`, with its arrays.

    The arrays are (rows, stride) and are kept here; ``over`` is None where there are no wider windows.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        columns: int,
        inverse: Sequence[Image],
        mean: Sequence[Image],
        tilt: Image,
        centre_z: Image,
        slopes: Sequence[Image],
        over: NDArray[np.intp] | None,
        entries: NDArray[np.complex128],
    ) -> None:
        rows, stride = tilt.shape
        self._held = [
            np.ascontiguousarray(one, np.float32) for one in (*inverse, *mean, tilt, centre_z, *slopes)
        ]
        self._over = np.zeros(1, np.int64) if over is None else np.ascontiguousarray(over, np.int64)
        addresses = [one.ctypes.data for one in self._held]
        geometry = _Geometry(
            (kernels.POINTER * 4)(*addresses[:4]),
            *addresses[4:8],
            (kernels.POINTER * 4)(*addresses[8:]),
            self._over.ctypes.data,
        )
        self._numbers = np.zeros((9, rows, stride), np.float32)
        self._states = np.zeros((2, rows, stride), np.uint8)
        windows = _Windows(*(number.ctypes.data for number in (*self._numbers, *self._states)))
        self._columns = np.empty((4, shape[1]), np.float32)
        self._entries = entries
        self._structures = _Grid(shape[1], rows, columns, stride), geometry, windows
        self._grid, self._geometry, self._windows = (
            ctypes.addressof(structure) for structure in self._structures
        )

    def fit(
        self,
        inverse_depth: Image,
        sigma: NDArray[Any] | float,
        *,
        factor: float,
        excess: float,
        residual: float,
        tilt: float,
    ) -> bool:
        """Fit planes; return whether some are so uncertain that wider windows are needed."""
        noise = np.asarray(sigma, np.float32)
        row, column = (stride // noise.itemsize for stride in noise.strides) if noise.ndim else (0, 0)
        inverse_depth = np.ascontiguousarray(inverse_depth, np.float32)
        return bool(
            kernels.LIBRARY.rim_planes(
                self._grid,
                self._geometry,
                self._windows,
                kernels.address(inverse_depth),
                noise.ctypes.data,
                row,
                column,
                factor,
                excess,
                residual,
                tilt,
                kernels.address(self._columns),
            )
        )

    def widen(
        self,
        wider: NDArray[np.complex128],
        *,
        mean_sigmas: float,
        near: float,
        slope_sigmas: float,
        slope: float,
    ) -> None:
        """Replace noisy planes by wider ones, given by their entries, where the two agree."""
        kernels.LIBRARY.rim_widen(
            self._grid,
            self._geometry,
            self._windows,
            kernels.address(wider),
            mean_sigmas,
            near,
            slope_sigmas,
            slope,
        )

    def entries(self) -> NDArray[np.complex128]:
        """Return the entries of all windows, bad ones replaced by a good one nearby."""
        kernels.LIBRARY.rim_entries(self._grid, self._windows, kernels.address(self._entries))
        return self._entries


def cosine(
    distance: Image,
    sigma: NDArray[Any] | float,
    *,
    rays: Image,
    entries: NDArray[np.complex128],
    window: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    near: float,
    sure: float,
    sigmas: float,
) -> Image:
    """Return the cosines of `rim_camera_ros.pipeline.normals.IncidenceEstimator` (H, W), a new array."""
    result = np.empty(distance.shape, np.float32)
    distance = np.ascontiguousarray(distance, np.float32)
    noise = np.ascontiguousarray(sigma if np.ndim(sigma) else np.full(result.shape, sigma), np.float32)
    planes = np.empty((4, result.shape[1]), np.float32)
    kernels.LIBRARY.rim_cosine(
        *result.shape,
        kernels.address(distance),
        kernels.address(noise),
        kernels.address(rays),
        kernels.address(entries),
        kernels.address(window),
        kernels.address(neighbours),
        neighbours.shape[1],
        near,
        sure,
        sigmas,
        kernels.address(planes),
        kernels.address(result),
    )
    return result
