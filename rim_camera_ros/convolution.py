"""Spreading of light over the array: sums of Gaussians and a ghost, forward and undone exactly.

The operator is H = d I + sum_i w_i G_i + w_g T, on the sensor with zero outside. A Gaussian that is
separable and truncated at the sensor's edge is a pair of symmetric Toeplitz matrices, S -> V S U.
Wide ones have few significant eigenvalues (about 5.3 n / (pi sigma) + 4 of n above 1e-6), so that they act
within a small subspace. S is projected on it, the halo is solved there, and the result is expanded again.
This inverts the truncated operator itself; division in the Fourier domain would treat light that fell beside
the sensor as measured zeros.

No regularisation is needed within the stated bounds, because G_i is positive semidefinite; noise is
amplified by at most 1 / (d - w_g). Components of the halo below `subspace.KEEP` of the total of its kernel
are not undone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.subspace import (
    CONVERGED,
    Subspace,
    gaussian_matrix,
    gaussian_matrix_by_sigma,
    gaussian_profile,
)

__all__ = [
    "Spreading",
    "complex_image",
    "gaussian_matrix",
    "gaussian_matrix_by_sigma",
    "gaussian_profile",
    "planar",
    "shift",
]

Real = NDArray[Any]

#: Share of the light by which a guess may be wrong, and share that is negligible relative to the direct light
#: once it is spread over a halo (a phase of that many rad is 0.006 mm at 20 MHz).
_GUESS = 0.01
_LOCAL = 5e-6
#: Kernels narrower than this many pixels are applied in space, wider ones in the subspace.
_NARROW = 2.5


def shift(image: NDArray[Any], *, columns: float, rows: float) -> NDArray[Any]:
    """Return image(u - columns, v - rows), bilinear between pixels, zero outside.

    Rows are axis 0, columns the last axis.
    """
    result = np.zeros_like(image)
    _add_shifted(result, image, 1.0, columns=columns, rows=rows)
    return result


def _add_shifted(
    to: NDArray[Any], image: NDArray[Any], factor: float, *, columns: float, rows: float
) -> None:
    """Add factor * image(u - columns, v - rows) to an image in place."""
    whole_u, whole_v = int(np.floor(columns)), int(np.floor(rows))
    part_u, part_v = columns - whole_u, rows - whole_v
    for du, weight_u in ((whole_u, 1 - part_u), (whole_u + 1, part_u)):
        for dv, weight_v in ((whole_v, 1 - part_v), (whole_v + 1, part_v)):
            weight = factor * weight_u * weight_v
            if weight == 0 or abs(du) >= image.shape[-1] or abs(dv) >= image.shape[0]:
                continue
            to_v, from_v = _overlap(image.shape[0], dv)
            to_u, from_u = _overlap(image.shape[-1], du)
            for part, moved in zip(
                _planes(to[to_v, ..., to_u]), _planes(image[from_v, ..., from_u]), strict=True
            ):
                cv2.scaleAdd(moved, weight, part, dst=part)


def _planes(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Return views for OpenCV of the numbers in an image (H, W), complex or not, or (H, 2, W)."""
    if np.iscomplexobj(image):
        return [image.view(image.real.dtype).reshape(*image.shape, 2)]
    return [image] if image.ndim == 2 else [image[:, i] for i in range(image.shape[1])]


def _overlap(size: int, step: int) -> tuple[slice, slice]:
    if step >= 0:
        return slice(step, size), slice(0, size - step)
    return slice(0, size + step), slice(-step, size)


class Spreading:
    """The operator H for one sensor size; works on planar complex images (H, 2, W) of its dtype.

    ``kernels``: (weight, sigma along the row [px], sigma along the column [px]); ``ghost``: (weight,
    shift in columns, shift in rows [px]) or None. The direct weight d is 1 minus all weights.

    Raises ValueError where the weights leave less than 5 % of the light in its place, or the weight of a
    ghost is as large as the remaining one.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        kernels: Sequence[tuple[float, float, float]],
        ghost: tuple[float, float, float] | None,
        *,
        dtype: Any = np.float64,
    ) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.ghost = ghost if ghost is not None and ghost[0] != 0 else None
        self.direct = 1.0 - sum(k[0] for k in kernels) - (ghost[0] if ghost else 0.0)
        if self.direct < 0.05:
            raise ValueError(f"the weights leave only {self.direct:.3g} of the light in its place")
        if self.ghost is not None and self.ghost[0] >= self.direct:
            raise ValueError(
                f"the ghost's weight {self.ghost[0]:.3g} reaches that of the light in its place, "
                f"{self.direct:.3g}"
            )
        kernels = [k for k in kernels if k[0] != 0]
        self._narrow = [k for k in kernels if min(k[1], k[2]) < _NARROW]
        wide = [k for k in kernels if min(k[1], k[2]) >= _NARROW]
        self._wide = Subspace(shape, wide, self.direct, self.dtype) if wide else None

    def apply(self, image: Real) -> Real:
        """Return H image."""
        result: Real = self.direct * image
        result += self._beside(image)
        if self._wide is not None:
            result += self._wide.halo(image)
        return result.astype(self.dtype, copy=False)

    def solve(self, image: Real, *, guess: Real | None = None) -> Real:
        """Return H^-1 image, faster from a ``guess`` near it."""
        if not self._narrow and self.ghost is None:
            return self._solve_wide(image)
        if not self._narrow and self.dtype == np.float32:
            return self._solve_ghost(image, guess)
        stop = CONVERGED[self.dtype] * (float(np.abs(image).max()) or 1.0) * 4
        solution = self._solve_wide(image) if guess is None else guess
        # narrow kernels add a positive part to d: with half of it in the step the iteration converges,
        # however large it is relative to d
        narrow = sum(k[0] for k in self._narrow) / self.direct
        step = self.dtype.type(1.0 / (1.0 + narrow / 2))
        before = 0.0
        for _ in range(400):
            change_by = step * (self._solve_wide(image - self._beside(solution)) - solution)
            change = float(np.abs(change_by).max())
            solution = solution + change_by
            # changes shrink by a constant factor, down to rounding: stop where the sum of all further changes
            # is below the bound
            rate = change / before if before else 0.5
            if not change * rate > stop * (1.0 - rate) or (change <= stop and rate > 0.97):
                break
            before = change
        return solution

    def _solve_ghost(self, image: Real, guess: Real | None) -> Real:
        """Solve for wide kernels and a ghost of weight g: x = W^-1 (image - g T x), W the wide part with d.

        Each iteration reduces the error by a factor g / d. Once the remainder is so small that its halo is
        negligible, only its direct light is computed.
        """
        assert self.ghost is not None
        weight, columns, rows = self.ghost
        factor = weight / self.direct
        solution = self._solve_wide(image) if guess is None else guess
        rest = factor if guess is None else factor * _GUESS
        while True:
            lit = image.copy()
            _add_shifted(lit, solution, -weight, columns=columns, rows=rows)
            following = self._solve_wide(lit)
            change = following - solution
            if rest * factor < _LOCAL:
                break
            solution, rest = following, rest * factor
        _add_shifted(following, change, -factor, columns=columns, rows=rows)
        return following

    def first_order(self, image: Real) -> Real:
        """Return H^-1 image without undoing narrow kernels and the ghost, whose light is only scaled."""
        return self._solve_wide(image)

    def _solve_wide(self, image: Real) -> Real:
        if self._wide is not None:
            return self._wide.solve(image)
        result: Real = image / self.dtype.type(self.direct)
        return result.astype(self.dtype, copy=False)

    def _beside(self, image: Real) -> Real:
        """Return the light of narrow kernels and the ghost."""
        result = np.zeros_like(image)
        for weight, sigma_u, sigma_v in self._narrow:
            result += self.dtype.type(weight) * self._blur(image, sigma_u, sigma_v)
        if self.ghost is not None:
            weight, columns, rows = self.ghost
            result += self.dtype.type(weight) * shift(image, columns=columns, rows=rows)
        return result

    def _blur(self, image: Real, sigma_u: float, sigma_v: float) -> Real:
        kernels = []
        for size, sigma in ((self.shape[1], sigma_u), (self.shape[0], sigma_v)):
            reach = min(size, int(np.ceil(8 * sigma)) + 1)
            profile = gaussian_profile(reach, sigma)
            kernels.append(np.concatenate([profile[:0:-1], profile]).astype(self.dtype))
        planes = [
            cv2.sepFilter2D(
                np.ascontiguousarray(image[:, part]),
                -1,
                kernels[0],
                kernels[1],
                borderType=cv2.BORDER_CONSTANT,
            )
            for part in (0, 1)
        ]
        result: Real = np.stack(planes, axis=1)
        return result


def planar(phasor: NDArray[Any]) -> Real:
    """Return a complex image (H, W) as (H, 2, W)."""
    return np.stack([phasor.real, phasor.imag], axis=1)


def complex_image(image: Real) -> NDArray[Any]:
    """Return (H, 2, W) as a complex image (H, W)."""
    result: NDArray[Any] = image[:, 0] + 1j * image[:, 1]
    return result
