"""Powers of poses and reflectivities of tiles: a pose that sees one tile most does not tell them apart."""

import numpy as np
import pytest

from rim_camera_ros.diagnose.setup_likelihood import _light

#: Log errors of the power of three poses and of the reflectivity of four tiles, which sum up to 0.
POWERS = np.array([0.11, -0.07, 0.23])
ERRORS = np.array([0.09, -0.19, 0.06, 0.04])


def pixels(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, ...]:
    """Return pose, tile and log ratio of 3,000 pixels; the second tile fills most of the last pose."""
    shares = ([0.4, 0.2, 0.2, 0.2], [0.3, 0.1, 0.3, 0.3], [0.1, 0.7, 0.1, 0.1])
    pose = np.repeat(np.arange(3), 1000)
    tile = np.concatenate([rng.choice(4, 1000, p=share) for share in shares])
    return pose, tile, POWERS[pose] + ERRORS[tile] + noise * rng.standard_normal(pose.size)


def test_the_power_of_a_pose_is_not_the_error_of_the_tile_that_fills_it() -> None:
    pose, tile, ratio = pixels(np.random.default_rng(4), 0.05)
    variance, weight = np.full(ratio.size, 0.05**2), np.ones(ratio.size)
    found = _light(pose, tile, ratio, variance, weight, sigma=np.full(4, 0.2), poses=3)
    assert found.errors == pytest.approx(ERRORS, abs=0.01)
    assert found.power == pytest.approx(POWERS, abs=0.01)


def test_what_reflectivities_cost_is_the_evidence_of_the_normal_model() -> None:
    pose, tile, ratio = pixels(np.random.default_rng(5), 0.0)
    sigma, precision = np.array([0.05, 0.1, 0.2, 0.1]), 0.02**-2
    weight, variance = np.full(ratio.size, 0.25), np.full(ratio.size, 0.25 * 0.02**2 * 1000)
    found = _light(pose, tile, ratio, variance, weight, sigma=sigma, poses=3)
    # powers integrated out with a flat prior: the errors of tiles have the precision that poses leave
    share = np.array([[np.mean(tile[pose == k] == t) for t in range(4)] for k in range(3)])
    left = precision * (np.diag(share.sum(axis=0)) - share.T @ share)
    determinant = np.linalg.slogdet(np.eye(4) + np.diag(sigma) @ left @ np.diag(sigma))[1]
    assert found.cost == pytest.approx(np.sum(found.errors**2 / sigma**2) + determinant, rel=1e-6)


def test_a_pose_of_which_nothing_is_known_has_no_error_of_its_power() -> None:
    nothing = np.full(5, np.inf)
    found = _light(
        np.zeros(5, int), np.arange(5) % 2, nothing, np.ones(5), np.ones(5), sigma=np.full(2, 0.1), poses=1
    )
    assert found.power == pytest.approx([0.0])
    assert found.errors == pytest.approx([0.0, 0.0])
    assert found.cost == pytest.approx(0.0, abs=1e-9)
