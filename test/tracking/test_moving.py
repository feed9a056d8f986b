"""Clusters of ideal bodies against their known place, area and height."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("sklearn", reason="scikit-learn is an optional extra")

from rim_camera_ros.errors import RimError
from rim_camera_ros.tracking.ground import Ground
from rim_camera_ros.tracking.moving import (
    ClusterSettings,
    clusters,
    detection,
    divided,
    moving_points,
    solid_angle,
)

FOCAL = 200.0
HEIGHT, WIDTH = 144, 176
GROUND = Ground(height=1.6)
RAYS = np.dstack(
    [
        *np.meshgrid((np.arange(WIDTH) - 88.0) / FOCAL, (np.arange(HEIGHT) - 72.0) / FOCAL),
        np.ones((HEIGHT, WIDTH)),
    ]
)
UNIT = RAYS / np.linalg.norm(RAYS, axis=-1, keepdims=True)
PIXEL = solid_angle(3.0 * UNIT)


def cylinder(x: float, y: float, *, radius: float, top: float) -> NDArray[np.float64]:
    """Return the points (H, W, 3) at which the rays meet an upright cylinder on the floor, NaN elsewhere."""
    across, down = RAYS[..., 0], RAYS[..., 1]
    centre = np.array([-y, x])  # optical x, z
    a = across**2 + 1
    b = across * centre[0] + centre[1]
    root = b**2 - a * (centre @ centre - radius**2)
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(root)) / a
        height = GROUND.height - depth * down
        depth = np.where((height >= 0) & (height <= top), depth, np.nan)
    return depth[..., None] * RAYS


def found(*clouds: NDArray[np.float64], settings: ClusterSettings | None = None) -> list:
    points = np.concatenate([one[np.isfinite(one[..., 0])] for one in clouds])
    return clusters(points, GROUND, settings or ClusterSettings(), pixel=PIXEL)


def test_solid_angle_of_a_pixel() -> None:
    # at the image's centre 1 / f^2; less outside, where the median lies
    assert 0.85 / FOCAL**2 < PIXEL < 1.0 / FOCAL**2
    with pytest.raises(RimError, match=r"no neighbouring points \(only organised clouds serve\)"):
        solid_angle(np.full((4, 5, 3), np.nan))


@pytest.mark.parametrize(("x", "y"), [(3.0, 0.4), (4.5, -1.1), (6.0, 1.7)])
def test_the_axis_of_a_cylinder(x: float, y: float) -> None:
    settings = ClusterSettings(body_radius=0.2, lowest=0.0)
    (one,) = found(cylinder(x, y, radius=0.2, top=1.7), settings=settings)
    # pi / 4 holds for parallel rays: next to it are terms of radius / distance
    assert one.position == pytest.approx([x, y], abs=0.01)
    uncorrected = math.hypot(x, y) - np.linalg.norm(np.average(one.cells, axis=0, weights=one.cell_areas))
    assert uncorrected == pytest.approx(math.pi / 4 * 0.2, abs=0.01)
    assert one.top == pytest.approx(1.7, abs=0.03)


def test_the_area_does_not_depend_on_the_distance() -> None:
    near, far = (found(cylinder(x, 0.0, radius=0.2, top=1.6)) for x in (4.9, 7.2))
    # 0.4 m wide, from 0.15 m (lowest) to 1.6 m
    assert near[0].area == pytest.approx(0.4 * 1.45, rel=0.1)
    assert far[0].area == pytest.approx(near[0].area, rel=0.06)


def test_two_people_and_a_chair() -> None:
    people = cylinder(3.5, 0.6, radius=0.18, top=1.7), cylinder(3.9, -0.2, radius=0.18, top=1.75)
    chair = cylinder(3.2, -0.9, radius=0.25, top=0.6)
    both = sorted(found(*people, chair), key=lambda one: one.position[1])
    assert [one.position[1] for one in both] == pytest.approx([-0.2, 0.6], abs=0.03)
    assert all(one.width < 0.45 for one in both)


def test_people_who_touch_are_one_cluster_that_is_divided_where_they_are_expected() -> None:
    together = cylinder(3.5, 0.2, radius=0.18, top=1.7), cylinder(3.5, -0.2, radius=0.18, top=1.7)
    (one,) = found(*together)
    assert one.width == pytest.approx(0.72, abs=0.06)
    left, right = divided(one, np.array([[3.6, 0.3], [3.4, -0.15]]), body_radius=0.18)
    assert left.position == pytest.approx([3.5, 0.2], abs=0.04)
    assert right.position == pytest.approx([3.5, -0.2], abs=0.04)
    assert left.area + right.area == pytest.approx(one.area)
    assert len(divided(one, np.array([[3.5, 0.0], [9.0, 4.0]]), body_radius=0.18)) == 1


def test_few_points_are_nobody() -> None:
    body = cylinder(3.5, 0.2, radius=0.18, top=1.7)
    body[:, 92:] = np.nan
    assert found(body, settings=ClusterSettings(minimum_area=0.4)) == []
    assert clusters(np.zeros((0, 3)), GROUND, ClusterSettings(), pixel=PIXEL) == []


def test_single_pixels_and_noisy_ones_are_excluded() -> None:
    cloud = (2.0 * UNIT).astype(np.float32)
    moving = np.zeros((HEIGHT, WIDTH), bool)
    moving[10:16, 20:27] = True
    moving[50, 60] = moving[51, 61] = True
    moving[90:93, 90:92] = True  # 3 x 2: smaller than the opening
    sigma = np.full((HEIGHT, WIDTH), 0.02)
    sigma[10:16, 24:] = 0.2
    chosen = moving_points(cloud, moving, sigma, ClusterSettings())
    assert chosen.tolist() == cloud[10:16, 20:24].reshape(-1, 3).tolist()


def test_a_detection_of_cells() -> None:
    one = detection(np.array([[3.0, 4.0], [3.0, 4.0]]), np.array([0.1, 0.3]), top=1.7, body_radius=0.2)
    assert one.area == pytest.approx(0.4)
    assert one.position == pytest.approx(np.array([3.0, 4.0]) * (5.0 + math.pi / 4 * 0.2) / 5.0)


def test_without_scikit_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.cluster", None)
    with pytest.raises(RimError, match=r"scikit-learn is not installed.*python3-sklearn"):
        found(cylinder(3.5, 0.2, radius=0.18, top=1.7))
