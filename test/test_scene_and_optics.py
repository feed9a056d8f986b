"""Rays of a distorted lens against OpenCV; surfaces against closed forms; poses against scipy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rim_camera_ros.frame import Pose
from rim_camera_ros.geometry import see
from rim_camera_ros.optics import Optics, distort, pixel_rays, project, rays_beyond, rays_through, undistort
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Surface, Texture

OPTICS = Optics(fx=199.9, fy=196.4, cx=89.99, cy=62.4, d=(-0.108, -0.07, 0.0011, -0.0023, 0.12))


def test_rays_are_those_of_opencv() -> None:
    rays = pixel_rays(OPTICS, width=176, height=144)
    matrix = np.array([[199.9, 0, 89.99], [0, 196.4, 62.4], [0, 0, 1.0]])
    pixels = np.stack(np.meshgrid(np.arange(176.0), np.arange(144.0)), axis=-1).reshape(-1, 1, 2)
    ideal = rays[..., :2] / rays[..., 2:]
    points = np.concatenate([ideal.reshape(-1, 2), np.ones((176 * 144, 1))], axis=1)
    projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(OPTICS.d))
    # to 1e-9 in normalised coordinates is 2e-7 px
    np.testing.assert_allclose(projected, pixels, atol=4e-7)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(project(OPTICS, 3.7 * rays).reshape(-1, 1, 2), pixels, atol=4e-7)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.tuples(
        st.floats(-0.3, 0.3),
        st.floats(-0.2, 0.2),
        st.floats(-0.01, 0.01),
        st.floats(-0.01, 0.01),
        st.floats(-0.1, 0.1),
    )
)
def test_undistort_inverts_distort(d: tuple[float, ...]) -> None:
    xy = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 7), np.linspace(-0.36, 0.36, 5)), axis=-1)
    back = undistort(distort(xy, d), d)
    known = np.isfinite(back[..., 0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(distort(back, d)[known], distort(xy, d)[known], atol=1e-9)


def test_where_the_lens_folds_back_nothing_is_seen() -> None:
    """R (1 - 0.26 r^4 + ...) never reaches the corner of a Kinect v2."""
    kinect = Optics(fx=365.5, fy=365.5, cx=260.3, cy=197.6, d=(0.0847, -0.2594, -0.0076, 0.0055, 0.0))
    rays = pixel_rays(kinect, width=512, height=424)
    lost = np.isnan(rays[..., 0])
    assert 0.01 < lost.mean() < 0.04
    v, u = np.nonzero(lost)
    assert (np.hypot((u - 260.3) / 365.5, (v - 197.6) / 365.5) > 0.79).all()
    with pytest.raises(ValueError, match="folds back"):
        pixel_rays(Optics(fx=20.0, fy=20.0, cx=88.0, cy=72.0, d=(-0.9, 0, 0, 0, 0)), width=176, height=144)


def test_quaternions_are_those_of_scipy() -> None:
    for q in Rotation.random(20, random_state=4).as_quat():
        matrix = Rotation.from_quat(q).as_matrix()
        np.testing.assert_allclose(rotation_matrix(tuple(q)), matrix, atol=1e-14)
        np.testing.assert_allclose(Rotation.from_quat(quaternion(matrix)).as_matrix(), matrix, atol=1e-14)


def test_camera_motion_is_the_exponential_of_its_twist() -> None:
    linear, angular, seconds = np.array([0.3, -0.2, 0.5]), np.array([0.4, 1.1, -0.6]), 0.7
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, 0.6, 1.1], [-0.6, 0, -0.4], [-1.1, 0.4, 0]]
    twist[:3, 3] = linear
    moved = scipy.linalg.expm(twist * seconds)
    q = Rotation.from_rotvec([0.3, 0.1, -0.7]).as_quat()
    before = np.eye(4)
    before[:3, :3], before[:3, 3] = Rotation.from_quat(q).as_matrix(), (0.4, 0.9, 2.2)
    expected = np.linalg.inv(moved) @ before
    pose = CameraMotion(tuple(linear), tuple(angular)).carry(Pose((0.4, 0.9, 2.2), tuple(q)), seconds)
    np.testing.assert_allclose(pose.position, expected[:3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(pose.orientation), expected[:3, :3], atol=1e-12)


def one(surface: Surface, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scene = Scene(surfaces=(surface,))
    seen = see(scene, scene.fixed_poses(), rays)
    return seen.distance, seen.cos_incidence, seen.reflectivity


def test_plane_sphere_disc_rectangle() -> None:
    directions = np.array([[[0.0, 0, 1], [0.3, -0.1, 1], [-0.2, 0.4, 1], [0.0, 0.9, 1]]])
    rays = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    q = tuple(Rotation.from_euler("y", 30, degrees=True).as_quat())
    normal = np.array([np.sin(np.pi / 6), 0, np.cos(np.pi / 6)])
    distance, cosine, _ = one(Surface(name="p", type="plane", pose=ScenePose((0.1, 0, 2.0), q)), rays)
    np.testing.assert_allclose(distance, (np.array([0.1, 0, 2.0]) @ normal) / (rays @ normal), rtol=1e-14)
    np.testing.assert_allclose(cosine, rays @ normal, rtol=1e-14)
    # from behind a plane is seen as well: two sides
    turned = tuple((Rotation.from_euler("x", 180, degrees=True) * Rotation.from_quat(q).inv()).as_quat())
    assert np.isfinite(
        one(Surface(name="p", type="plane", pose=ScenePose((0.1, 0, 2.0), turned)), rays)[0]
    ).any()
    distance, cosine, _ = one(
        Surface(name="s", type="sphere", radius=0.5, pose=ScenePose((0.0, 0.0, 3.0))), rays
    )
    assert distance[0, 0] == pytest.approx(2.5)
    assert cosine[0, 0] == pytest.approx(1.0)
    assert np.isnan(distance[0, 1:]).all()
    distance, _, _ = one(Surface(name="d", type="disc", radius=0.64, pose=ScenePose((0.0, 0.0, 2.0))), rays)
    assert np.isfinite(distance).tolist() == [[True, True, False, False]]
    board = Surface(name="r", type="rectangle", size=(0.9, 1.7), pose=ScenePose((0.0, 0.0, 2.0)))
    assert np.isfinite(one(board, rays)[0]).tolist() == [[True, False, True, False]]


def test_texture_tiles() -> None:
    """Tile (i, j): i = floor(y / cell_y) mod rows, j = floor(x / cell_x) mod columns, also below 0."""
    texture = Texture(cell=(0.3, 0.2), values=NestedList(np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])))
    x = np.array([0.01, 0.31, -0.01, -0.31, 0.95])
    y = np.array([0.01, 0.21, -0.01, 0.39, -0.21])
    assert texture.reflectivity(x, y).tolist() == [0.1, 0.5, 0.6, 0.5, 0.1]


def test_the_nearest_surface_is_seen() -> None:
    scene = Scene(
        surfaces=(
            Surface(name="far", type="plane", pose=ScenePose((0, 0, 3.0))),
            Surface(name="near", type="rectangle", size=(0.2, 0.2), pose=ScenePose((0, 0, 1.0))),
            Surface(name="behind", type="plane", pose=ScenePose((0, 0, -1.0))),
        )
    )
    rays = rays_through(
        Optics(10.0, 10.0, 4.0, 4.0), np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), -1)
    )
    seen = see(scene, scene.fixed_poses(), rays)
    assert seen.surface[4, 4] == 1
    assert seen.surface[0, 0] == 0
    assert (seen.surface >= 0).all()


def test_rays_beyond_the_array_fill_the_rest_of_a_cone() -> None:
    """2 pi (1 - cos 75 degrees) less the solid angle of the array's pixels, and none of them in the image."""
    widest = np.radians(75.0)
    rays, solid = rays_beyond(OPTICS, width=176, height=144, step=0.01, widest=widest)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    assert rays[:, 2].min() >= np.cos(widest)
    points = rays[rays[:, 2] > 0.9]
    matrix = np.array([[199.9, 0, 89.99], [0, 196.4, 62.4], [0, 0, 1.0]])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(OPTICS.d))
    inside = np.all((seen[:, 0] > -0.5) & (seen[:, 0] < (175.5, 143.5)), axis=-1)
    assert not inside.any()
    array = pixel_rays(OPTICS, width=176, height=144)
    down, across = np.gradient(array, axis=0), np.gradient(array, axis=1)
    pixels = np.linalg.norm(np.cross(down, across), axis=-1).sum()
    assert solid.sum() == pytest.approx(2 * np.pi * (1 - np.cos(widest)) - pixels, rel=0.003)
