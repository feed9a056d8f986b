"""Spreading of light over the array: sums of Gaussians and a ghost, forward and undone exactly.

The operator is H = d I + sum_i w_i G_i + w_g T, on the sensor with zero outside. A Gaussian that is
separable and truncated at the sensor's edge is a pair of symmetric Toeplitz matrices, S -> V S U.
Wide ones have few eigenvalues that matter (about 5.3 n / (pi sigma) + 4 of n above 1e-6), so that they
act within a small subspace: S is projected on it, the halo solved there, and expanded again. That
undoes the truncated operator itself; division in the Fourier domain would treat the light that fell
beside the sensor as measured zeros.

Regularisation: none is needed within the stated bounds, because G_i is positive semidefinite; noise is
amplified by at most 1 / (d - w_g). Components of the halo below ``_KEEP`` of its kernel's total are left
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Real = NDArray[Any]

#: Eigenvalues of a Gaussian below this share of the greatest possible (1) are dropped, by precision.
_KEEP = {np.dtype(np.float32): 1e-7, np.dtype(np.float64): 1e-12}
#: Relative change at which an iterative solution is taken as found.
_CONVERGED = {np.dtype(np.float32): 2e-7, np.dtype(np.float64): 1e-13}
#: Share of the light by which a guess may be wrong, and what is small beside the direct light once it
#: is spread over a halo (a phase of that many rad is 0.05 mm at 20 MHz).
_GUESS = 0.01
_LOCAL = 5e-5
#: Largest rank of all kernels but the one that reaches farthest up, for which the halo is solved by one matrix.
_DENSE = 1024
#: Kernels narrower than this many pixels are applied in space, wider ones in the subspace.
_NARROW = 2.5
#: Below this sigma a sampled Gaussian is one pixel, to the last digit.
_POINT = 0.02
#: From this sigma on the sums over whole pixels are the integrals, to the last digit.
_SMOOTH = 3.0


def gaussian_profile(size: int, sigma: float) -> NDArray[np.float64]:
    """Return the weights at 0..size-1 px of a Gaussian sampled at whole pixels, of sum 1 over all of them."""
    if sigma < _POINT:
        point = np.zeros(size)
        point[0] = 1.0
        return point
    total, _ = _moments(sigma)
    result: NDArray[np.float64] = np.exp(-0.5 * (np.arange(size) / sigma) ** 2) / total
    return result


def _moments(sigma: float) -> tuple[float, float]:
    """Sum and mean square distance of exp(-k^2 / 2 sigma^2) over all whole k."""
    if sigma >= _SMOOTH:
        return float(np.sqrt(2 * np.pi) * sigma), sigma**2
    reach = np.arange(1, int(np.ceil(12 * sigma)) + 2, dtype=float)
    weight = np.exp(-0.5 * (reach / sigma) ** 2)
    total = 1 + 2 * float(weight.sum())
    return total, 2 * float((weight * reach**2).sum()) / total


def gaussian_matrix(size: int, sigma: float) -> NDArray[np.float64]:
    """Return the symmetric Toeplitz matrix (size, size) of `gaussian_profile`, zero outside the sensor."""
    result: NDArray[np.float64] = scipy.linalg.toeplitz(gaussian_profile(size, sigma))
    return result


def gaussian_matrix_by_sigma(size: int, sigma: float) -> NDArray[np.float64]:
    """Return the derivative of `gaussian_matrix` by sigma, per pixel (0 where sigma is 0)."""
    if sigma < _POINT:
        return np.zeros((size, size))
    profile = gaussian_profile(size, sigma)
    _, mean_square = _moments(sigma)
    derivative = profile * (np.arange(size, dtype=float) ** 2 - mean_square) / sigma**3
    result: NDArray[np.float64] = scipy.linalg.toeplitz(derivative)
    return result


def shift(image: NDArray[Any], *, columns: float, rows: float) -> NDArray[Any]:
    """Return image(u - columns, v - rows), bilinear between pixels, zero outside.

    Rows are axis 0, columns the last axis.
    """
    whole_u, whole_v = int(np.floor(columns)), int(np.floor(rows))
    part_u, part_v = columns - whole_u, rows - whole_v
    result = np.zeros_like(image)
    for du, weight_u in ((whole_u, 1 - part_u), (whole_u + 1, part_u)):
        for dv, weight_v in ((whole_v, 1 - part_v), (whole_v + 1, part_v)):
            weight = weight_u * weight_v
            if weight == 0 or abs(du) >= image.shape[-1] or abs(dv) >= image.shape[0]:
                continue
            to_v, from_v = _overlap(image.shape[0], dv)
            to_u, from_u = _overlap(image.shape[-1], du)
            result[to_v, ..., to_u] += image.dtype.type(weight) * image[from_v, ..., from_u]
    return result


def _less_shifted(image: Real, of: Real, weight: float, *, columns: float, rows: float) -> Real:
    """Return image - weight * of(u - columns, v - rows)."""
    result = shift(of, columns=columns, rows=rows)
    result *= -result.dtype.type(weight)
    result += image
    return result


def _overlap(size: int, step: int) -> tuple[slice, slice]:
    if step >= 0:
        return slice(step, size), slice(0, size - step)
    return slice(0, size + step), slice(-step, size)


class Spreading:
    """The operator H for one sensor size; works on planar complex images (H, 2, W) of its dtype.

    ``kernels``: (weight, sigma along the row [px], sigma along the column [px]); ``ghost``: (weight,
    shift in columns, shift in rows [px]) or None. The direct weight d is 1 minus all weights.

    Raises ValueError where the weights leave less than 5 % of the light in its place, or a ghost as much
    light as they leave there.
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
        self._wide = _Subspace(shape, wide, self.direct, self.dtype) if wide else None

    def apply(self, image: Real) -> Real:
        """Return H image."""
        result: Real = self.direct * image
        result += self._beside(image)
        if self._wide is not None:
            result += self._wide.halo(image)
        return result.astype(self.dtype, copy=False)

    def solve(self, image: Real, *, guess: Real | None = None) -> Real:
        """Return H^-1 image, sooner from a ``guess`` that is near it."""
        if not self._narrow and self.ghost is None:
            return self._solve_wide(image)
        if not self._narrow and self.dtype == np.float32:
            return self._solve_ghost(image, guess)
        stop = _CONVERGED[self.dtype] * (float(np.abs(image).max()) or 1.0) * 4
        solution = self._solve_wide(image) if guess is None else guess
        before = 0.0
        for _ in range(200):
            following = self._solve_wide(image - self._beside(solution))
            change = float(np.abs(following - solution).max())
            solution = following
            # the changes shrink by a constant factor: stop where the next one would be below the bound
            if not change * (min(1.0, change / before) if before else 1.0) > stop:
                break
            before = change
        return solution

    def _solve_ghost(self, image: Real, guess: Real | None) -> Real:
        """Wide kernels and a ghost of weight g: x = W^-1 (image - g T x), W the wide part with d.

        Each turn gains a factor g / d. As soon as what is left matters less than a halo's share of it, only
        its direct light is followed: the halo of the ghost of that rest is of the order (g / d)^2 times the halo.
        """
        assert self.ghost is not None
        weight, columns, rows = self.ghost
        factor = weight / self.direct
        solution = self._solve_wide(image) if guess is None else guess
        rest = factor if guess is None else factor * _GUESS
        while True:
            following = self._solve_wide(_less_shifted(image, solution, weight, columns=columns, rows=rows))
            change = following - solution
            if rest * factor < _LOCAL:
                break
            solution, rest = following, rest * factor
        return _less_shifted(following, change, factor, columns=columns, rows=rows)

    def first_order(self, image: Real) -> Real:
        """Return H^-1 image but for the narrow kernels and the ghost, whose light is only scaled."""
        return self._solve_wide(image)

    def _solve_wide(self, image: Real) -> Real:
        if self._wide is not None:
            return self._wide.solve(image)
        result: Real = image / self.dtype.type(self.direct)
        return result.astype(self.dtype, copy=False)

    def _beside(self, image: Real) -> Real:
        """Narrow kernels and ghost."""
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


class _Subspace:
    """Wide kernels within the span of their leading eigenvectors.

    Within it the kernel of the most eigenvectors is diagonal, and so is A = d + that kernel. The others
    reach few of its vectors, W: (A + W K W^T)^-1 = A^-1 - A^-1 W M W^T A^-1, M = K (1 + W^T A^-1 W K)^-1
    (Woodbury), one small matrix. Where they reach too many, conjugate gradients do it.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        kernels: Sequence[tuple[float, float, float]],
        direct: float,
        dtype: np.dtype[Any],
    ) -> None:
        self.direct = direct
        self.dtype = dtype
        # the smaller its sigmas, the more eigenvectors
        kernels = sorted(kernels, key=lambda k: k[1] * k[2])
        basis_v = _joint_basis(shape[0], [k[2] for k in kernels], _KEEP[dtype])
        basis_u = _joint_basis(shape[1], [k[1] for k in kernels], _KEEP[dtype])
        within = [
            (
                weight,
                basis_v.T @ gaussian_matrix(shape[0], sigma_v) @ basis_v,
                basis_u.T @ gaussian_matrix(shape[1], sigma_u) @ basis_u,
            )
            for weight, sigma_u, sigma_v in kernels
        ]
        weight, first_v, first_u = within[0]
        inverse = 1.0 / (direct + weight * np.outer(np.diag(first_v), np.diag(first_u)))
        self._inverse_diagonal = inverse.astype(dtype)[:, None, :]
        self._rest = _Rest(within[1:], inverse, dtype) if len(within) > 1 else None
        self._v = np.ascontiguousarray(basis_v, dtype)
        self._vt = np.ascontiguousarray(basis_v.T, dtype)
        self._u = np.ascontiguousarray(basis_u, dtype)
        self._ut = np.ascontiguousarray(basis_u.T, dtype)
        self._within = [((w * v).astype(dtype), u.astype(dtype)) for w, v, u in within]

    def project(self, image: Real) -> Real:
        """(H, 2, W) -> (rank_v, 2, rank_u)."""
        height, _, width = image.shape
        rows = self._vt @ image.reshape(height, 2 * width)
        return (rows.reshape(-1, width) @ self._u).reshape(len(self._vt), 2, -1)

    def expand(self, inner: Real) -> Real:
        """(rank_v, 2, rank_u) -> (H, 2, W)."""
        rank = inner.shape[0]
        columns = (inner.reshape(rank * 2, -1) @ self._ut).reshape(rank, -1)
        return (self._v @ columns).reshape(len(self._v), 2, -1)

    def _spread(self, inner: Real) -> Real:
        """Sum of weighted kernels within the subspace."""
        rank_v, _, rank_u = inner.shape
        total = np.zeros_like(inner)
        for v, u in self._within:
            total += ((v @ inner.reshape(rank_v, -1)).reshape(-1, rank_u) @ u).reshape(inner.shape)
        return total

    def halo(self, image: Real) -> Real:
        return self.expand(self._spread(self.project(image)))

    def solve(self, image: Real) -> Real:
        y = self.project(image)
        x = self._solve_inner(y)
        # image / d, but x within the subspace
        x -= y * self.dtype.type(1.0 / self.direct)
        result = self.expand(x)
        result += image * self.dtype.type(1.0 / self.direct)
        return result

    def _solve_inner(self, y: Real) -> Real:
        """(d + sum_i w_i C_vi . C_ui) x = y."""
        inverse = self._inverse_diagonal
        if self._rest is None:
            return y * inverse
        if self._rest.dense:
            return (y - self._rest.part(y * inverse)) * inverse
        return self._by_conjugate_gradients(y)

    def _by_conjugate_gradients(self, y: Real) -> Real:
        inverse = self._inverse_diagonal
        x = inverse * y
        residual = y - self.dtype.type(self.direct) * x - self._spread(x)
        z = inverse * residual
        direction = z.copy()
        product = float(np.vdot(residual, z))
        stop = _CONVERGED[self.dtype] ** 2 * max(float(np.vdot(y, y)), 1e-300)
        for _ in range(60):
            if not float(np.vdot(residual, residual)) > stop:
                break
            image = self.dtype.type(self.direct) * direction + self._spread(direction)
            step = self.dtype.type(product / float(np.vdot(direction, image)))
            x += step * direction
            residual -= step * image
            z = inverse * residual
            following = float(np.vdot(residual, z))
            direction = z + self.dtype.type(following / product) * direction
            product = following
        return x


class _Rest:
    """W M W^T for all kernels but the first, within a subspace: ``within`` of (w, C_v, C_u), A^-1 = ``inverse``."""

    def __init__(
        self,
        within: Sequence[tuple[float, NDArray[np.float64], NDArray[np.float64]]],
        inverse: NDArray[np.float64],
        dtype: np.dtype[Any],
    ) -> None:
        v = _range([one[1] for one in within], _KEEP[dtype])
        u = _range([one[2] for one in within], _KEEP[dtype])
        rank_v, rank_u = v.shape[1], u.shape[1]
        rank = rank_v * rank_u
        self.dense = rank <= _DENSE
        if not self.dense:
            return
        kernel = sum(w * np.kron(v.T @ c_v @ v, u.T @ c_u @ u) for w, c_v, c_u in within)
        pairs_v = (v[:, :, None] * v[:, None, :]).reshape(len(v), -1)
        pairs_u = (u[:, :, None] * u[:, None, :]).reshape(len(u), -1)
        between = (pairs_v.T @ inverse @ pairs_u).reshape(rank_v, rank_v, rank_u, rank_u)
        between = between.transpose(0, 2, 1, 3).reshape(rank, rank)
        solved = np.linalg.solve((np.eye(rank) + between @ kernel).T, np.asarray(kernel).T).T
        self._matrix = np.ascontiguousarray(solved, dtype)
        self._v = np.ascontiguousarray(v, dtype)
        self._vt = np.ascontiguousarray(v.T, dtype)
        self._u = np.ascontiguousarray(u, dtype)
        self._ut = np.ascontiguousarray(u.T, dtype)

    def part(self, inner: Real) -> Real:
        """Return W M W^T inner, (rank_v, 2, rank_u)."""
        rank_v, _, rank_u = inner.shape
        few_v, few_u = len(self._vt), len(self._ut)
        rows = self._vt @ inner.reshape(rank_v, 2 * rank_u)
        few = (rows.reshape(2 * few_v, rank_u) @ self._u).reshape(few_v, 2, few_u)
        mixed = self._matrix @ few.transpose(0, 2, 1).reshape(few_v * few_u, 2)
        few = np.ascontiguousarray(mixed.reshape(few_v, few_u, 2).transpose(0, 2, 1))
        columns = (few.reshape(2 * few_v, few_u) @ self._ut).reshape(few_v, 2 * rank_u)
        return (self._v @ columns).reshape(inner.shape)


def _range(matrices: Sequence[NDArray[np.float64]], keep: float) -> NDArray[np.float64]:
    """Return an orthonormal basis of what symmetric matrices reach together."""
    u, s, _ = np.linalg.svd(np.concatenate(matrices, axis=1), full_matrices=False)
    return u[:, s > keep]


def _joint_basis(size: int, sigmas: Sequence[float], keep: float) -> NDArray[np.float64]:
    """Return an orthonormal basis (size, rank) of what the kernels reach: eigenvectors of the first, then others."""
    values, vectors = np.linalg.eigh(gaussian_matrix(size, sigmas[0]))
    basis = vectors[:, np.abs(values) > keep]
    for sigma in sigmas[1:]:
        values, vectors = np.linalg.eigh(gaussian_matrix(size, sigma))
        further = vectors[:, np.abs(values) > keep] * np.abs(values[np.abs(values) > keep])
        rest = further - basis @ (basis.T @ further)
        u, s, _ = np.linalg.svd(rest, full_matrices=False)
        basis = np.linalg.qr(np.concatenate([basis, u[:, s > keep]], axis=1))[0]
    return basis


def planar(phasor: NDArray[Any]) -> Real:
    """Return a complex image (H, W) as (H, 2, W)."""
    return np.stack([phasor.real, phasor.imag], axis=1)


def complex_image(image: Real) -> NDArray[Any]:
    """Return (H, 2, W) as a complex image (H, W)."""
    result: NDArray[Any] = image[:, 0] + 1j * image[:, 1]
    return result
