"""Results of an estimation of the optics, as a report for people and as data for files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose

#: Rejected points that are listed one by one.
_LISTED = 10


@dataclass(frozen=True)
class OpticsCovariance:
    """Covariance of the estimated optics: dotted paths of the camera file and the matrix in their units.

    Parameters that were not significant or held are not in it. Where fy was tied to fx both are in it, fully
    correlated.
    """

    parameters: tuple[str, ...]
    matrix: NDArray[np.float64]

    def sigma(self, parameter: str) -> float:
        """Return the 1-sigma of a parameter by its path, such as ``optics.d.0``. Raises KeyError."""
        if parameter not in self.parameters:
            raise KeyError(parameter)
        i = self.parameters.index(parameter)
        return float(np.sqrt(self.matrix[i, i]))


@dataclass(frozen=True)
class InsignificantParameters:
    """Parameters without a significant departure from the start, with F of the test and its probability."""

    parameters: tuple[str, ...]
    statistic: float
    probability: float


@dataclass(frozen=True)
class RejectedPoint:
    """An observation that was rejected as a gross error, with its residual (u, v) in px."""

    target: str
    station: int
    residual: tuple[float, float]


@dataclass(frozen=True)
class OpticsReport:
    """How an estimation of the optics went.

    ``values`` and ``sigmas`` by name (fx fy cx cy k1 k2 p1 p2 k3), sigmas of the estimated ones only.
    ``sigma_zero``: root of the sum of squared residuals over the sigmas given with the observations, per
    degree of freedom (``redundancy``); the covariance contains it. ``residual_rms`` px, of one coordinate;
    ``station_rms`` px by station. ``correlations``: pairs of optics parameters with correlations beyond 0.9;
    ``pose_correlations``: of each parameter the strongest correlation beyond 0.9 with a pose. ``poses`` of
    the field's frame in the optical frame by station. ``doubts``: why the result should not be used as it is,
    in words. ``targets``: coordinates [m] by id, as adjusted. ``region``: u0 v0 u1 v1 [px] that the
    observations cover, beyond which the distortion is extrapolated. ``residuals``: (u, v) px by (station,
    target).
    """

    values: Mapping[str, float]
    sigmas: Mapping[str, float]
    sigma_zero: float
    redundancy: int
    points: int
    residual_rms: float
    station_rms: Mapping[int, float]
    correlations: tuple[tuple[str, str, float], ...]
    pose_correlations: tuple[tuple[str, str, float], ...]
    insignificant: tuple[InsignificantParameters, ...]
    rejected: tuple[RejectedPoint, ...]
    poses: Mapping[int, Pose]
    targets: Mapping[str, tuple[float, float, float]]
    region: tuple[float, float, float, float]
    residuals: Mapping[tuple[int, str], tuple[float, float]]
    doubts: tuple[str, ...]
    notes: tuple[str, ...]

    def text(self) -> str:
        """Return the report as lines of text."""
        lines = [
            *(f"warning: {doubt}" for doubt in self.doubts),
            f"{self.points} points at {len(self.station_rms)} stations, redundancy {self.redundancy}, "
            f"sigma zero {self.sigma_zero:.3g}, residuals {self.residual_rms:.3g} px RMS",
        ]
        for name, value in self.values.items():
            sigma = self.sigmas.get(name)
            lines.append(
                f"  {name:<3} {value:>14.8g}  " + (f"+- {sigma:.2g}" if sigma is not None else "held")
            )
        for left in self.insignificant:
            names = " and ".join(left.parameters)
            what = f"kept as given, F = {left.statistic:.2f}, probability {left.probability:.2f}"
            lines.append(f"  no significant change: {names} ({what})")
        for one, other, value in (*self.correlations, *self.pose_correlations):
            lines.append(f"  correlation {one} - {other}: {value:+.3f}")
        worst = sorted(self.rejected, key=lambda one: -float(np.hypot(*one.residual)))
        for point in worst[:_LISTED]:
            u, v = point.residual
            lines.append(
                f"  rejected: target {point.target} at station {point.station}, {u:+.2f} {v:+.2f} px"
            )
        if len(worst) > _LISTED:
            lines.append(f"  rejected: {len(worst) - _LISTED} more with smaller residuals")
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    def summary(self) -> dict[str, Any]:
        """Return the report without its points as plain data, for the provenance of a camera file."""
        return {
            "points": self.points,
            "stations": len(self.station_rms),
            "redundancy": self.redundancy,
            "sigma_zero": self.sigma_zero,
            "residual_rms_px": self.residual_rms,
            "sigmas": dict(self.sigmas),
            "left_out": [name for one in self.insignificant for name in one.parameters],
            "correlations": [f"{one} - {other}: {value:+.3f}" for one, other, value in self.correlations],
            "rejected": len(self.rejected),
            "region": list(self.region),
            "notes": [*self.doubts, *self.notes],
        }
