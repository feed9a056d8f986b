"""Coordinates of one pixel and their precision, against table 2.4 of the thesis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.coordinates import coordinate_derivatives, coordinate_precision, object_coordinates

#: c [mm], D [m], s_D [m], pixels of sigma on the chip; then X, s_X, Y, s_Y, Z, s_Z [m] as printed
TABLE_2_4 = [
    (8, 7.5, 0.01, 1.0, -2.542, 0.031, -2.754, 0.041, 6.493, 0.022),
    (8, 7.5, 0.01, 0.5, -2.542, 0.019, -2.754, 0.024, 6.493, 0.016),
    (8, 2.0, 0.01, 1.0, -0.676, 0.009, -0.732, 0.011, 1.732, 0.010),
    (8, 2.0, 0.01, 0.5, -0.676, 0.006, -0.732, 0.007, 1.732, 0.009),
    (8, 7.5, 0.02, 1.0, -2.542, 0.032, -2.754, 0.041, 6.493, 0.026),
    (8, 7.5, 0.02, 0.5, -2.542, 0.020, -2.754, 0.024, 6.493, 0.022),
    (8, 2.0, 0.02, 1.0, -0.676, 0.011, -0.732, 0.013, 1.732, 0.018),
    (8, 2.0, 0.02, 0.5, -0.676, 0.008, -0.732, 0.010, 1.732, 0.018),
    (12, 7.5, 0.01, 1.0, -1.826, 0.023, -1.978, 0.031, 6.998, 0.014),
    (12, 7.5, 0.01, 0.5, -1.826, 0.013, -1.978, 0.017, 6.998, 0.011),
    (12, 2.0, 0.01, 1.0, -0.485, 0.006, -0.525, 0.009, 1.866, 0.010),
    (12, 2.0, 0.01, 0.5, -0.485, 0.004, -0.525, 0.005, 1.866, 0.009),
    (12, 7.5, 0.02, 1.0, -1.826, 0.023, -1.978, 0.031, 6.998, 0.021),
    (12, 7.5, 0.02, 0.5, -1.826, 0.014, -1.978, 0.017, 6.998, 0.020),
    (12, 2.0, 0.02, 1.0, -0.485, 0.008, -0.525, 0.010, 1.866, 0.019),
    (12, 2.0, 0.02, 0.5, -0.485, 0.006, -0.525, 0.007, 1.866, 0.019),
]
X_S, Y_S = 3.136e-3, 3.398e-3


@pytest.mark.parametrize("row", TABLE_2_4)
def test_table_2_4(row: tuple[float, ...]) -> None:
    c, distance, sigma_distance, pixels, x, s_x, y, s_y, z, s_z = row
    found = object_coordinates(x_s=X_S, y_s=Y_S, camera_constant=c * 1e-3, distance=distance)
    # the first Y is -2.7547, which the table prints cut off and not rounded
    allowed = np.array([0.0005, 0.00075 if (c, distance) == (8, 7.5) else 0.0005, 0.0005]) + 1e-9
    assert np.all(np.abs(found - (x, y, z)) <= allowed)
    sigma = coordinate_precision(
        x_s=X_S,
        y_s=Y_S,
        camera_constant=c * 1e-3,
        distance=distance,
        sigma_x_s=pixels * 39.2e-6,
        sigma_y_s=pixels * 54.8e-6,
        sigma_distance=sigma_distance,
        sigma_camera_constant=0.05e-3,
    )
    assert np.round(sigma, 3).tolist() == pytest.approx([s_x, s_y, s_z], abs=1e-12)


def test_camera_constants_as_printed_do_not_reproduce_the_table() -> None:
    """0.008 mm is a misprint: the point would lie almost in the plane of the sensor."""
    found = object_coordinates(x_s=X_S, y_s=Y_S, camera_constant=8e-6, distance=7.5)
    assert abs(found[2] - 6.493) > 6


@settings(derandomize=True, max_examples=60, deadline=None)
@given(
    x=st.floats(-4e-3, 4e-3),
    y=st.floats(-4e-3, 4e-3),
    c=st.floats(4e-3, 16e-3),
    d=st.floats(0.3, 15.0),
)
def test_derivatives_equal_differences_of_the_coordinates(x: float, y: float, c: float, d: float) -> None:
    point = {"x_s": x, "y_s": y, "distance": d, "camera_constant": c}
    found = coordinate_derivatives(x_s=x, y_s=y, camera_constant=c, distance=d)
    for column, (name, step) in enumerate(
        {"x_s": 1e-7, "y_s": 1e-7, "distance": 1e-4, "camera_constant": 1e-7}.items()
    ):
        upper = object_coordinates(**{**point, name: point[name] + step})
        lower = object_coordinates(**{**point, name: point[name] - step})
        expected = (upper - lower) / (2 * step)
        np.testing.assert_allclose(found[:, column], expected, rtol=2e-6, atol=1e-6 * max(1, d / c))


def test_a_pixel_on_the_axis_sees_straight_ahead() -> None:
    found = object_coordinates(x_s=0.0, y_s=0.0, camera_constant=8e-3, distance=2.5)
    assert found.tolist() == [0.0, 0.0, 2.5]
    sigma = coordinate_precision(
        x_s=0.0,
        y_s=0.0,
        camera_constant=8e-3,
        distance=2.5,
        sigma_x_s=40e-6,
        sigma_y_s=0.0,
        sigma_distance=0.007,
        sigma_camera_constant=1.0,
    )
    # s_X = (D / c - 1) s_x, s_Z = s_D
    assert sigma.tolist() == pytest.approx([(2.5 / 8e-3 - 1) * 40e-6, 0.0, 0.007], rel=1e-12)


def test_arguments_are_named() -> None:
    with pytest.raises(TypeError, match="positional"):
        object_coordinates(X_S, Y_S, 8e-3, 7.5)  # type: ignore[misc]
