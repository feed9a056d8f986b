"""Optics and covariance of a camera file: as the prior of an adjustment, and replaced by its result."""

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

#: Least eigenvalue of the stated correlation, over the largest: no direction counts as known more than a
#: thousand times better than the worst.
_FLATTEST = 1e-6
#: Departures from the stated optics are noted where their probability by chance is below this.
_SURPRISE = 1e-3
#: Directions count in that test if the observations reduce their prior variance at least by this share.
_LEAST_REDUCTION = 1e-3


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

    Parameters that are stated exactly are not in it, nor is fy where it follows fx or where fx is not in it:
    then the ratio of the two is held.
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
    """Return a note where the nine parameters depart from the prior by more than their errors allow.

    ``covariance``: that of the result, prior included. The covariance of the departures is that of the prior
    less that of the result (Hausman 1978). Directions in which the observations add nearly nothing to the
    prior do not count.
    """
    at = [OPTICS_PATHS.index(path) for path in covariance.parameters]
    root = prior.root[:, at]
    left, directions = np.linalg.eigh(root @ covariance.matrix @ root.T)
    informed = left < 1 - _LEAST_REDUCTION
    departures = directions.T @ prior.root @ (optics - prior.mean)
    square, count = float(np.sum(departures[informed] ** 2 / (1 - left[informed]))), int(informed.sum())
    if not count or square <= chi2.isf(_SURPRISE, count):
        return []
    return [
        "the optics depart from those of the camera file by more than the covariance that it states "
        f"(chi-square {square:.0f} of {count} directions): if it is another lens or focus, take the optics "
        "out of its covariance, or give them to rim optics with --start"
    ]


def with_optics(camera: Camera, optics: Optics, covariance: OpticsCovariance) -> Camera:
    """Return a camera with estimated optics, their covariance in place of the old one.

    The covariance of other parameters stays. They stay correlated with the optics as far as the new optics
    depend on the old: Cov(e, new) = C_e,old C_old^-1 C_new.
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
