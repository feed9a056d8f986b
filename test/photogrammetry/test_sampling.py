"""What edges show and hide of the sampling of an image: pixels that see a part of their square."""

from __future__ import annotations

import numpy as np
import pytest

from rim_camera_ros.photogrammetry import refine_corners
from rim_camera_ros.photogrammetry.checkerboards import Corner
from rim_camera_ros.photogrammetry.sampling import (
    POINT_VARIANCE,
    SHORT_WAVES,
    hidden_share,
    sampling_variance,
    shared_covariance,
    shifts_of_edges,
)

SIZE = 100
CELL = 8.0


def seen(
    side: float, angle: float, phase: np.ndarray, *, bow: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image by pixels that see a square of that side, the corners and the edges' vectors.

    ``bow`` [1/px]: curvature of the edges that run across, as a lens has it.
    """
    fine = 1 if side == 0 else 24
    steps = side * ((np.arange(fine) + 0.5) / fine - 0.5)
    place = (np.arange(SIZE)[:, None] + steps).ravel() - SIZE / 2
    x, y = np.meshgrid(place - phase[0], place - phase[1])
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    s = x * along[0] + y * along[1]
    t = x * across[0] + y * across[1] - bow / 2 * s**2
    white = (np.floor(s / CELL) + np.floor(t / CELL)) % 2 == 1
    image = np.where(white, 9000.0, 1000.0).reshape(SIZE, fine, SIZE, fine).mean(axis=(1, 3))
    grid = CELL * np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    corners = grid[:, :1] * along + (grid[:, 1:] + bow / 2 * grid[:, :1] ** 2) * across
    return image, corners + SIZE / 2 + phase, np.tile(CELL * np.stack([along, across]), (len(grid), 1, 1))


def corners_of(image: np.ndarray, places: np.ndarray, axes: np.ndarray) -> tuple[list[Corner], np.ndarray]:
    """Return the corners that were found and their errors (n, 2) px."""
    found = refine_corners(image, places, axes=axes)
    kept = [(corner, place) for corner, place in zip(found, places, strict=True) if corner is not None]
    return [corner for corner, _ in kept], np.array([(corner.u, corner.v) - place for corner, place in kept])


@pytest.mark.parametrize(("side", "rel"), [(0.0, 0.1), (0.5, 0.1), (1.0, None)])
def test_jagged_edges_show_how_much_of_its_square_a_pixel_sees(side: float, rel: float | None) -> None:
    """(1 - a)^2 / 12: the mean square of an edge's shift to the next of what pixels see."""
    rng = np.random.default_rng(4)
    shown = []
    for angle in (0.21, 0.33, 0.47, 0.62):
        found, _ = corners_of(*seen(side, angle, rng.uniform(0, 1, 2)))
        assert len(found) > 60
        shown += [corner.jagged for corner in found]
    variance = sampling_variance(shown)
    # the squares are 24 x 24 rays each: an edge along them would be off by 1/24 px, uniform
    assert variance == pytest.approx((1 - side) ** 2 / 12, rel=rel, abs=None if rel else (1 / 24) ** 2 / 12)


def test_nothing_is_known_without_an_edge() -> None:
    """The mean of (1 - a)^2 / 12 over all a from 0 to 1."""
    assert sampling_variance([]) == pytest.approx(1 / 36)


@pytest.mark.parametrize(("degrees", "least", "most"), [(0, 0.99, 1.0), (90, 0.99, 1.0), (15, 0.0, 0.01)])
def test_edges_along_rows_and_columns_hide_it(degrees: float, least: float, most: float) -> None:
    angle = np.deg2rad(degrees)
    assert least <= hidden_share(np.array([np.cos(angle), np.sin(angle)]), 12.0) <= most


def test_what_corners_of_a_board_along_the_rows_err_by_together_is_stated() -> None:
    """One ray a pixel: all are off by up to half a pixel, alike, in an image that fits without residuals."""
    rng = np.random.default_rng(7)
    together, whole, fitted = [], [], []
    for _ in range(24):
        found, errors = corners_of(*seen(0.0, 0.0, rng.uniform(0, 1, 2)))
        together.append(errors.mean(axis=0))
        whole.append(np.mean(errors**2))
        fitted.append(np.median([corner.sigma for corner in found]))
    assert np.max(fitted) < 0.01
    shifts = np.array([shifts_of_edges(corner.normals, corner.length) for corner in found]) * np.sqrt(
        POINT_VARIANCE
    )
    stated = float(np.mean(np.sum(shifts**2, axis=(1, 2)) / 4))
    assert stated * (1 + SHORT_WAVES) == pytest.approx(1 / 12, rel=0.02)
    # 48 numbers that are uniform over a pixel: their mean square has a relative 1-sigma of 0.13
    assert np.mean(whole) == pytest.approx(1 / 12, rel=0.4)
    places = np.array([(corner.u, corner.v) for corner in found])
    count = len(places)
    covariance = shared_covariance(shifts, places, np.zeros((count, 2, 0)))
    mean = np.tile(np.eye(2), (1, count)) / count
    np.testing.assert_allclose(np.diag(mean @ covariance @ mean.T), stated, rtol=0.02)
    assert np.mean(np.square(together)) == pytest.approx(stated, rel=0.45)


def test_edges_that_the_lens_bends() -> None:
    """Of a curvature of 1/300 px, straight edges lie 0.015 px inside of the bow at the corner."""
    image, places, axes = seen(1.0, 0.3, np.array([0.3, 0.1]), bow=1 / 300)
    middle = np.abs(places - SIZE / 2).max(axis=1) < 20
    bends = np.tile([1 / 300, 0.0], (int(middle.sum()), 1))
    # a bow turns the edges away from their vectors
    with_bends = refine_corners(image, places[middle], axes=axes[middle], bends=bends)
    without_bends = refine_corners(image, places[middle], axes=axes[middle])
    across = np.array([-np.sin(0.3), np.cos(0.3)])
    wrong = []
    for found in (with_bends, without_bends):
        pairs = zip(found, places[middle], strict=True)
        wrong.append(np.mean([((c.u, c.v) - place) @ across for c, place in pairs if c is not None]))
    assert abs(wrong[0]) < 0.003
    assert wrong[1] > 0.01
