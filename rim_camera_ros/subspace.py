"""Wide Gaussians over the array as small matrices: the span of their leading eigenvectors.

Planar complex images are (H, 2, W): real and imaginary part by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Real = NDArray[Any]

#: Eigenvalues of a Gaussian below this share of the greatest possible one (1) are dropped, by precision. If a
#: tenth of the light is spread, float32 then misses 1e-6 of it: 0.1 mm in a pixel a hundred times as dark.
KEEP = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 1e-12}
#: Relative change below which an iterative solution has converged.
CONVERGED = {np.dtype(np.float32): 2e-7, np.dtype(np.float64): 1e-13}
#: Largest total rank of the kernels except the narrowest up to which their part is solved by one matrix.
_DENSE = 1024
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
    return _toeplitz(gaussian_profile(size, sigma))


def gaussian_matrix_by_sigma(size: int, sigma: float) -> NDArray[np.float64]:
    """Return the derivative of `gaussian_matrix` by sigma, per pixel (0 where sigma is 0)."""
    if sigma < _POINT:
        return np.zeros((size, size))
    profile = gaussian_profile(size, sigma)
    _, mean_square = _moments(sigma)
    derivative = profile * (np.arange(size, dtype=float) ** 2 - mean_square) / sigma**3
    return _toeplitz(derivative)


def _toeplitz(column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric Toeplitz matrix with this first column."""
    at = np.arange(len(column))
    return column[np.abs(at[:, None] - at)]


class Subspace:
    """Wide kernels within the span of their leading eigenvectors.

    Within it the kernel with the most eigenvectors is diagonal, and so is A = d + that kernel. The other
    kernels only act on few of its vectors, W. Then (A + W K W^T)^-1 = A^-1 - A^-1 W M W^T A^-1 with one small
    matrix M = K (1 + W^T A^-1 W K)^-1 (Woodbury). If they act on too many, conjugate gradients are used.
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
        # the smaller the sigmas of a kernel, the more eigenvectors it has
        kernels = sorted(kernels, key=lambda k: k[1] * k[2])
        basis_v = _joint_basis(shape[0], [k[2] for k in kernels], KEEP[dtype])
        basis_u = _joint_basis(shape[1], [k[1] for k in kernels], KEEP[dtype])
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
        result: Real = (rows.reshape(-1, width) @ self._u).reshape(len(self._vt), 2, -1)
        return result

    def expand(self, inner: Real) -> Real:
        """(rank_v, 2, rank_u) -> (H, 2, W)."""
        rank = inner.shape[0]
        columns = (inner.reshape(rank * 2, -1) @ self._ut).reshape(rank, -1)
        result: Real = (self._v @ columns).reshape(len(self._v), 2, -1)
        return result

    def _spread(self, inner: Real) -> Real:
        """Return the sum of the weighted kernels within the subspace."""
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
        flat = result.reshape(len(result), -1)
        cv2.scaleAdd(image.reshape(flat.shape), 1.0 / self.direct, flat, dst=flat)
        return result

    def _solve_inner(self, y: Real) -> Real:
        """Solve (d + sum_i w_i C_vi . C_ui) x = y for x."""
        inverse = self._inverse_diagonal
        if self._rest is not None and not self._rest.dense:
            return self._by_conjugate_gradients(y)
        x: Real = y * inverse
        if self._rest is not None:
            x -= self._rest.part(x) * inverse
        return x

    def _by_conjugate_gradients(self, y: Real) -> Real:
        inverse = self._inverse_diagonal
        x = inverse * y
        residual = y - self.dtype.type(self.direct) * x - self._spread(x)
        z = inverse * residual
        direction = z.copy()
        product = float(np.vdot(residual, z))
        stop = CONVERGED[self.dtype] ** 2 * max(float(np.vdot(y, y)), 1e-300)
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
    """W M W^T of all kernels except the first, given as (w, C_v, C_u); ``inverse``: the diagonal A^-1."""

    def __init__(
        self,
        within: Sequence[tuple[float, NDArray[np.float64], NDArray[np.float64]]],
        inverse: NDArray[np.float64],
        dtype: np.dtype[Any],
    ) -> None:
        v = _range([one[1] for one in within], KEEP[dtype])
        u = _range([one[2] for one in within], KEEP[dtype])
        rank_v, rank_u = v.shape[1], u.shape[1]
        rank = rank_v * rank_u
        self.dense = rank <= _DENSE
        if not self.dense:
            return
        kernel = sum(w * np.kron(v.T @ c_v @ v, u.T @ c_u @ u) for w, c_v, c_u in within)
        pairs_v = (v[:, :, None] * v[:, None, :]).reshape(len(v), -1)
        pairs_u = (u[:, :, None] * u[:, None, :]).reshape(len(u), -1)
        between = (pairs_v.T @ inverse @ pairs_u).reshape(rank_v, rank_v, rank_u, rank_u)
        coupling = between.transpose(0, 2, 1, 3).reshape(rank, rank)
        solved = np.linalg.solve((np.eye(rank) + coupling @ kernel).T, np.asarray(kernel).T).T
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
        result: Real = (self._v @ columns).reshape(inner.shape)
        return result


def _range(matrices: Sequence[NDArray[np.float64]], keep: float) -> NDArray[np.float64]:
    """Return an orthonormal basis of the joint range of symmetric matrices."""
    u, s, _ = np.linalg.svd(np.concatenate(matrices, axis=1), full_matrices=False)
    return u[:, s > keep]


def _joint_basis(size: int, sigmas: Sequence[float], keep: float) -> NDArray[np.float64]:
    """Return an orthonormal basis (size, rank) of the joint range of the kernels, the first one's first."""
    values, vectors = np.linalg.eigh(gaussian_matrix(size, sigmas[0]))
    reached = np.abs(values) > keep
    reached[-1] = True  # always the greatest, however small it is for a kernel wider than the sensor
    basis = vectors[:, reached]
    for sigma in sigmas[1:]:
        values, vectors = np.linalg.eigh(gaussian_matrix(size, sigma))
        further = vectors[:, np.abs(values) > keep] * np.abs(values[np.abs(values) > keep])
        rest = further - basis @ (basis.T @ further)
        u, s, _ = np.linalg.svd(rest, full_matrices=False)
        basis = np.linalg.qr(np.concatenate([basis, u[:, s > keep]], axis=1))[0]
    return basis
