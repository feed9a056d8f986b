"""What a camera file states of its optics: what an adjustment begins with, and what becomes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rim_camera_ros.camera import Camera, Covariance
from rim_camera_ros.optics import Optics
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.photogrammetry.bundle import Prior
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, OPTICS_PATHS, optics_vector
from rim_camera_ros.photogrammetry.report import OpticsCovariance

Array = NDArray[np.float64]

#: Directions of the stated covariance are known at most a thousand times better than the worst of them.
_FLATTEST = 1e-6
#: A departure from what is stated is said where chance makes it this seldom.
_SURPRISE = 1e-3
#: Share of the variance that observations take from a direction at least, of which they tell something.
_LEAST_TOLD = 1e-3


def stated_optics(camera: Camera) -> OpticsCovariance | None:
    """Return the covariance that a camera file states of its optics, None where it states none."""
    if camera.covariance is None:
        return None
    parameters = camera.covariance.parameters
    at = [i for i, path in enumerate(parameters) if path in OPTICS_PATHS]
    if not at:
        return None
    matrix = np.asarray(camera.covariance.matrix.values, float)[np.ix_(at, at)]
    return OpticsCovariance(tuple(parameters[i] for i in at), matrix)


def prior_of(start: Optics, known: OpticsCovariance) -> tuple[Prior, tuple[str, ...]]:
    """Return the optics ``start`` with a covariance as a prior, and the names of the parameters in it.

    Without those that are stated exactly. An fy that follows fx, or has none beside it, is left to the ratio
    of the two.
    """
    index = [OPTICS_PATHS.index(path) for path in known.parameters]
    sigma = np.sqrt(np.diag(known.matrix))
    kept = [k for k in range(len(index)) if sigma[k] > 0]
    if 1 in index and sigma[index.index(1)] > 0:
        fy, fx = index.index(1), index.index(0) if 0 in index else None
        if fx is None or known.matrix[fx, fy] >= (1 - _FLATTEST) * sigma[fx] * sigma[fy]:
            kept.remove(fy)
    correlation = known.matrix[np.ix_(kept, kept)] / np.outer(sigma[kept], sigma[kept])
    values, vectors = np.linalg.eigh(correlation)
    values = np.maximum(values, _FLATTEST * values.max(initial=0.0))
    root = np.zeros((len(kept), len(OPTICS_PARAMETERS)))
    root[:, [index[k] for k in kept]] = (vectors / np.sqrt(values)).T / sigma[kept]
    return Prior(optics_vector(start), root), tuple(OPTICS_PARAMETERS[index[k]] for k in kept)


def departure_note(optics: Array, covariance: OpticsCovariance, prior: Prior) -> list[str]:
    """Return a note where nine parameters are further from a prior than it and the observations allow.

    ``covariance`` of the result, which holds the prior: departures have that of the prior less that of the
    result (Hausman 1978). Directions of which the observations tell nearly nothing do not count.
    """
    at = [OPTICS_PATHS.index(path) for path in covariance.parameters]
    root = prior.root[:, at]
    left, directions = np.linalg.eigh(root @ covariance.matrix @ root.T)
    told = left < 1 - _LEAST_TOLD
    departures = directions.T @ prior.root @ (optics - prior.mean)
    square, count = float(np.sum(departures[told] ** 2 / (1 - left[told]))), int(told.sum())
    if not count or square <= chi2.isf(_SURPRISE, count):
        return []
    return [
        "the optics depart from those of the camera file by more than the covariance that it states "
        f"(chi-square {square:.0f} of {count} directions): if it is another lens or focus, take the optics "
        "out of its covariance, or give them to rim optics with --start"
    ]


def with_optics(camera: Camera, optics: Optics, covariance: OpticsCovariance) -> Camera:
    """Return a camera with optics that were estimated, their covariance in the place of the old one.

    What the file states of other parameters stays. They err with the optics as they did, as far as the new
    optics follow the old: Cov(e, new) = C_e,old C_old^-1 C_new.
    """
    new = list(covariance.parameters)
    old = camera.covariance
    if old is None:
        return replace(camera, optics=optics, covariance=_covariance(new, covariance.matrix))
    whole = np.asarray(old.matrix.values, float)
    rest = [i for i, path in enumerate(old.parameters) if path not in OPTICS_PATHS]
    both = [i for i, path in enumerate(old.parameters) if path in new]
    follows = np.zeros((len(rest), len(new)))
    if both:
        where = [new.index(old.parameters[i]) for i in both]
        gain = whole[np.ix_(rest, both)] @ np.linalg.pinv(whole[np.ix_(both, both)], hermitian=True)
        follows = gain @ covariance.matrix[where]
    matrix = np.block([[covariance.matrix, follows.T], [follows, whole[np.ix_(rest, rest)]]])
    names: Sequence[str] = [*new, *(old.parameters[i] for i in rest)]
    return replace(camera, optics=optics, covariance=_covariance(names, matrix))


def _covariance(names: Sequence[str], matrix: Array) -> Covariance:
    return Covariance(tuple(names), ArrayFile("covariance.npy", matrix))
