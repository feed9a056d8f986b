"""Errors of poses and offsets of pixels by a loss that gross values hardly pull."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rim_camera_ros.fit.robust_poses import PoseErrors, robust_residuals

Array = NDArray[Any]

SHAPE = (18, 24)


def pose(sigma: Array, values: tuple[float, ...] = (0.0, 0.0, 0.0)) -> PoseErrors:
    """An offset and two tilts of a plane that fills all but the first row, known to 1 mm and 2 mrad."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] / 10.0
    used = np.ones(SHAPE, bool)
    used[0] = False
    columns = np.stack([image[used] / sigma[used] for image in (np.ones(SHAPE), u - 1.2, v - 0.9)])
    return PoseErrors(used, columns.astype(np.float32), np.array(values), np.array([0.001, 0.002, 0.002]))


def test_changes_minimise_hubers_loss_with_the_prior_of_the_errors() -> None:
    """Against scipy's general minimiser of the same loss."""
    rng = np.random.default_rng(7)
    sigma = rng.uniform(0.003, 0.012, SHAPE)
    errors = pose(sigma, (0.0011, -0.0026, 0.0004))
    z = np.array([0.0008, 0.0031, -0.0017]) @ errors.columns + rng.standard_normal(errors.columns.shape[1])
    z[rng.random(z.size) < 0.12] -= 30.0

    def residuals(change: Array) -> Array:
        # scipy's Huber is quadratic in the priors, too, as long as they are within one sigma of theirs
        rest = z - change @ errors.columns
        size = np.abs(rest)
        loss = np.where(size <= 1, rest**2, 2 * size - 1)
        return np.concatenate([np.sqrt(loss), (errors.values + change) / errors.priors])

    expected = least_squares(residuals, np.zeros(3), xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    assert errors.changes(z) == pytest.approx(expected, abs=3e-5)
    plain = np.linalg.lstsq(errors.columns.T, z, rcond=None)[0]
    assert np.abs(plain - expected).max() > 0.005


def test_without_errors_of_poses_nothing_changes() -> None:
    nothing = PoseErrors(np.ones((2, 3), bool), np.zeros((0, 6), np.float32), np.zeros(0), np.zeros(0))
    assert nothing.changes(np.arange(6.0)).shape == (0,)
    image = np.array([[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]])
    # three stations are too few to know the offset of a pixel
    result = robust_residuals([image] * 3, [np.ones((2, 3))] * 3, [nothing] * 3)
    assert all(one.tolist() == image.tolist() for one in result)
    assert robust_residuals([], [], []) == []


def test_an_object_stays_where_it_is_although_poses_and_offsets_were_fitted_to_it() -> None:
    """Nine tenths of the step are left, which is what it is judged by.

    A corner is 0.1 m nearer in two of eight stations; the fit before is plain least squares.
    """
    rng = np.random.default_rng(11)
    sigma = np.full(SHAPE, 0.006)
    errors, poses = pose(sigma), []
    corner = np.zeros(SHAPE, bool)
    corner[1:7, 16:] = True
    offsets = 0.004 * rng.standard_normal(SHAPE)
    pulled = []
    for number in range(8):
        image = sigma * rng.standard_normal(SHAPE) - 0.1 * corner * (number < 2)
        values = np.linalg.lstsq(errors.columns.T, (image / sigma)[errors.used], rcond=None)[0]
        image[errors.used] -= values @ errors.columns * sigma[errors.used]
        pulled.append(image + offsets)
        poses.append(pose(sigma, tuple(values)))
    mean = np.mean(pulled, axis=0)
    pulled = [image - mean for image in pulled]
    found = robust_residuals(pulled, [sigma] * 8, poses)
    for number, image in enumerate(found):
        inside, outside = image[corner], image[errors.used & ~corner]
        assert np.median(inside) == pytest.approx(-0.1 if number < 2 else 0.0, abs=0.015)
        assert np.sqrt(np.mean(outside**2)) < 1.1 * 0.006
    # as the fit left it, a third of the step is missing, and what is around it is not noise
    assert np.median(pulled[0][corner]) > -0.07
    assert np.sqrt(np.mean(pulled[0][errors.used & ~corner] ** 2)) > 1.3 * 0.006
