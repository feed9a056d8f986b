"""Lens models of CameraInfo: exact directions of the pixels, and the plumb_bob model that fits them best.

Models: plumb_bob and rational_polynomial as OpenCV's calibration module defines them, equidistant as OpenCV's
fisheye module does (Kannala and Brandt 2006); CameraInfo's use of K, D, P, binning and region of interest
follows sensor_msgs/CameraInfo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics
from rim_camera_ros.optics import Optics, pixel_rays, project
from rim_camera_ros.yaml_files import read_yaml

Array = NDArray[np.float64]

_POLYNOMIAL = ("plumb_bob", "rational_polynomial", "thin_prism")
_FISHEYE = ("equidistant", "fisheye")
#: Coefficients that the polynomial model may have; OpenCV's tilted sensor (14) is not among them.
_COUNTS = (4, 5, 8, 12)
#: Newton steps of an inversion, and the longest of them in ideal image coordinates.
_STEPS, _LONGEST = 60, 0.2
#: An inversion has failed if projecting its result misses the pixel by more than this [px].
_INVERTED = 1e-3
#: Most pixels along a side that are used in the fit of plumb_bob.
_GRID = 60
#: Directions farther from the axis than this are not represented in a plane image [tangent of 80 degrees].
_WIDEST = math.tan(math.radians(80.0))


@dataclass(frozen=True)
class Lens:
    """A lens model in pixels of the images at hand. ``coefficients`` empty: no distortion."""

    model: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()

    @property
    def is_plumb_bob(self) -> bool:
        """Whether the model is plumb_bob without a conversion."""
        return self.model == "plumb_bob"

    def directions(self) -> Array:
        """Return the ideal image coordinates x / z, y / z (height, width, 2) of all pixels.

        NaN where the model has no inverse.
        """
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        distorted = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        if not any(self.coefficients):
            return distorted if self.model not in _FISHEYE else self._fisheye(distorted)
        return self._fisheye(distorted) if self.model in _FISHEYE else self._polynomial(distorted)

    def _polynomial(self, distorted: Array) -> Array:
        d = np.zeros(12)
        d[: len(self.coefficients)] = self.coefficients
        target = distorted.reshape(-1, 2)
        xy = target.copy()
        bad = np.zeros(len(xy), bool)
        left = np.arange(len(xy))
        for _ in range(_STEPS):
            off, (a, b, c, e) = _forward(xy[left], d)
            off -= target[left]
            determinant = a * e - b * c
            # the image folds back here: no direction of the pixel lies beyond
            folded = ~((determinant > 0) & (a + e > 0))
            bad[left[folded]] = True
            going = ~folded & ~(np.abs(off).max(axis=-1) < 1e-12)
            left, off, determinant = left[going], off[going], determinant[going]
            if not left.size:
                break
            a, b, c, e = a[going], b[going], c[going], e[going]
            step = np.stack([e * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]], axis=-1)
            step /= determinant[:, None]
            # limited, as a long step may jump over the fold
            length = np.hypot(step[:, 0], step[:, 1])
            xy[left] -= step * np.minimum(1.0, _LONGEST / np.maximum(length, 1e-30))[:, None]
        rest = np.abs(_forward(xy, d)[0] - target).max(axis=-1) * max(self.fx, self.fy)
        bad |= ~(rest < _INVERTED) | ~(np.hypot(xy[:, 0], xy[:, 1]) < _WIDEST)
        xy[bad] = np.nan
        return xy.reshape(distorted.shape)

    def _fisheye(self, distorted: Array) -> Array:
        d = np.zeros(4)
        d[: len(self.coefficients)] = self.coefficients[:4]
        bent = np.hypot(distorted[..., 0], distorted[..., 1])
        angle = np.minimum(bent, 1.5)
        powers = np.array([2, 4, 6, 8])
        for _ in range(30):
            even = angle[..., None] ** powers
            value = angle * (1 + even @ d)
            slope = 1 + even @ (d * (powers + 1))
            with np.errstate(divide="ignore", invalid="ignore"):
                angle = np.clip(angle - (value - bent) / slope, 0.0, 1.55)
        value = angle * (1 + (angle[..., None] ** powers) @ d)
        slope = 1 + (angle[..., None] ** powers) @ (d * (powers + 1))
        good = (np.abs(value - bent) * max(self.fx, self.fy) < _INVERTED) & (slope > 0)
        good &= np.tan(angle) < _WIDEST
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = np.where(bent > 1e-12, np.tan(angle) / bent, 1.0)
        result: Array = np.where(good[..., None], distorted * stretch[..., None], np.nan)
        return result


def _forward(xy: Array, d: Array) -> tuple[Array, tuple[Array, ...]]:
    """Return distorted coordinates (n, 2) of ideal ones, and their Jacobian [[a, b], [c, e]] (n each).

    ``d``: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, as OpenCV orders them.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d
    x, y = xy[:, 0], xy[:, 1]
    r = x * x + y * y
    above, below = 1 + r * (k1 + r * (k2 + r * k3)), 1 + r * (k4 + r * (k5 + r * k6))
    ratio = above / below
    slope = (k1 + r * (2 * k2 + 3 * r * k3) - ratio * (k4 + r * (2 * k5 + 3 * r * k6))) / below
    prism_x, prism_y = 2 * (s1 + 2 * s2 * r), 2 * (s3 + 2 * s4 * r)
    image = np.stack(
        [
            x * ratio + 2 * p1 * x * y + p2 * (r + 2 * x * x) + r * (s1 + s2 * r),
            y * ratio + p1 * (r + 2 * y * y) + 2 * p2 * x * y + r * (s3 + s4 * r),
        ],
        axis=-1,
    )
    both = 2 * slope * x * y
    return image, (
        ratio + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + prism_x * x,
        both + 2 * p1 * x + 2 * p2 * y + prism_x * y,
        both + 2 * p1 * x + 2 * p2 * y + prism_y * x,
        ratio + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + prism_y * y,
    )


@dataclass(frozen=True)
class PlumbBob:
    """The best fitting plumb_bob, and its residuals relative to the exact model in pixels.

    ``lost``: the share of pixels for which the exact model or the fitted one has no direction.
    """

    intrinsics: Intrinsics
    rms: float
    worst: float
    lost: float


def nearest_plumb_bob(lens: Lens) -> PlumbBob:
    """Fit fx fy cx cy k1 k2 p1 p2 k3 to the directions of the pixels by least squares.

    Raises `InputError` where fewer than half of the pixels have a direction.
    """
    directions = lens.directions()
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1)
    valid = np.isfinite(directions).all(axis=-1)
    if valid.mean() < 0.5:
        raise InputError(
            f"the lens model {lens.model} has a direction for {valid.mean():.0%} of the pixels only",
            place="camera_info",
            remedy="calibrate the camera anew, or give --camera-info FILE",
        )
    step = max(1, math.ceil(max(lens.width, lens.height) / _GRID))
    some = np.zeros_like(valid)
    some[::step, ::step] = True
    some &= valid
    points = np.concatenate([directions[some], np.ones((int(some.sum()), 1))], axis=-1)
    d = [*lens.coefficients[:5], 0.0, 0.0, 0.0, 0.0, 0.0][:5] if lens.model not in _FISHEYE else [0.0] * 5

    def optics(p: Array) -> Optics:
        d = tuple(float(one) for one in p[4:])
        return Optics(fx=float(p[0]), fy=float(p[1]), cx=float(p[2]), cy=float(p[3]), d=d)  # type: ignore[arg-type]

    def off(p: Array) -> Array:
        apart: Array = project(optics(p), points) - pixels[some]
        return apart.ravel()

    start = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *d])
    if lens.is_plumb_bob:
        best = start
    else:
        if not np.isfinite(off(start)).all() or np.abs(off(start)).max() > max(lens.width, lens.height):
            start[4:] = 0.0
        scale = np.array([lens.fx, lens.fy, lens.width, lens.height, 1.0, 1.0, 0.01, 0.01, 1.0])
        best = least_squares(off, start, x_scale=scale, method="trf", max_nfev=500).x
    fitted = optics(best)
    rays = np.concatenate([directions, np.ones((*directions.shape[:2], 1))], axis=-1)
    rest = np.linalg.norm(project(fitted, np.where(valid[..., None], rays, 1.0)) - pixels, axis=-1)
    try:
        inverse = np.isfinite(pixel_rays(fitted, width=lens.width, height=lens.height)).all(axis=-1)
    except ValueError as error:
        raise InputError(
            f"no plumb_bob model follows the lens model {lens.model}: {error}",
            place="camera_info",
            remedy="record rectified images, or give --camera-info FILE of a plumb_bob calibration",
        ) from None
    both = valid & inverse
    intrinsics = Intrinsics(
        width=lens.width,
        height=lens.height,
        fx=fitted.fx,
        fy=fitted.fy,
        cx=fitted.cx,
        cy=fitted.cy,
        d=fitted.d,
    )
    return PlumbBob(
        intrinsics,
        rms=float(np.sqrt(np.mean(rest[both] ** 2))),
        worst=float(rest[both].max()),
        lost=float(1 - both.mean()),
    )


def lens_from(message: Any, *, rectified: bool, shape: tuple[int, int], place: str) -> Lens:
    """Return the lens of a sensor_msgs/CameraInfo for images of ``shape`` (height, width).

    ``rectified``: the images are rectified; then P is used, without distortion. Binning and a region of
    interest are applied. Raises `InputError` for an uncalibrated camera, an unknown model, or a size that
    does not fit the images.
    """
    k = [float(x) for x in (message.k if hasattr(message, "k") else message.K)]
    d = tuple(float(x) for x in (message.d if hasattr(message, "d") else message.D))
    p = [float(x) for x in (message.p if hasattr(message, "p") else message.P)]
    remedy = "calibrate the camera, or give --camera-info FILE"
    if not all(map(math.isfinite, (*k, *d, *p))):
        raise InputError("K, D or P is not finite", place=place, remedy=remedy)
    model = str(message.distortion_model).strip() or "plumb_bob"
    if rectified:
        values = (p[0], p[5], p[2], p[6]) if p[0] else (k[0], k[4], k[2], k[5])
        model, d = "plumb_bob", ()
    else:
        values = (k[0], k[4], k[2], k[5])
    if not (values[0] > 0 and values[1] > 0):
        raise InputError("camera_info is of an uncalibrated camera (K is 0)", place=place, remedy=remedy)
    lens = Lens(model, int(message.width), int(message.height), *values, coefficients=d)
    return _fitting(_checked(lens, place), message, shape, place)


def _checked(lens: Lens, place: str) -> Lens:
    """Return the lens with its model by the number of coefficients, as some drivers call all plumb_bob."""
    d = lens.coefficients
    if lens.model in _FISHEYE:
        if len(d) > 4 and any(d[4:]):
            raise InputError(f"equidistant with {len(d)} coefficients", place=place, remedy="it has four")
        return replace(lens, model="equidistant", coefficients=d[:4])
    if lens.model not in _POLYNOMIAL:
        raise InputError(
            f"the distortion model '{lens.model}' is not known",
            place=place,
            remedy=f"known: {', '.join((*_POLYNOMIAL, 'equidistant'))}; or give --camera-info FILE",
        )
    if not any(d):
        return replace(lens, model="plumb_bob", coefficients=())
    if len(d) not in _COUNTS:
        raise InputError(
            f"{len(d)} distortion coefficients", place=place, remedy="plumb_bob has 5, rational_polynomial 8"
        )
    if not any(d[5:]):
        return replace(lens, model="plumb_bob", coefficients=(*d[:5], 0.0)[:5])
    return replace(lens, model="rational_polynomial")


def _fitting(lens: Lens, message: Any, shape: tuple[int, int], place: str) -> Lens:
    height, width = shape
    roi = message.roi
    x, y = int(roi.x_offset), int(roi.y_offset)
    cut = (int(roi.width) or lens.width, int(roi.height) or lens.height)
    bins = (max(1, int(message.binning_x)), max(1, int(message.binning_y)))
    if (lens.width, lens.height) == (width, height) and not (x or y):
        return lens
    if (cut[0] // bins[0], cut[1] // bins[1]) != (width, height):
        raise InputError(
            f"camera_info is for {cut[0] // bins[0]} x {cut[1] // bins[1]} pixels,"
            f" the images are {width} x {height}",
            place=place,
            remedy="--topic camera_info=NAME of the distance image, or --camera-info FILE",
        )
    return replace(
        lens,
        width=width,
        height=height,
        fx=lens.fx / bins[0],
        fy=lens.fy / bins[1],
        # the centre of a binned pixel lies between those of its parts
        cx=(lens.cx - x - (bins[0] - 1) / 2) / bins[0],
        cy=(lens.cy - y - (bins[1] - 1) / 2) / bins[1],
    )


def lens_of_file(path: Path, *, rectified: bool, shape: tuple[int, int]) -> Lens:
    """Return the lens of a calibration file, as written by camera_calibration and camera_info_manager.

    Raises `InputError` for a file in another form.
    """
    document = read_yaml(path)

    def values(key: str) -> list[float]:
        group = document.data.get(key)
        data = group.get("data") if isinstance(group, dict) else group
        if not isinstance(data, list) or not all(isinstance(one, int | float) for one in data):
            raise document.error((key,), "is missing or holds no numbers", "as camera_calibration writes it")
        return [float(one) for one in data]

    if not isinstance(document.data, dict) or "camera_matrix" not in document.data:
        raise document.error((), "not a camera calibration", "as camera_calibration's ost.yaml")
    k, d = values("camera_matrix"), values("distortion_coefficients")
    size = [document.data.get(f"image_{side}") for side in ("width", "height")]
    if len(k) != 9 or not all(isinstance(one, int) and one > 0 for one in size):
        raise document.error((), "image_width, image_height or camera_matrix is wrong", "9 numbers in it")
    p = values("projection_matrix") if rectified and "projection_matrix" in document.data else []
    model = str(document.data.get("distortion_model", "plumb_bob"))
    fields = {"k": k, "d": d, "p": p if len(p) == 12 else [0.0] * 12, "distortion_model": model}
    region = _Fields(x_offset=0, y_offset=0, width=0, height=0)
    message = _Fields(**fields, width=size[0], height=size[1], binning_x=0, binning_y=0, roi=region)
    try:
        return lens_from(message, rectified=rectified, shape=shape, place="camera_matrix")
    except InputError as error:
        raise error.located(path) from None


class _Fields:
    """Fields by name, like those of a message."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)
