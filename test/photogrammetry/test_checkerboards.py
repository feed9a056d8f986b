"""Corners of checkerboards against their homography."""

from __future__ import annotations

import numpy as np
import pytest

from rim_camera_ros.photogrammetry import find_checkerboard, refine_corners
from rim_camera_ros.photogrammetry.corner_model import CornerModel
from rim_camera_ros.photogrammetry.greyfit import WithDifferences

from .helpers import HEIGHT, WIDTH

ROWS, COLUMNS = 7, 9


def board(cell: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image, means over 8 x 8 points and noise, the corners and the vectors to the next ones."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-0.3, 0.3)
    homography = np.array(
        [
            [np.cos(angle), -np.sin(angle), 88 + rng.uniform(-1, 1)],
            [np.sin(angle), np.cos(angle), 72 + rng.uniform(-1, 1)],
            [*(0.001 * rng.normal(size=2)), 1],
        ]
    )
    x, y = np.meshgrid((np.arange(8 * WIDTH) + 0.5) / 8 - 0.5, (np.arange(8 * HEIGHT) + 0.5) / 8 - 0.5)
    there = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(homography).T
    across = there[..., 0] / there[..., 2] / cell + (COLUMNS + 1) / 2
    down = there[..., 1] / there[..., 2] / cell + (ROWS + 1) / 2
    on_board = (across > 0) & (across < COLUMNS + 1) & (down > 0) & (down < ROWS + 1)
    white = (np.floor(across) + np.floor(down)) % 2 == 1
    large = np.where(on_board & ~white, 1500.0, 8000.0)
    image = large.reshape(HEIGHT, 8, WIDTH, 8).mean(axis=(1, 3)) + rng.normal(0, 25, (HEIGHT, WIDTH))

    def project(dx: float, dy: float) -> np.ndarray:
        grid = np.meshgrid(
            (np.arange(COLUMNS) - (COLUMNS - 1) / 2 + dx) * cell,
            (np.arange(ROWS) - (ROWS - 1) / 2 + dy) * cell,
        )
        points = np.stack([*grid, np.ones_like(grid[0])], axis=-1) @ homography.T
        result: np.ndarray = points[..., :2] / points[..., 2:]
        return result

    corners = project(0, 0)
    return image, corners, np.stack([project(1, 0) - corners, project(0, 1) - corners], axis=-2)


@pytest.mark.long
@pytest.mark.parametrize(("cell", "limit"), [(6.0, 0.012), (8.0, 0.01), (12.0, 0.01)])
def test_corners_of_small_squares(cell: float, limit: float) -> None:
    errors, sigmas = [], []
    for seed in range(4):
        image, expected, _ = board(cell, seed)
        found = find_checkerboard(image, rows=ROWS, columns=COLUMNS)
        assert found is not None
        corners = np.array([[(one.u, one.v) for one in row] for row in found])
        sigma = np.array([[one.sigma for one in row] for row in found])
        if np.abs(corners - expected).max() > cell / 2:  # the board turned by 180 deg is the same board
            corners, sigma = corners[::-1, ::-1], sigma[::-1, ::-1]
        errors.append((corners - expected).ravel())
        sigmas.append(np.repeat(sigma.ravel(), 2))
    error = np.concatenate(errors)
    assert np.sqrt(np.mean(error**2)) < limit
    assert abs(error.mean()) < 0.002
    assert 0.6 < np.sqrt(np.mean((error / np.concatenate(sigmas)) ** 2)) < 1.6


def test_corners_are_refined_from_2_px_away_and_not_where_there_is_none() -> None:
    image, expected, axes = board(9.0, 5)
    start, edges = expected.reshape(-1, 2), axes.reshape(-1, 2, 2)
    found = refine_corners(image, start + np.array([1.5, -1.3]), axes=edges)
    assert all(one is not None for one in found)
    corners = np.array([(one.u, one.v) for one in found if one is not None])
    assert np.sqrt(np.mean((corners - start) ** 2)) < 0.01
    middles = start[:5] + edges[:5].sum(axis=1) / 2
    flat = [one for one in refine_corners(image, middles, axes=edges[:5]) if one is not None]
    # from the middle of a square it may reach a corner, but never invents one
    for corner in flat:
        assert np.linalg.norm(start - (corner.u, corner.v), axis=1).min() < 0.1
    assert refine_corners(np.full((HEIGHT, WIDTH), 900.0), start[:2], axes=edges[:2]) == [None, None]


def test_no_board() -> None:
    noise = np.random.default_rng(1).normal(900, 30, (HEIGHT, WIDTH))
    assert find_checkerboard(noise, rows=5, columns=6) is None
    assert find_checkerboard(np.zeros((HEIGHT, WIDTH)), rows=5, columns=6) is None
    with pytest.raises(ValueError, match="at least 3 x 3 inner corners, not 2 x 6"):
        find_checkerboard(noise, rows=2, columns=6)


@pytest.mark.parametrize("blur", [0.05, 0.3, -0.6])
@pytest.mark.parametrize("angles", [(0.13, 1.62), (0.0, np.pi / 2), (-2.4, 0.9)])
def test_slopes_of_the_corner_are_difference_quotients(blur: float, angles: tuple[float, float]) -> None:
    y, x = (grid.ravel().astype(float) for grid in np.mgrid[3:14, 20:31])
    model = CornerModel(x, y, np.array([25.2, 8.6]), np.array([0.004, -0.007]))
    at = np.array([25.31, 8.43, *angles, 2.1, -0.7, blur, 0.011, -0.006])
    found = model.slopes(at)
    steps = np.full(9, 1e-6)
    expected = WithDifferences(lambda rows: np.stack([model.values(row) for row in rows]), steps).slopes(at)
    # along the sides of the pixels a turn either way widens the projection alike
    kinks = {2: angles[0] == 0.0, 3: angles[1] == np.pi / 2}
    for k in range(9):
        if not kinks.get(k, False):
            np.testing.assert_allclose(
                found[:, k], expected[:, k], atol=2e-6 * max(np.abs(expected).max(), 1)
            )
