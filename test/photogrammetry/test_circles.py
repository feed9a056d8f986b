"""Circles in amplitude images, against projective geometry and against sums over pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from rim_camera_ros.optics import Optics, project
from rim_camera_ros.photogrammetry import ellipse_centre_offset, find_circles
from rim_camera_ros.photogrammetry.circles import homogenise
from rim_camera_ros.photogrammetry.edges import edge_coverage
from rim_camera_ros.scene import Scene, ScenePose, Surface

from .helpers import HEIGHT, SR3000, WIDTH, area_sampled, camera, conic_centre, disc

PINHOLE = Optics(fx=201.0, fy=198.0, cx=86.3, cy=74.1)


@pytest.mark.parametrize("angle", [0.0, 0.02, 0.4, np.pi / 4, 1.2, -2.7])
@pytest.mark.parametrize("blur", [0.0, 0.35])
def test_coverage_of_a_pixel_equals_the_sum_over_it(angle: float, blur: float) -> None:
    """400 x 400 points in the pixel, each behind a Gaussian edge (0.02 px where sharp)."""
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    x, y = np.meshgrid(fine, fine)
    across = (np.cos(angle), np.sin(angle))
    for depth in (-0.9, -0.31, 0.0, 0.2, 0.55):
        inside = depth + across[0] * x + across[1] * y
        sigma = np.hypot(blur, 0.02)
        expected = ndtr(inside / sigma).mean()
        found = edge_coverage(np.array(depth), np.array(across[0]), np.array(across[1]), np.array(blur))
        assert found == pytest.approx(expected, abs=2e-5)


def test_ellipse_centre_offset_equals_projective_geometry() -> None:
    rotation = Rotation.from_euler("xyz", [0.9, -0.4, 0.7]).as_matrix()
    centres = np.array([[0.21, -0.13, 0.9], [-0.3, 0.25, 1.4]])
    radii = np.array([0.07, 0.0585])
    offsets = ellipse_centre_offset(PINHOLE, centres, np.tile(rotation[:, 2], (2, 1)), radii)
    for centre, radius, offset in zip(centres, radii, offsets, strict=True):
        expected = conic_centre(PINHOLE, centre, rotation, radius) - project(PINHOLE, centre)
        assert np.linalg.norm(expected) > 0.1
        np.testing.assert_allclose(offset, expected, atol=1e-9)


def test_offset_is_nothing_for_points_and_facing_circles_and_nan_behind_the_camera() -> None:
    centres = np.array([[0.1, 0.2, 1.5], [0.0, 0.0, 1.5], [0.1, 0.2, -1.5]])
    offsets = ellipse_centre_offset(PINHOLE, centres, np.tile([0.0, 0, 1], (3, 1)), np.array([0.0, 0.1, 0.1]))
    np.testing.assert_allclose(offsets[:2], 0, atol=1e-12)
    assert np.isnan(offsets[2]).all()


@pytest.mark.long
@pytest.mark.parametrize(("diameter", "limit"), [(6.0, 0.03), (9.0, 0.02), (15.0, 0.012)])
def test_circles_of_a_plate_in_simulated_images(diameter: float, limit: float) -> None:
    """All are found, nothing else is, to the precision that they state; sizes as of 6-15 px."""
    rng = np.random.default_rng(int(diameter))
    distance = 1.6
    radius = diameter / 2 * distance / PINHOLE.fx
    rotation = Rotation.from_euler("xyz", [25, -20, 12], degrees=True).as_matrix()
    spacing = 0.24
    centres = [
        rotation @ np.array([spacing * i, spacing * j, 0]) + (0, 0, distance)
        for i in (-2, -1, 0, 1, 2)
        for j in (-1, 0, 1)
    ]
    discs = [disc(f"c{i}", centre, rotation, radius) for i, centre in enumerate(centres)]
    x, y, z = rotation @ np.array([0, 0, 0.002]) + (0, 0, distance)
    back = Surface(
        name="back", type="plane", reflectivity=0.06, pose=ScenePose((x, y, z), discs[0].pose.orientation)
    )
    frame = area_sampled(camera(PINHOLE), Scene(surfaces=(*discs, back)), rng=rng)
    expected = np.array([conic_centre(PINHOLE, one, rotation, radius) for one in centres])
    found = find_circles(frame.amplitude)
    assert len(found) == len(expected)
    errors, sigmas = [], []
    for u, v in expected:
        nearest = min(found, key=lambda one: np.hypot(one.u - u, one.v - v))
        errors += [nearest.u - u, nearest.v - v]
        sigmas += [nearest.sigma] * 2
        assert nearest.axes[0] == pytest.approx(diameter / 2, rel=0.35)
        assert nearest.contrast > 5
    assert np.sqrt(np.mean(np.square(errors))) < limit
    assert 0.6 < np.sqrt(np.mean(np.square(np.array(errors) / sigmas))) < 1.4


def test_correcting_the_centre_of_a_strongly_inclined_circle() -> None:
    """A circle of 15 cm at 60 deg, 0.9 m away: the ellipse's centre is 0.4 px from the circle's image."""
    rotation = Rotation.from_euler("xyz", [20, 60, 0], degrees=True).as_matrix()
    centre, radius = np.array([0.12, -0.08, 0.9]), 0.075
    wall = Surface(name="wall", type="plane", reflectivity=0.05, pose=ScenePose((0.0, 0.0, 1.4)))
    scene = Scene(surfaces=(disc("circle", centre, rotation, radius), wall))
    frame = area_sampled(camera(), scene, rng=np.random.default_rng(5))
    (found,) = find_circles(frame.amplitude)
    uncorrected = np.array([found.u, found.v]) - project(SR3000, centre)
    offset = ellipse_centre_offset(SR3000, centre[None], rotation[None, :, 2], np.array([radius]))[0]
    assert np.linalg.norm(uncorrected) > 0.3
    assert np.linalg.norm(uncorrected - offset) < 0.03


def _spot(u: float, v: float, radius: float, *, level: float, around: float) -> np.ndarray:
    """A round spot, each pixel a mean of 8 x 8 points."""
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    x = (np.arange(WIDTH)[:, None] + fine).ravel()
    y = (np.arange(HEIGHT)[:, None] + fine).ravel()
    inside = (x[None] - u) ** 2 + (y[:, None] - v) ** 2 <= radius**2
    image = np.where(inside, level, around)
    return image.reshape(HEIGHT, 8, WIDTH, 8).mean(axis=(1, 3))


def test_dark_circles_and_an_uneven_background() -> None:
    rng = np.random.default_rng(3)
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    light = np.exp(-((column - 60) ** 2 + (row - 90) ** 2) / 6000)
    image = _spot(141.3, 22.8, 4.6, level=900.0, around=6000.0) * light + rng.normal(0, 6, light.shape)
    (found,) = find_circles(image, dark=True)
    assert (found.u, found.v) == (pytest.approx(141.3, abs=0.1), pytest.approx(22.8, abs=0.1))
    assert found.contrast == pytest.approx(900 / 6000 - 1, abs=0.05)
    assert find_circles(image) == []


def test_homogenising_by_a_reference_removes_the_illumination() -> None:
    """The thesis divides by the image of an empty black board."""
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    light = np.exp(-((column - 88) ** 2 + (row - 70) ** 2) / 9000)
    image = _spot(30.4, 100.2, 5.0, level=7000.0, around=700.0) * light
    level = homogenise(image, largest_diameter=20, reference=700.0 * light)
    background = level[np.hypot(column - 30, row - 100) > 8]
    assert np.abs(background).max() < 1e-3
    assert level[100, 30] > 0.5


@pytest.mark.parametrize("image", ["noise", "stripe", "clipped", "empty", "unlit"])
def test_what_is_no_circle_is_not_found(image: str) -> None:
    rng = np.random.default_rng(11)
    amplitude = rng.normal(800, 25, (HEIGHT, WIDTH))
    if image == "stripe":
        amplitude[40:43, 20:120] = 6000
    elif image == "clipped":
        amplitude += _spot(1.0, 70.0, 5.0, level=6000.0, around=0.0)
    elif image == "empty":
        amplitude[:] = 0
    elif image == "unlit":
        amplitude[:] = np.nan
    assert find_circles(amplitude) == []


def test_an_image_has_two_dimensions() -> None:
    with pytest.raises(ValueError, match=r"two dimensions, not shape \(2, 3, 4\)"):
        find_circles(np.zeros((2, 3, 4)))
