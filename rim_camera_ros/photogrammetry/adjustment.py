"""Bundle adjustment: optics, poses and, where they are free, target coordinates by least squares.

Gauss-Newton steps with Levenberg's damping, analytic derivatives, and a datum by inner constraints where
nothing else gives one (Brown 1971; Triggs et al. 2000; Kahlmann 2007, sec. 3.2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation

from rim_camera_ros.errors import RimError
from rim_camera_ros.photogrammetry.bundle import (
    Adjusted,
    Bundle,
    Loss,
    NotDetermined,
    State,
    in_camera,
    predicted,
    to_optics,
)
from rim_camera_ros.photogrammetry.projection import (
    ellipse_centre_offset,
    optics_of,
    projection_derivatives,
)
from rim_camera_ros.photogrammetry.sampling import shared_covariance

Array = NDArray[np.float64]

#: Huber's limit in units of the sigma of one coordinate; for points in the plane it costs 1 % of precision.
_HUBER = 3.0
#: Inner constraints hold the datum to this share of the field's size.
_DATUM_SIGMA = 1e-7
_ITERATIONS = {"squared": 200, "huber": 50}
#: Steps below this share of the residuals, or below this many sigmas, end the iteration.
_CONVERGED = {"squared": 1e-10, "huber": 1e-6}
_NO_STEP = 1e-7
#: Steps after which the robust loss keeps its scale, so that what it minimises stays the same.
_SPREAD_ROUNDS = 10
#: Corrections of ellipse centres are repeated until none changes by this many px.
_ELLIPSE_ROUNDS = 10
_ELLIPSE_SHIFT = 1e-5
#: Rounds in which the errors that targets share, and the covariance of their places, are found in turn.
_SHARED_ROUNDS = 4
#: Median of chi-square with two degrees of freedom, by which a median becomes a variance.
_MEDIAN_CHI2 = 2 * np.log(2)


def adjust(bundle: Bundle, start: State, *, estimated: tuple[str, ...], loss: Loss = "squared") -> Adjusted:
    """Adjust a bundle from approximate values; ``estimated`` names optics parameters, the others stay.

    Without ``fy`` the ratio fy / fx is held. The centres of ellipses are corrected with the result, and the
    adjustment is repeated until the corrections no longer change. Raises `NotDetermined` for a singular
    system, `RimError` where the iteration finds no minimum.
    """
    if not (bundle.correct_ellipses and bundle.radii.any()):
        return _minimise(replace(bundle, offsets=None), start, estimated, loss)
    state = start
    offsets = _ellipse_offsets(bundle, state)
    for _ in range(_ELLIPSE_ROUNDS):
        adjusted = _minimise(
            replace(bundle, offsets=offsets), replace(state, targets=start.targets), estimated, loss
        )
        state, before = adjusted.state, offsets
        offsets = _ellipse_offsets(bundle, state)
        if np.abs(offsets - before).max() < _ELLIPSE_SHIFT:
            break
    return adjusted


def _ellipse_offsets(bundle: Bundle, state: State) -> Array:
    normals = np.einsum("nij,nj->ni", state.rotations[bundle.station], bundle.normals[bundle.target])
    points = in_camera(bundle, state)
    found = ellipse_centre_offset(optics_of(state.optics), points, normals, bundle.radii[bundle.target])
    return np.nan_to_num(found)


def _minimise(bundle: Bundle, start: State, estimated: tuple[str, ...], loss: Loss) -> Adjusted:
    datum = _Datum.of(bundle, start)
    state = start
    if "fy" not in estimated:
        state = _with_aspect(state, bundle.aspect)
    weights = np.ones(len(bundle.sigma))
    residual = _residuals(bundle, state, datum)
    if not np.isfinite(residual).all():
        raise RimError(
            "the approximate poses put targets behind the camera", remedy="check the poses of the stations"
        )
    damping = 1e-6
    enough = _CONVERGED[loss]
    for iteration in range(_ITERATIONS[loss]):
        if loss == "huber":
            if iteration < _SPREAD_ROUNDS:
                spread = _robust_spread(residual, bundle)
            weights = _huber_weights(residual, bundle, spread)
        root = np.sqrt(_row_weights(weights, len(residual)))
        jacobian = _jacobian(bundle, state, datum, estimated)
        weighted = jacobian.multiply(root[:, None]).tocsr()
        normal = (weighted.T @ weighted).toarray()
        right = weighted.T @ (root * residual)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal / np.outer(scale, scale)
        cost = float(np.sum((root * residual) ** 2))
        while True:
            try:
                factor = cho_factor(scaled + damping * np.eye(len(scale)), check_finite=False)
            except LinAlgError:
                damping = max(damping * 10, 1e-12)
                continue
            step = cho_solve(factor, right / scale) / scale
            trial = _stepped(state, step, bundle, estimated)
            there = _residuals(bundle, trial, datum)
            if np.isfinite(there).all() and np.sum((root * there) ** 2) <= cost * (1 + 1e-12):
                break
            damping = max(damping * 10, 1e-12)
            if damping > 1e8:
                return _result(bundle, state, datum, estimated, weights, loss)
        gain = float(np.linalg.norm(step * scale)) / np.sqrt(max(cost, 1e-30))
        # residuals near zero give no scale for the change of their sum of squares: look at the step itself
        small = float(np.linalg.norm(step * scale)) < _NO_STEP
        state, residual, damping = trial, there, max(damping / 10, 1e-14)
        if gain < enough or small:
            return _result(bundle, state, datum, estimated, weights, loss)
    result = _result(bundle, state, datum, estimated, weights, loss)
    if loss == "huber":
        # a robust solution only has to be near enough to distinguish gross errors
        return result
    raise RimError(
        f"the bundle adjustment does not converge in {_ITERATIONS[loss]} steps",
        remedy="check the identification of the targets and the approximate poses",
    )


def outliers(adjusted: Adjusted, bundle: Bundle, *, limit: float) -> NDArray[np.bool_]:
    """Return which points (n,) are gross errors, at most one at each station (data snooping, Baarda 1968).

    At each station it is the point with the largest residual over its own sigma, if that exceeds ``limit``.
    A gross error also enlarges the residuals of its neighbours, which are therefore judged only after
    another adjustment.
    """
    size = np.linalg.norm(adjusted.residuals, axis=1) / bundle.whole_sigma
    reach = np.sqrt(np.maximum(adjusted.point_redundancy, 0.05))
    freedom = max(adjusted.redundancy, 1) / (2 * len(size))
    spread = np.sqrt(np.median(size**2) / _MEDIAN_CHI2 / freedom)
    relative = size / (max(float(spread), 1e-12) * reach)
    worst = np.zeros(len(adjusted.state.translations))
    np.maximum.at(worst, bundle.station, relative)
    result: NDArray[np.bool_] = (relative > limit) & (relative >= worst[bundle.station])
    return result


# --- datum ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Datum:
    """Inner constraints (rows, 3 t) on the shifts of the targets from where they were, over their sigma."""

    constraints: Array
    origin: Array

    @classmethod
    def of(cls, bundle: Bundle, start: State) -> _Datum:
        count = len(bundle.targets)
        if not bundle.free_targets:
            return cls(np.zeros((0, 3 * count)), start.targets)
        centred = start.targets - start.targets.mean(axis=0)
        rows = [np.tile(axis, (count, 1)) for axis in np.eye(3)]
        rows += [np.cross(axis, centred) for axis in np.eye(3)]
        if not bundle.distances:
            rows.append(centred)
        matrix = np.array([row.ravel() / np.linalg.norm(row) for row in rows])
        return cls(matrix / (_DATUM_SIGMA * np.abs(centred).max()), start.targets)


# --- equations --------------------------------------------------------------------------------------


def _residuals(bundle: Bundle, state: State, datum: _Datum) -> Array:
    """Observed less computed over sigma: u and v of each point, distances, inner constraints, prior."""
    image = ((bundle.image - predicted(bundle, state)) / bundle.whole_sigma[:, None]).ravel()
    lengths = [
        (length - float(np.linalg.norm(state.targets[i] - state.targets[j]))) / sigma
        for i, j, length, sigma in bundle.distances
    ]
    inner = -datum.constraints @ (state.targets - datum.origin).ravel()
    known = bundle.prior
    before = np.zeros(0) if known is None else known.root @ (known.mean - state.optics)
    return np.concatenate([image, lengths, inner, before])


def _jacobian(bundle: Bundle, state: State, datum: _Datum, estimated: tuple[str, ...]) -> csr_array:
    """Derivatives of the computed values over sigma, (rows, unknowns)."""
    points = in_camera(bundle, state)
    optics = optics_of(state.optics)
    by_optics, by_point = projection_derivatives(optics, points)
    follow = to_optics(optics.fx, optics.fy, estimated)
    inverse = 1 / bundle.whole_sigma[:, None, None]
    interior = (by_optics * inverse) @ follow
    by_point = by_point * inverse
    arm = points - state.translations[bundle.station]
    turn = np.cross(np.eye(3)[None], arm[:, None, :])  # rows: axis x arm
    pose = np.concatenate([by_point @ np.swapaxes(turn, 1, 2), by_point], axis=2)
    n, k, stations = len(points), len(estimated), len(state.translations)
    blocks = [(interior, np.zeros(n, np.intp)), (pose, k + 6 * bundle.station)]
    width = k + 6 * stations
    if bundle.free_targets:
        blocks.append((by_point @ state.rotations[bundle.station], width + 3 * bundle.target))
        width += 3 * len(state.targets)
    row, column, value = [], [], []
    line = np.arange(2 * n).reshape(n, 2, 1)
    for block, first in blocks:
        there = first[:, None, None] + np.arange(block.shape[2])
        row.append(np.broadcast_to(line, block.shape).ravel())
        column.append(np.broadcast_to(there, block.shape).ravel())
        value.append(block.ravel())
    height = 2 * n
    if bundle.free_targets:
        at = k + 6 * stations
        for i, j, _, sigma in bundle.distances:
            direction = state.targets[i] - state.targets[j]
            direction = direction / np.linalg.norm(direction) / sigma
            row.append(np.full(6, height))
            column.append(at + np.concatenate([3 * i + np.arange(3), 3 * j + np.arange(3)]))
            value.append(np.concatenate([direction, -direction]))
            height += 1
        inner_row, inner_column = np.indices(datum.constraints.shape)
        row.append(height + inner_row.ravel())
        column.append(at + inner_column.ravel())
        value.append(datum.constraints.ravel())
        height += len(datum.constraints)
    if bundle.prior is not None:
        known = bundle.prior.root @ follow
        prior_row, prior_column = np.indices(known.shape)
        row.append(height + prior_row.ravel())
        column.append(prior_column.ravel())
        value.append(known.ravel())
        height += len(known)
    entries = (np.concatenate(value), (np.concatenate(row), np.concatenate(column)))
    return coo_array(entries, shape=(height, width)).tocsr()


def _with_aspect(state: State, aspect: float) -> State:
    optics = state.optics.copy()
    optics[1] = optics[0] / aspect
    return replace(state, optics=optics)


def _stepped(state: State, step: Array, bundle: Bundle, estimated: tuple[str, ...]) -> State:
    k, stations = len(estimated), len(state.translations)
    optics = state.optics + to_optics(float(state.optics[0]), float(state.optics[1]), estimated) @ step[:k]
    poses = step[k : k + 6 * stations].reshape(stations, 6)
    targets = state.targets
    if bundle.free_targets:
        targets = targets + step[k + 6 * stations :].reshape(-1, 3)
    return State(
        optics, rotation_of(poses[:, :3]) @ state.rotations, state.translations + poses[:, 3:], targets
    )


def rotation_of(vectors: Array) -> Array:
    """Return the rotation matrices (n, 3, 3) of rotation vectors (n, 3) in rad."""
    result: Array = Rotation.from_rotvec(vectors).as_matrix()
    return result


# --- weights and result -----------------------------------------------------------------------------


def _row_weights(weights: Array, rows: int) -> Array:
    result = np.ones(rows)
    result[: 2 * len(weights)] = np.repeat(weights, 2)
    return result


def _robust_spread(residual: Array, bundle: Bundle) -> float:
    square = np.sum(residual[: 2 * len(bundle.sigma)].reshape(-1, 2) ** 2, axis=1)
    return max(float(np.sqrt(np.median(square) / _MEDIAN_CHI2)), 1e-12)


def _huber_weights(residual: Array, bundle: Bundle, spread: float) -> Array:
    size = np.linalg.norm(residual[: 2 * len(bundle.sigma)].reshape(-1, 2), axis=1)
    result: Array = np.minimum(1.0, _HUBER * spread / np.maximum(size, 1e-300))
    return result


def _result(
    bundle: Bundle,
    state: State,
    datum: _Datum,
    estimated: tuple[str, ...],
    weights: Array,
    loss: Loss,
) -> Adjusted:
    residual = _residuals(bundle, state, datum)
    row_weights = _row_weights(weights, len(residual))
    jacobian = _jacobian(bundle, state, datum, estimated)
    weighted = jacobian.multiply(np.sqrt(row_weights)[:, None]).tocsr()
    normal = (weighted.T @ weighted).toarray()
    scale = np.sqrt(np.diag(normal))
    if not (scale > 0).all():
        raise NotDetermined(int(np.argmin(scale)))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if values[0] < 1e-11 * values[-1]:
        raise NotDetermined(int(np.argmax(np.abs(vectors[:, 0]))))
    inverse = (vectors / values) @ vectors.T / np.outer(scale, scale)
    redundancy = len(residual) - normal.shape[0]
    n = len(bundle.sigma)
    rows = weighted[: 2 * n].toarray()
    # variances of the independent errors of observations, in units of their whole variances
    own = np.ones(len(residual))
    own[: 2 * n] = np.repeat((bundle.sigma / bundle.whole_sigma) ** 2, 2)
    alone = inverse @ (weighted.multiply(own[:, None]).T @ weighted).toarray() @ inverse
    together, shared, trace = np.zeros_like(inverse), tuple[Array, ...](), 0.0
    if bundle.shifts is not None and loss == "squared":
        together, shared, trace = _by_shared_errors(bundle, state, rows, inverse, alone)
    expected = float(own.sum()) + trace - float(np.sum(normal * (alone + together)))
    sigma_zero = float(np.sqrt(np.sum(row_weights * residual**2) / max(expected, 1e-9 * len(residual))))
    leverage = np.sum((rows @ inverse) * rows, axis=1).reshape(n, 2).mean(axis=1)
    return Adjusted(
        state=state,
        estimated=estimated,
        own=alone,
        together=together,
        inverse=inverse,
        sigma_zero=sigma_zero,
        redundancy=redundancy,
        expected=expected,
        residuals=bundle.image - predicted(bundle, state),
        point_redundancy=1 - leverage,
        shared=shared,
    )


def _by_shared_errors(
    bundle: Bundle, state: State, rows: Array, inverse: Array, alone: Array
) -> tuple[Array, tuple[Array, ...], float]:
    """Return the covariance of the unknowns by the errors that the targets of a station share.

    Also the covariances (px^2) of these errors for each station, and the sum of their diagonals over the
    squared sigmas. ``rows`` (2 n, unknowns): derivatives over sigmas; ``alone``: covariance by all other
    errors. The correlation of these errors depends on the places of the targets, which are only known as
    well as the unknowns. Both are therefore found in turn, beginning with independent errors.
    """
    assert bundle.shifts is not None
    places, unknown = predicted(bundle, state), inverse
    for _ in range(_SHARED_ROUNDS):
        together, shared, trace = np.zeros_like(inverse), [], 0.0
        for station in range(len(state.rotations)):
            mine = np.flatnonzero(bundle.station == station)
            row = np.stack([2 * mine, 2 * mine + 1], axis=1).ravel()
            sigma = np.repeat(bundle.whole_sigma[mine], 2)
            moving = np.flatnonzero(rows[row].any(axis=0))
            values, vectors = np.linalg.eigh(unknown[np.ix_(moving, moving)])
            moves = (rows[np.ix_(row, moving)] * sigma[:, None]) @ (vectors * np.sqrt(np.maximum(values, 0)))
            covariance = shared_covariance(bundle.shifts[mine], places[mine], moves.reshape(len(mine), 2, -1))
            to_unknowns = inverse @ (rows[row] / sigma[:, None]).T
            together += to_unknowns @ covariance @ to_unknowns.T
            trace += float(np.sum(np.diag(covariance) / sigma**2))
            shared.append(covariance)
        unknown = alone + together
    return together, tuple(shared), trace
