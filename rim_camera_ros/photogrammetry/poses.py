"""Poses of a board with their covariance: each station by its image, for optics of known uncertainty."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import expit

from rim_camera_ros.errors import RimError
from rim_camera_ros.frame import Pose
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry.adjustment import adjust, outliers
from rim_camera_ros.photogrammetry.bundle import Adjusted, Bundle, NotDetermined, in_camera
from rim_camera_ros.photogrammetry.checks import LEAST_TARGETS
from rim_camera_ros.photogrammetry.estimate import GROSS, block_from, start_poses, state_from
from rim_camera_ros.photogrammetry.mirrored import Fitted, PlacedPose, log_odds, mirrored, mixture
from rim_camera_ros.photogrammetry.projection import (
    OPTICS_PATHS,
    optics_of,
    optics_vector,
    projection_derivatives,
)
from rim_camera_ros.photogrammetry.report import OpticsCovariance
from rim_camera_ros.photogrammetry.targets import ImagePoint, Observations
from rim_camera_ros.rotations import quaternion, rotation_matrix

Array = NDArray[np.float64]

#: Degrees of freedom with which the variance of all stations enters that of one: a single image determines
#: its own variance poorly.
_COMMON_FREEDOM = 20.0
#: Most rounds in which the error that all targets have in addition to their own sigmas is found, and the
#: relative change of it that ends them.
_ROUNDS = 5
_SETTLED = 0.02


@dataclass(frozen=True)
class StationPose:
    """The pose of a board at one station, with its covariance.

    ``own`` (6, 6): the part of the covariance by the noise of its image; ``common`` (6, 6): the part by the
    errors of optics and board size, which are the same at all stations. In the order x y z [m], rotations
    about the axes of the optical frame [rad]. ``residual``: RMS px of one coordinate of ``points`` targets.
    """

    pose: Pose
    own: Array
    common: Array
    residual: float
    points: int

    @property
    def sigma_normal(self) -> float:
        """1-sigma [m] of the shift along the normal."""
        normal = rotation_matrix(self.pose.orientation)[:, 2]
        return float(np.sqrt(normal @ (self.own + self.common)[:3, :3] @ normal))

    @property
    def sigma_tilt(self) -> float:
        """1-sigma [rad] of the tilt, RMS of both axes."""
        rotation = rotation_matrix(self.pose.orientation)[:, :2]
        return float(np.sqrt(np.trace(rotation.T @ (self.own + self.common)[3:, 3:] @ rotation) / 2))


@dataclass(frozen=True)
class BoardPoses:
    """Poses by station.

    ``scale_sigma``: relative 1-sigma of the scale error of all distances, by focal length and size of the
    board; ``common_share``: the share of the variance along the normal that is the same at all stations, for
    ``pose_common`` of a scene file. ``sigma_zero``: RMS of residuals over the sigmas of the targets, in which
    ``common_error`` is included: an error [px] of every coordinate in addition to the sigma by its own image.
    """

    stations: Mapping[int, StationPose]
    scale_sigma: float
    common_share: float
    sigma_zero: float
    notes: tuple[str, ...]
    common_error: float = 0.0


def estimate_poses(
    observations: Observations,
    *,
    optics: Optics,
    covariance: OpticsCovariance | None = None,
    board_scale_sigma: float = 0.0,
) -> BoardPoses:
    """Adjust the pose of each station to its targets, the optics held.

    ``covariance`` of the optics (None: exact) and ``board_scale_sigma``, the relative 1-sigma of the size of
    the board, go into the covariance of every pose, C = s^2 (A'A)^-1 + G C_optics G' + sigma^2 t t', with
    G = -(A'A)^-1 A'B of the derivatives A by the pose and B by the optics. s^2 is the variance of the
    residuals of the station, drawn towards that of all stations. Gross errors are rejected (Baarda 1968).
    The sigma of a target comes from the fit to its own grey values. It does not contain errors of the board's
    print or of the lens model, and is too small where the fit is good by chance. A variance common to all
    targets is therefore added, such that residuals are as large as they should be (Mandel & Paule 1970).
    Errors by the sampling of the image, which the targets of a station share, are part of the covariance of
    its targets, and so of the pose. Where residuals do not decide between two poses that are mirrored at the
    line of sight, pose and covariance are those of their mixture.

    Raises `RimError` where no station has a pose.
    """
    by_optics = _optics_matrix(covariance)
    common_error = 0.0
    for _ in range(_ROUNDS):
        found, failures = _all_adjusted(observations, optics, common_error)
        before, common_error = common_error, _common_error(found.values(), common_error)
        if abs(common_error - before) <= _SETTLED * common_error:
            break
    notes = [*observations.notes, *failures]
    if not found:
        raise RimError(
            f"no station has a pose{': ' + notes[-1] if notes else ''}",
            remedy="check that the scene file describes the board that was recorded",
        )
    likely = {station: fits[0] for station, fits in found.items()}
    freedom = {station: max(fit.adjusted.expected, 1.0) for station, fit in likely.items()}
    total = sum(freedom[station] * fit.adjusted.sigma_zero**2 for station, fit in likely.items())
    pooled = total / sum(freedom.values())
    stations = {}
    scales, shares = [], []
    for station, fits in found.items():
        own_variance = likely[station].adjusted.sigma_zero ** 2
        variance = (_COMMON_FREEDOM * pooled + freedom[station] * own_variance) / (
            _COMMON_FREEDOM + freedom[station]
        )
        made = [_placed(fit, variance, by_optics, board_scale_sigma) for fit in fits]
        placed = made[0]
        if len(fits) > 1:
            first = float(expit(log_odds(fits[0], fits[1], variance)))
            placed = mixture(made[0], made[1], first)
            notes += _undecided(station, made, placed, first)
        stations[station] = _station_pose(placed, likely[station])
        shift, common = placed.shift, placed.common
        along = shift / np.linalg.norm(shift)
        scales.append(along @ common[:3, :3] @ along / (shift @ shift))
        normal = placed.rotation[:, 2]
        shares.append(normal @ common[:3, :3] @ normal / (normal @ (placed.own + common)[:3, :3] @ normal))
        if likely[station].rejected:
            notes.append(f"station {station}: {likely[station].rejected} targets rejected as gross errors")
    return BoardPoses(
        stations=stations,
        scale_sigma=float(np.sqrt(np.mean(scales))),
        common_share=float(np.median(shares)),
        sigma_zero=float(np.sqrt(pooled)),
        notes=tuple(notes),
        common_error=common_error,
    )


#: The pose with the smallest residuals, then the mirrored one where both are possible.
_Found = tuple[Fitted, ...]


def _placed(fit: Fitted, variance: float, by_optics: Array, board_scale_sigma: float) -> PlacedPose:
    state = fit.adjusted.state
    shift, order = state.translations[0], [3, 4, 5, 0, 1, 2]
    optical = _by_optics(fit.adjusted, fit.bundle)
    common = (optical @ by_optics @ optical.T)[np.ix_(order, order)]
    common[:3, :3] += board_scale_sigma**2 * np.outer(shift, shift)
    own = fit.adjusted.covariance_by(variance)[np.ix_(order, order)]
    return PlacedPose(state.rotations[0], shift, own, common)


def _station_pose(placed: PlacedPose, fit: Fitted) -> StationPose:
    x, y, z = (float(value) for value in placed.shift)
    covariance = tuple((placed.own + placed.common).ravel().tolist())
    pose = Pose((x, y, z), quaternion(placed.rotation), covariance)
    residual = float(np.sqrt(np.mean(fit.adjusted.residuals**2)))
    return StationPose(pose, placed.own, placed.common, residual, len(fit.bundle.sigma))


def _undecided(station: int, made: Sequence[PlacedPose], placed: PlacedPose, first: float) -> list[str]:
    """Return a note where most of the variance of the tilt is that between two possible poses."""
    tilts = [float(np.trace(pose.own[3:, 3:])) for pose in made]
    if np.trace(placed.own[3:, 3:]) < 2 * (first * tilts[0] + (1 - first) * tilts[1]):
        return []
    cosine = float(made[0].rotation[:, 2] @ made[1].rotation[:, 2])
    return [
        f"station {station}: two poses, mirrored at the line of sight, fit its image "
        f"({np.degrees(np.arccos(min(cosine, 1.0))):.1f} deg apart, probability of the more likely one "
        f"{max(first, 1 - first):.2f}): the pose is their mean, and its covariance holds both; tilt the "
        "board by 20 deg and more, or come nearer"
    ]


def _all_adjusted(
    observations: Observations, optics: Optics, common_error: float
) -> tuple[dict[int, _Found], list[str]]:
    """Adjust every station, with an error [px] of all targets; also return notes on those without a pose."""
    by_station: dict[int, list[ImagePoint]] = {}
    for point in observations.points:
        sigma = float(np.hypot(point.sigma, common_error))
        by_station.setdefault(point.station, []).append(replace(point, sigma=sigma))
    found: dict[int, _Found] = {}
    failures = []
    for station, points in sorted(by_station.items()):
        try:
            found[station] = _adjusted(replace(observations, points=tuple(points)), optics)
        except RimError as error:
            failures.append(f"station {station} has no pose: {error.problem}")
    return found, failures


def _common_error(found: Iterable[_Found], now: float) -> float:
    """Return the error [px] of all targets that explains the residuals in addition to their own sigmas.

    With it the sum of squared residuals over their variances is as expected. It is 0 where the sum is smaller
    than expected without it. The sigmas as they are contain the error ``now`` [px].
    """
    parts = [
        (fit.adjusted.residuals, fit.bundle.whole_sigma**2 - now**2, fit.adjusted.expected)
        for fit, *_ in found
    ]
    if not parts:
        return now
    squares = np.concatenate([np.sum(residuals**2, axis=1) for residuals, _, _ in parts])
    own = np.concatenate([variance for _, variance, _ in parts])
    expected = sum(count for _, _, count in parts)

    def excess(variance: float) -> float:
        return float(np.sum(squares / (own + variance))) - expected

    most = float(squares.sum()) / max(expected, 1)
    if expected <= 0 or excess(1e-12 * most) <= 0:
        return 0.0
    return float(np.sqrt(brentq(excess, 1e-12 * most, most)))


def _optics_matrix(covariance: OpticsCovariance | None) -> Array:
    """Return the covariance (9, 9) of all parameters of the optics, zero for those that are exact."""
    result = np.zeros((len(OPTICS_PATHS), len(OPTICS_PATHS)))
    if covariance is not None:
        at = [OPTICS_PATHS.index(path) for path in covariance.parameters]
        result[np.ix_(at, at)] = covariance.matrix
    return result


def _adjusted(observations: Observations, optics: Optics) -> _Found:
    """Adjust one station from both sides of the line of sight."""
    _require_targets(observations.points)
    block = block_from(observations, observations.points, optics, "known", (), correct_ellipses=True)
    start = start_poses(observations, block, optics)
    found = _adjusted_from(observations, optics, start)
    targets = found.bundle.targets
    opposite = {
        station: mirrored(rotation, shift, targets.mean(axis=0))
        for station, (rotation, shift) in start.items()
    }
    try:
        other = _adjusted_from(observations, optics, opposite)
    except RimError:
        return (found,)
    scale = min(found.adjusted.sigma_zero, other.adjusted.sigma_zero) ** 2
    return tuple(sorted((found, other), key=lambda fit: fit.cost(scale)))


def _require_targets(points: Sequence[ImagePoint]) -> None:
    if len(points) < LEAST_TARGETS:
        raise RimError(f"{len(points)} targets found, at least {LEAST_TARGETS} are needed")


def _adjusted_from(
    observations: Observations, optics: Optics, start: Mapping[int, tuple[Array, Array]]
) -> Fitted:
    """Adjust one station from approximate poses, and reject gross errors."""
    points, rejected = observations.points, 0
    while True:
        _require_targets(points)
        block = block_from(observations, points, optics, "known", (), correct_ellipses=True)
        try:
            adjusted = adjust(
                block.bundle, state_from(block, start, optics_vector(optics)), estimated=(), loss="huber"
            )
            gross = outliers(adjusted, block.bundle, limit=GROSS)
            if not gross.any():
                final = adjust(block.bundle, adjusted.state, estimated=(), loss="squared")
                return Fitted(final, block.bundle, rejected)
        except NotDetermined:
            raise RimError("its targets lie on one line") from None
        rejected += int(gross.sum())
        points = tuple(point for point, bad in zip(block.points, gross, strict=True) if not bad)


def _by_optics(adjusted: Adjusted, bundle: Bundle) -> Array:
    """Return the derivatives (6, 9) of the pose (rotation, shift) by the nine parameters of the optics."""
    points = in_camera(bundle, adjusted.state)
    by_optics, by_point = projection_derivatives(optics_of(adjusted.state.optics), points)
    weight = 1 / bundle.whole_sigma[:, None, None]
    arm = points - adjusted.state.translations[0]
    turn = np.cross(np.eye(3)[None], arm[:, None, :])
    pose = np.concatenate([by_point @ np.swapaxes(turn, 1, 2), by_point], axis=2) * weight
    a, b = pose.reshape(-1, 6), (by_optics * weight).reshape(-1, len(OPTICS_PATHS))
    result: Array = -adjusted.inverse @ (a.T @ b)
    return result
