"""Rays of a distorted lens, against OpenCV and against lens models that fold back."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rim_camera_ros.optics import (
    Optics,
    distort,
    pixel_rays,
    project,
    ray_derivatives,
    rays_through,
    undistort,
)
from rim_camera_ros.parameters import flatten, with_values

SR3000 = Optics(
    fx=199.8875,
    fy=199.8875,
    cx=89.9925,
    cy=82.3925,
    d=(-0.108270791, -0.0712066115, 0.00106655692, -0.00233270836, 0.47813457),
)
LENSES = [
    SR3000,
    Optics(fx=195.3, fy=139.7, cx=76.5, cy=63.4, d=(0.147987942, -0.51381364, 0.0, 0.0, 0.148598514)),
    Optics(fx=151.0, fy=166.0, cx=91.0, cy=60.5, d=(-0.25, 0.11, 0.003, -0.004, -0.01)),
    Optics(fx=220.0, fy=205.0, cx=70.0, cy=80.0, d=(0.3, 0.2, -0.006, 0.005, 0.1)),
]
PIXELS = np.array([[0.0, 0.0], [175, 0], [0, 143], [175, 143], [12.3, 99.7], [80, 80], [150.2, 31.4]])


def _matrix(o: Optics) -> np.ndarray:
    return np.array([[o.fx, 0, o.cx], [0, o.fy, o.cy], [0, 0, 1.0]])


@pytest.mark.parametrize("optics", LENSES)
def test_rays_equal_opencv(optics: Optics) -> None:
    rays = rays_through(optics, PIXELS)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-14)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), _matrix(optics), np.array(optics.d))
    np.testing.assert_allclose((back[:, 0] - PIXELS) / (optics.fx, optics.fy), 0, atol=1e-9)


@pytest.mark.parametrize("optics", LENSES)
def test_projection_equals_opencv(optics: Optics) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.6, -0.5, 1.1], [0.5, 0.7, 3.9], (40, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(optics), np.array(optics.d))
    np.testing.assert_allclose(project(optics, points), expected[:, 0], atol=1e-9 * 200)
    np.testing.assert_allclose(
        (project(optics, points) - (optics.cx, optics.cy)) / (optics.fx, optics.fy),
        distort(points[:, :2] / points[:, 2:], optics.d),
        atol=1e-13,
    )


@pytest.mark.parametrize("optics", LENSES)
def test_projecting_a_ray_gives_its_pixel(optics: Optics) -> None:
    rays = pixel_rays(optics, width=176, height=144)
    assert rays.shape == (144, 176, 3)
    pixels = project(optics, rays * 3.7)
    row, column = np.mgrid[:144, :176]
    np.testing.assert_allclose(pixels, np.stack([column, row], -1), atol=1e-9 * 220)


def test_directions() -> None:
    """X right, y down, z forward; integer coordinates are pixel centres."""
    rays = pixel_rays(Optics(fx=10.0, fy=20.0, cx=1.0, cy=0.0), width=4, height=3)
    assert rays[0, 1].tolist() == [0, 0, 1]
    assert rays[2, 3].tolist() == pytest.approx((np.array([0.2, 0.1, 1]) / math.sqrt(1.05)).tolist())


def test_points_behind_the_camera_have_no_pixel() -> None:
    found = project(SR3000, np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(found[:2]).all()
    assert found[2].tolist() == [SR3000.cx, SR3000.cy]


def test_tangential_terms_in_the_order_of_ros() -> None:
    """p1 bends y-symmetric: x' = x + 2 p1 x y, y' = y + p1 (r^2 + 2 y^2)."""
    found = distort(np.array([0.2, 0.3]), (0.0, 0.0, 0.01, 0.0, 0.0))
    assert found.tolist() == pytest.approx([0.2 + 0.02 * 0.06, 0.3 + 0.01 * (0.13 + 0.18)], rel=1e-14)
    found = distort(np.array([0.2, 0.3]), (0.0, 0.0, 0.0, 0.01, 0.0))
    assert found.tolist() == pytest.approx([0.2 + 0.01 * (0.13 + 0.08), 0.3 + 0.02 * 0.06], rel=1e-14)


def test_no_distortion_is_the_identity() -> None:
    xy = np.array([[0.3, -0.2], [5.0, 7.0]])
    found = undistort(xy, (0.0,) * 5)
    assert found.tolist() == xy.tolist()
    assert found is not xy


# --- what cannot be inverted ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("radius", "d"),
    [
        # r (1 - r^2 / 2) has its greatest value 0.544 at 0.816
        (0.56, (-0.5, 0.0, 0.0, 0.0, 0.0)),
        (3.0, (-0.5, 0.0, 0.0, 0.0, 0.0)),
        # r (1 - r^2 + 0.3 r^4) rises to 0.411, folds, and rises again behind 1.26: a solution there is none
        (0.43, (-1.0, 0.3, 0.0, 0.0, 0.0)),
        (0.9, (-1.0, 0.3, 0.0, 0.0, 0.0)),
        (2.0, (-1.0, 0.3, 0.0, 0.0, 0.0)),
        # falls from the very centre of the upper half: p1 strong
        (0.4, (0.0, 0.0, -0.5, 0.0, 0.0)),
    ],
)
def test_a_lens_that_folds_back_is_found(radius: float, d: tuple[float, ...]) -> None:
    found = undistort(np.array([[0.01, 0.02], [0.0, radius]]), d)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.543])
def test_up_to_the_fold_it_is_inverted(radius: float) -> None:
    found = undistort(np.array([[radius, 0.0]]), (-0.5, 0.0, 0.0, 0.0, 0.0))[0, 0]
    roots = np.roots([-0.5, 0.0, 1.0, -radius])
    expected = min(r.real for r in roots if abs(r.imag) < 1e-9 and r.real > 0)
    assert found == pytest.approx(expected, abs=1e-8)


@settings(derandomize=True, max_examples=150, deadline=None)
@given(
    d=st.tuples(
        st.floats(-0.6, 0.6),
        st.floats(-0.8, 0.8),
        st.floats(-0.01, 0.01),
        st.floats(-0.01, 0.01),
        st.floats(-0.8, 0.8),
    ),
    angle=st.floats(0, 6.28),
    radius=st.floats(0.05, 0.9),
)
def test_undistortion_inverts_every_lens_without_a_fold(
    d: tuple[float, ...], angle: float, radius: float
) -> None:
    """A fold is where the image of the line from the centre turns back; judged here by differences."""
    end = radius * np.array([math.cos(angle), math.sin(angle)])
    line = np.linspace(0, 1, 400)[:, None] * end
    step = 1e-6
    dx = (distort(line + np.array([step, 0]), d) - distort(line - np.array([step, 0]), d)) / (2 * step)
    dy = (distort(line + np.array([0, step]), d) - distort(line - np.array([0, step]), d)) / (2 * step)
    determinant = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
    trace = dx[:, 0] + dy[:, 1]
    assume(determinant.min() > 0.1 and trace.min() > 0.5)
    found = undistort(distort(end[None], d), d)[0]
    np.testing.assert_allclose(found, end, atol=2e-8)


# --- derivatives ----------------------------------------------------------------------------------


@pytest.mark.parametrize("optics", LENSES)
def test_derivatives_of_rays_equal_opencv(optics: Optics) -> None:
    """A ray that moves by its derivative is imaged onto the same pixel by the changed lens of OpenCV."""
    paths = ("fx", "fy", "cx", "cy", "d.0", "d.1", "d.2", "d.3", "d.4")
    rays = rays_through(optics, PIXELS)
    for path, derivative in zip(paths, ray_derivatives(optics, rays, paths), strict=True):
        np.testing.assert_allclose((derivative * rays).sum(axis=-1), 0, atol=1e-15)
        step = 1e-5 if path.startswith("d") else 1e-3
        sides = []
        for sign in (1, -1):
            changed = with_values(optics, {path: flatten(optics)[path] + sign * step})
            moved = rays + sign * step * derivative
            image, _ = cv2.projectPoints(
                moved, np.zeros(3), np.zeros(3), _matrix(changed), np.array(changed.d)
            )
            sides.append(image[:, 0])
        np.testing.assert_allclose((sides[0] - sides[1]) / step, 0, atol=2e-4, err_msg=path)


def test_rays_beyond_a_fold_have_no_derivative() -> None:
    (found,) = ray_derivatives(SR3000, np.full((2, 3), np.nan), ["fx"])
    assert np.isnan(found).all()
