"""Lens models of CameraInfo against OpenCV's projection, and their conversion to plumb_bob."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics
from rim_camera_ros.imports.lens import Lens, lens_from, lens_of_file, nearest_plumb_bob
from rim_camera_ros.optics import Optics, pixel_rays
from test.imports.drivers import EQUIDISTANT, PLUMB_BOB, RATIONAL, SHAPE, info

#: Azure Kinect NFOV unbinned: 640 x 576, 75 x 65 degrees.
KINECT = Lens("rational_polynomial", 640, 576, 504.2, 504.4, 320.6, 331.3, RATIONAL)
#: The same with a thin prism.
PRISM = replace(KINECT, coefficients=(*RATIONAL, 2e-3, -1e-3, -3e-3, 5e-4))
#: O3R head: 224 x 172 of 105 x 78 degrees.
HEAD = Lens("equidistant", 224, 172, 119.0, 119.5, 111.7, 86.2, EQUIDISTANT)


def projected(lens: Lens, directions: Any) -> Any:
    """Return the pixels of directions by OpenCV's own models."""
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    points = np.concatenate([directions.reshape(-1, 2), np.ones((directions[..., 0].size, 1))], axis=1)
    zero, d = np.zeros(3), np.array(lens.coefficients)
    if lens.model == "equidistant":
        found = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), zero, zero, k, d)[0]
    else:
        found = cv2.projectPoints(points, zero, zero, k, d)[0]
    return found.reshape(*directions.shape)


def grid(lens: Lens) -> Any:
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize(
    "lens", [KINECT, PRISM, HEAD, replace(KINECT, coefficients=PLUMB_BOB, model="plumb_bob")]
)
def test_directions_lead_back_to_their_pixels(lens: Lens) -> None:
    directions = lens.directions()
    assert np.isfinite(directions).all()
    assert np.abs(projected(lens, directions) - grid(lens)).max() < 1e-3


def test_pixels_beyond_a_fold_have_no_direction() -> None:
    # r (1 - 0.4 r^2) turns at r = 0.913, image radius 0.608; the corners lie at 0.93
    lens = Lens("plumb_bob", 81, 65, 55.0, 55.0, 40.0, 32.0, (-0.4, 0.0, 0.0, 0.0, 0.0))
    directions = lens.directions()
    radius = np.hypot(*np.moveaxis(grid(lens) - (40.0, 32.0), -1, 0)) / 55.0
    assert np.isfinite(directions[radius < 0.60]).all()
    assert np.isnan(directions[radius > 0.61]).all()


def test_equidistant_without_distortion_is_the_angle_itself() -> None:
    lens = Lens("equidistant", 101, 81, 60.0, 60.0, 50.0, 40.0)
    found = np.arctan(np.hypot(*lens.directions()[40, 100]))
    assert found == pytest.approx(50.0 / 60.0, abs=1e-9)


@pytest.mark.parametrize(("lens", "rms"), [(KINECT, 0.1), (HEAD, 0.3)])
def test_residual_is_what_it_says(lens: Lens, rms: float) -> None:
    """The stated residual, computed anew from rays of the converted model and OpenCV's projection of them."""
    found = nearest_plumb_bob(lens)
    i = found.intrinsics
    optics = Optics(fx=i.fx, fy=i.fy, cx=i.cx, cy=i.cy, d=i.d)  # type: ignore[arg-type]
    rays = pixel_rays(optics, width=lens.width, height=lens.height)
    good = np.isfinite(rays).all(axis=-1)
    off = np.linalg.norm(projected(lens, (rays[..., :2] / rays[..., 2:])[good]) - grid(lens)[good], axis=-1)
    assert found.lost < 0.01
    assert found.rms < rms
    # residuals in the image of one model and the other agree to their own size
    assert np.sqrt(np.mean(off**2)) == pytest.approx(found.rms, rel=0.15)
    assert found.worst >= found.rms


def test_plumb_bob_is_taken_as_it_is() -> None:
    lens = Lens("plumb_bob", 64, 48, 60.5, 61.0, 30.2, 24.4, PLUMB_BOB)
    found = nearest_plumb_bob(lens)
    expected = Intrinsics(width=64, height=48, fx=60.5, fy=61.0, cx=30.2, cy=24.4, d=PLUMB_BOB)
    assert found.intrinsics == expected
    assert found.worst < 1e-6


def lens_of(line: Any, **options: Any) -> Lens:
    given: dict[str, Any] = {"rectified": False, "shape": SHAPE, "place": "topic /i", **options}
    return lens_from(line.message, **given)


def test_eight_coefficients_are_rational_whatever_the_name() -> None:
    """OrbbecSDK_ROS2 calls Brown's model with six radial terms plumb_bob."""
    assert lens_of(info("/i", 1, d=RATIONAL)).model == "rational_polynomial"
    few = lens_of(info("/i", 1, d=(*PLUMB_BOB, 0.0, 0.0, 0.0)))
    assert (few.model, few.coefficients) == ("plumb_bob", PLUMB_BOB)
    # four coefficients, and a message without a model's name (SICK)
    four = lens_of(info("/i", 1, model="", d=PLUMB_BOB[:4]))
    assert (four.model, four.coefficients) == ("plumb_bob", (*PLUMB_BOB[:4], 0.0))
    assert lens_of(info("/i", 1, model="equidistant", d=(*EQUIDISTANT, 0.0))).coefficients == EQUIDISTANT


def test_rectified_images_have_p_and_no_distortion() -> None:
    lens = lens_of(info("/i", 1), rectified=True)
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.coefficients) == (28.5, 29.5, 15.7, 12.15, ())


def test_binning_and_region() -> None:
    line = info("/i", 1, shape=(480, 640), focal=(500.0, 502.0), centre=(320.5, 240.5))
    line.message.binning_x = line.message.binning_y = 2
    line.message.roi.x_offset, line.message.roi.y_offset = 64, 40
    line.message.roi.width, line.message.roi.height = 320, 200
    lens = lens_of(line, shape=(100, 160))
    assert (lens.fx, lens.fy) == (250.0, 251.0)
    # full pixel 64.5 is the centre of the first binned pixel
    assert (lens.cx, lens.cy) == ((320.5 - 64.5) / 2, (240.5 - 40.5) / 2)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"model": "kannala"}, r"topic /i: the distortion model 'kannala' is not known \(known: plumb_bob"),
        ({"d": (0.1, 0.2, 0.3)}, "3 distortion coefficients"),
        (
            {"focal": (0.0, 0.0)},
            r"uncalibrated camera \(K is 0\) \(calibrate the camera, or give --camera-info",
        ),
        ({"d": (np.nan,) * 5}, "K, D or P is not finite"),
        (
            {"shape": (48, 64)},
            r"camera_info is for 64 x 48 pixels, the images are 32 x 24 \(--topic camera_info",
        ),
    ],
)
def test_what_cannot_be_used_is_named(changes: Any, match: str) -> None:
    with pytest.raises(InputError, match=match):
        lens_of(info("/i", 1, **changes))


OST = """image_width: 640
image_height: 480
camera_name: TOF_ES_21781335
camera_matrix: {rows: 3, cols: 3, data: [694.476204, 0, 341.94269, 0, 692.382156, 227.471231, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.457383, 0.234378, -0.006215, -0.001038, 0.0]}
rectification_matrix: {rows: 3, cols: 3, data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]}
projection_matrix: {rows: 3, cols: 4, data: [619.478, 0, 346.044, 0, 0, 649.642, 223.430, 0, 0, 0, 1, 0]}
"""


def test_calibration_file(tmp_path: Path) -> None:
    path = tmp_path / "ost.yaml"
    path.write_text(OST)
    lens = lens_of_file(path, rectified=False, shape=(480, 640))
    assert (lens.fx, lens.cy, lens.coefficients[2]) == (694.476204, 227.471231, -0.006215)
    assert lens_of_file(path, rectified=True, shape=(480, 640)).fy == 649.642
    with pytest.raises(InputError, match=r"ost\.yaml: camera_matrix: camera_info is for 640 x 480"):
        lens_of_file(path, rectified=False, shape=(48, 64))
    path.write_text("a: 1\n")
    with pytest.raises(InputError, match="not a camera calibration"):
        lens_of_file(path, rectified=False, shape=(480, 640))
