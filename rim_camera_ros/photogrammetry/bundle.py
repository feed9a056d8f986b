"""Data of a bundle adjustment: observations with their covariance, unknowns, and the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import RimError
from rim_camera_ros.optics import project
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, optics_of

Array = NDArray[np.float64]
Loss = Literal["huber", "squared"]


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the optics: ``mean`` of the nine parameters, and ``root`` (k, 9).

    ``root`` times the departures from the mean has k independent errors of sigma 1.
    """

    mean: Array
    root: Array


@dataclass(frozen=True)
class Bundle:
    """The observations and fixed values of an adjustment.

    ``image`` (n, 2) px: observed points; ``sigma`` (n,) px: of their independent errors; ``station`` and
    ``target`` (n,): indices. ``shifts`` (n, frequencies, 2) px: errors that the targets of a station share,
    see `sampling`; None: there are none. ``targets`` (t, 3) m with ``radii`` (t,) and ``normals`` (t, 3);
    ``distances``: (first, second, length, sigma) with indices of free targets. ``aspect``: the ratio fx / fy,
    held where fy is not estimated (``estimated`` without ``fy``). ``offsets`` (n, 2) px: centres of the
    ellipses less images of the circles' centres; None: not known yet. ``prior`` of the optics; None: no
    prior.
    """

    image: Array
    sigma: Array
    station: NDArray[np.intp]
    target: NDArray[np.intp]
    targets: Array
    radii: Array
    normals: Array
    free_targets: bool
    distances: tuple[tuple[int, int, float, float], ...]
    aspect: float
    correct_ellipses: bool
    offsets: Array | None = None
    shifts: Array | None = None
    prior: Prior | None = None

    @property
    def whole_sigma(self) -> Array:
        """1-sigma (n,) px of one coordinate, of independent and shared errors together."""
        if self.shifts is None:
            return self.sigma
        result: Array = np.sqrt(self.sigma**2 + np.sum(self.shifts**2, axis=(1, 2)) / 4)
        return result


@dataclass(frozen=True)
class State:
    """Unknowns: the nine optics parameters, rotations (s, 3, 3) and translations (s, 3), targets (t, 3)."""

    optics: Array
    rotations: Array
    translations: Array
    targets: Array


@dataclass(frozen=True)
class Adjusted:
    """Result of an adjustment.

    ``own`` and ``together``: covariance of all unknowns by the independent errors of targets and by those
    that the targets of a station share, both as stated (a priori). Order of the unknowns: the estimated
    optics parameters (``optics_unknowns`` of them), six for each station (rotation [rad] about x y z of the
    optical frame, translation [m]), three for each free target. ``inverse``: inverse of the normal matrix, in
    that order. ``residuals`` (n, 2) px; ``redundancy``: the degrees of freedom.

    ``expected``: expectation of the sum of squared residuals over sigmas for errors as stated, smaller where
    targets share errors; ``sigma_zero``: root of the sum found over the one expected. ``point_redundancy``
    (n,) 0..1: the share of an error of a point that its residual shows. ``shared``: for each station the
    covariance px^2 of the errors that its m targets share, (2 m, 2 m) in their order.
    """

    state: State
    estimated: tuple[str, ...]
    own: Array
    together: Array
    inverse: Array
    sigma_zero: float
    redundancy: int
    expected: float
    residuals: Array
    point_redundancy: Array
    shared: tuple[Array, ...] = ()

    def covariance_by(self, factor: float) -> Array:
        """Return the covariance of all unknowns for a variance factor of the observations.

        Residuals show little of the errors that targets share: a factor below 1 does not reduce that part.
        """
        result: Array = factor * self.own + max(factor, 1.0) * self.together
        return result

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all unknowns, by the variance factor a posteriori."""
        return self.covariance_by(self.sigma_zero**2)

    @property
    def optics_unknowns(self) -> int:
        return len(self.estimated)

    @property
    def optics_covariance(self) -> Array:
        """Covariance of the estimated parameters, with ``fy`` as the departure of fy from its aspect [px]."""
        n = len(self.estimated)
        return self.covariance[:n, :n]


class NotDetermined(RimError):
    """The observations do not determine the unknowns. ``unknown``: index of the least determined one."""

    def __init__(self, unknown: int) -> None:
        self.unknown = unknown
        super().__init__(f"unknown {unknown} is not determined by the observations")


def in_camera(bundle: Bundle, state: State) -> Array:
    """Return the targets of all points (n, 3) m in the optical frame of their stations."""
    rotated = np.einsum("nij,nj->ni", state.rotations[bundle.station], state.targets[bundle.target])
    result: Array = rotated + state.translations[bundle.station]
    return result


def predicted(bundle: Bundle, state: State) -> Array:
    """Return where the points (n, 2) px should be, circles at the centres of their ellipses."""
    image = project(optics_of(state.optics), in_camera(bundle, state))
    return image if bundle.offsets is None else image + bundle.offsets


def to_optics(fx: float, fy: float, estimated: tuple[str, ...]) -> Array:
    """Return the derivatives (9, k) of the nine parameters by the estimated ones.

    fy changes with fx; the parameter ``fy`` itself is its departure from the aspect.
    """
    matrix = np.eye(len(OPTICS_PARAMETERS))
    matrix[1, 0] = fy / fx
    return matrix[:, [OPTICS_PARAMETERS.index(name) for name in estimated]]
