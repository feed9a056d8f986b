"""From an adjustment to the covariance of a camera file and the report."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.photogrammetry.bundle import Adjusted
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, OPTICS_PATHS
from rim_camera_ros.photogrammetry.report import (
    InsignificantParameters,
    OpticsCovariance,
    OpticsReport,
    RejectedPoint,
)
from rim_camera_ros.photogrammetry.targets import ImagePoint
from rim_camera_ros.rotations import quaternion

Array = NDArray[np.float64]

#: Correlations beyond this are named.
_STRONG = 0.9
_POSE_UNKNOWNS = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")


class Labels:
    """Names of the unknowns by their index."""

    def __init__(self, estimated: Sequence[str], stations: Sequence[int], names: Sequence[str]) -> None:
        self._estimated, self._stations, self._names = estimated, stations, names

    def __getitem__(self, index: int) -> str:
        if index < len(self._estimated):
            return self._estimated[index]
        index -= len(self._estimated)
        if index < 6 * len(self._stations):
            return f"{_POSE_UNKNOWNS[index % 6]} of station {self._stations[index // 6]}"
        index -= 6 * len(self._stations)
        return f"{'xyz'[index % 3]} of target {self._names[index // 3]}"


def covariance_of(adjusted: Adjusted) -> OpticsCovariance:
    """Covariance in the camera file's parameters; fy follows fx."""
    estimated = adjusted.estimated
    names = [name for name in OPTICS_PARAMETERS if name in estimated or (name == "fy" and "fx" in estimated)]
    optics = adjusted.state.optics
    matrix = np.zeros((len(names), len(estimated)))
    for i, name in enumerate(names):
        if name in estimated:
            matrix[i, estimated.index(name)] = 1.0
        if name == "fy":
            matrix[i, estimated.index("fx")] = optics[1] / optics[0]
    paths = tuple(OPTICS_PATHS[OPTICS_PARAMETERS.index(name)] for name in names)
    return OpticsCovariance(paths, matrix @ adjusted.optics_covariance @ matrix.T)


def report_on(
    adjusted: Adjusted,
    *,
    points: Sequence[ImagePoint],
    stations: Sequence[int],
    names: Sequence[str],
    insignificant: tuple[InsignificantParameters, ...],
    rejected: tuple[RejectedPoint, ...],
    doubts: Sequence[str],
    notes: Sequence[str],
) -> OpticsReport:
    """Return the report on an adjustment of ``points`` at ``stations`` of targets with ``names``."""
    covariance = covariance_of(adjusted)
    by_path = dict(zip(OPTICS_PATHS, OPTICS_PARAMETERS, strict=True))
    sigmas = {by_path[path]: covariance.sigma(path) for path in covariance.parameters}
    square = np.sum(adjusted.residuals**2, axis=1)
    at = np.array([point.station for point in points])
    image = np.array([(point.u, point.v) for point in points])
    state = adjusted.state
    poses = {
        station: Pose(_triple(state.translations[i]), quaternion(state.rotations[i]))
        for i, station in enumerate(stations)
    }
    low, high = image.min(axis=0), image.max(axis=0)
    return OpticsReport(
        values=MappingProxyType(dict(zip(OPTICS_PARAMETERS, map(float, state.optics), strict=True))),
        sigmas=MappingProxyType(sigmas),
        sigma_zero=adjusted.sigma_zero,
        redundancy=adjusted.redundancy,
        points=len(points),
        residual_rms=float(np.sqrt(square.mean() / 2)),
        station_rms={station: float(np.sqrt(square[at == station].mean() / 2)) for station in stations},
        correlations=_strong_pairs(covariance, by_path, tied="fy" not in adjusted.estimated),
        pose_correlations=_strongest_with_poses(adjusted, Labels(adjusted.estimated, stations, names)),
        insignificant=insignificant,
        rejected=rejected,
        poses=MappingProxyType(poses),
        targets={name: _triple(state.targets[i]) for i, name in enumerate(names)},
        region=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        residuals={
            (point.station, point.target): (float(u), float(v))
            for point, (u, v) in zip(points, adjusted.residuals, strict=True)
        },
        doubts=tuple(doubts),
        notes=tuple(notes),
    )


def _strong_pairs(
    covariance: OpticsCovariance, by_path: dict[str, str], *, tied: bool
) -> tuple[tuple[str, str, float], ...]:
    """Return strongly correlated pairs of optics parameters, without a tied fy, which is the same as fx."""
    keep = [i for i, path in enumerate(covariance.parameters) if not (tied and by_path[path] == "fy")]
    names = [by_path[covariance.parameters[i]] for i in keep]
    correlation = correlation_of(covariance.matrix[np.ix_(keep, keep)])
    return tuple(
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _STRONG
    )


def _strongest_with_poses(adjusted: Adjusted, label: Labels) -> tuple[tuple[str, str, float], ...]:
    k = adjusted.optics_unknowns
    correlation = correlation_of(adjusted.covariance)[:k, k : k + 6 * len(adjusted.state.translations)]
    found = []
    for i in range(k):
        j = int(np.argmax(np.abs(correlation[i])))
        if abs(correlation[i, j]) > _STRONG:
            found.append((label[i], label[k + j], float(correlation[i, j])))
    return tuple(found)


def correlation_of(covariance: Array) -> Array:
    """Return the correlation matrix (k, k) of a covariance (k, k)."""
    sigma = np.sqrt(np.diag(covariance))
    result: Array = covariance / np.outer(sigma, sigma)
    return result


def _triple(values: Array) -> tuple[float, float, float]:
    return (float(values[0]), float(values[1]), float(values[2]))
