"""Circular targets in amplitude images, in sub-pixels (Kahlmann 2007, sec. 3.2.2).

The thesis' steps: homogenise the illumination, enhance the edges with a Laplace filter, search the
threshold, fit ellipses. It stops at ellipses of a binary image; here each ellipse is fitted to the grey
values, which also says how precise it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.photogrammetry.edges import edge_coverage
from rim_camera_ros.photogrammetry.greyfit import WithDifferences, fit_grey_values

Array = NDArray[np.float64]
Image = NDArray[Any]

#: Pixels around a target that show its background, in px from the edge.
MARGIN = 3.0
#: Number of thresholds that are tried, and the least number at which a target must appear.
_THRESHOLDS = 24
_PERSISTENCE = 2
#: Residuals of a fit in units of the contrast between target and background, above which it is no ellipse.
_LARGEST_RESIDUAL = 0.2
#: Least contrast in units of the residuals' RMS, and least of (target - background) / background.
_LEAST_SIGNIFICANCE = 5.0
_LEAST_CONTRAST = 0.15
#: Least ratio of the axes: a circle seen at 78 deg.
_LEAST_ROUNDNESS = 0.2
_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-4, 1e-5, 1e-5])
#: Greatest size of the logarithm of an axis in px.
_MOST_LOG = 20.0


@dataclass(frozen=True, slots=True)
class Ellipse:
    """The image of a circle: centre (u, v) in px (column, row), its ``sigma`` in px (RMS of u and v).

    ``shape``: (a_uu, a_uv, a_vv) of the matrix A in px^2 for which (p - c)' A^-1 (p - c) = 1 on the edge.
    ``contrast``: (target - background) / background; negative for a dark target. ``covariance``: of (u, v),
    as (var u, cov, var v) in px^2.
    """

    u: float
    v: float
    sigma: float
    shape: tuple[float, float, float]
    contrast: float
    covariance: tuple[float, float, float]

    @property
    def axes(self) -> tuple[float, float]:
        """Lengths of the long and the short semi-axis in px."""
        a_uu, a_uv, a_vv = self.shape
        mean, half = (a_uu + a_vv) / 2, np.hypot((a_uu - a_vv) / 2, a_uv)
        return (float(np.sqrt(mean + half)), float(np.sqrt(max(mean - half, 0.0))))


def homogenise(
    amplitude: Image, *, largest_diameter: float, reference: Image | None = None, dark: bool = False
) -> Array:
    """Return the logarithm of the amplitude (H, W) over the illumination of the background, with median 0.

    ``reference``: an image of the empty background (the thesis' black board) by which to divide. Without it
    the background is estimated by a grey opening, which removes everything bright (``dark``: dark) and
    narrower than ``largest_diameter`` px. Pixels that are not finite or not positive count as unlit.
    """
    image = np.where(np.isfinite(amplitude) & (amplitude > 0), amplitude, 0).astype(np.float32)
    lit = image[image > 0]
    if not lit.size:
        return np.zeros(image.shape)
    # what noise does to the logarithm of dark pixels must not look like a target
    floor = 0.02 * float(np.quantile(lit, 0.95))
    image = np.log(image + floor)
    if reference is not None:
        background = np.log(np.maximum(np.nan_to_num(reference), 0).astype(np.float32) + floor)
    else:
        size = 2 * int(np.ceil(largest_diameter / 2 + 1)) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        kind = cv2.MORPH_CLOSE if dark else cv2.MORPH_OPEN
        smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
        background = cv2.morphologyEx(smooth, kind, kernel, borderType=cv2.BORDER_REPLICATE)
        background = cv2.GaussianBlur(background, (0, 0), largest_diameter / 4)
    result = (image - background).astype(np.float64)
    return result - float(np.median(result))


def enhance_edges(homogenised: Image) -> Array:
    """Return the image (H, W) less its smoothed Laplacian, which steepens edges and parts near targets."""
    image = np.asarray(homogenised, np.float32)
    laplacian = cv2.Laplacian(image, cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(laplacian, (7, 7), 0, borderType=cv2.BORDER_REPLICATE)
    result: Array = (image - smooth).astype(np.float64)
    return result


def find_circles(
    amplitude: Image,
    *,
    smallest_diameter: float = 4.0,
    largest_diameter: float = 40.0,
    reference: Image | None = None,
    dark: bool = False,
) -> list[Ellipse]:
    """Return the images of circular targets in an amplitude image (H, W), from top to bottom.

    Targets are bright on a darker background (``dark``: the reverse), ellipses whose axes lie between the two
    diameters in px, and wholly within the image. ``reference`` as in `homogenise`. ``sigma`` of a target is
    that of one image, by the noise and the misfit found around it. Raises ValueError for an image that does
    not have two dimensions.
    """
    if amplitude.ndim != 2:
        raise ValueError(f"an amplitude image has two dimensions, not shape {amplitude.shape}")
    level = homogenise(amplitude, largest_diameter=largest_diameter, reference=reference, dark=dark)
    level = enhance_edges(-level if dark else level)
    candidates = _candidates(level, smallest=smallest_diameter, largest=largest_diameter)
    found = []
    for i, candidate in enumerate(candidates):
        others = [other for j, other in enumerate(candidates) if j != i]
        ellipse = fit_ellipse(
            amplitude, centre=candidate[:2], shape=candidate[2:5], others=[o[:5] for o in others]
        )
        if ellipse is None or ellipse.contrast * (-1 if dark else 1) < _LEAST_CONTRAST:
            continue
        long, short = ellipse.axes
        if 2 * short >= smallest_diameter * 0.5 and smallest_diameter <= 2 * long <= largest_diameter:
            found.append(ellipse)
    return sorted(_distinct(found), key=lambda one: (one.v, one.u))


def fit_ellipse(
    amplitude: Image,
    *,
    centre: Sequence[float],
    shape: Sequence[float],
    others: Sequence[Sequence[float]] = (),
) -> Ellipse | None:
    """Fit the image of a circle to the grey values near (u, v) = ``centre``; None where none is there.

    ``shape``: the approximate one, as in `Ellipse`; ``others``: (u, v, a_uu, a_uv, a_vv) of neighbours, whose
    pixels are excluded. The model has two levels, an edge blurred by the pixel's square and by the optics,
    and an illumination that varies linearly.
    """
    height, width = amplitude.shape
    lower = _cholesky(shape)
    if lower is None:
        return None
    reach = np.sqrt([shape[0], shape[2]]) + MARGIN + 1
    u0, u1 = max(int(np.floor(centre[0] - reach[0])), 0), min(int(np.ceil(centre[0] + reach[0])), width - 1)
    v0, v1 = max(int(np.floor(centre[1] - reach[1])), 0), min(int(np.ceil(centre[1] + reach[1])), height - 1)
    if u1 <= u0 or v1 <= v0:
        return None
    columns, rows = (grid.ravel() for grid in np.meshgrid(np.arange(u0, u1 + 1.0), np.arange(v0, v1 + 1.0)))
    grey = np.asarray(amplitude[v0 : v1 + 1, u0 : u1 + 1], dtype=np.float64).ravel()
    depth = _depth(np.array([[*centre, *lower]]), columns, rows)[0]
    used = (depth > -MARGIN) & np.isfinite(grey)
    for other in others:
        factor = _cholesky(other[2:5])
        if factor is not None:
            there = _depth(np.array([[other[0], other[1], *factor]]), columns, rows)[0]
            used &= there < np.minimum(-1.0, depth)
    inside, outside = used & (depth > 0.3), used & (depth < -1.0)
    if inside.sum() < 4 or outside.sum() < 6:
        return None
    bright, background = float(np.median(grey[inside])), float(np.median(grey[outside]))
    scale = max(abs(bright - background), 1e-9)
    x, y = columns[used], rows[used]

    def model(parameters: Array) -> Array:
        p = parameters[..., None]
        covered = edge_coverage(*_edge(parameters, x, y), p[:, 7])
        trend = 1 + p[:, 8] * (x - centre[0]) + p[:, 9] * (y - centre[1])
        result: Array = (p[:, 6] + (p[:, 5] - p[:, 6]) * covered) * trend
        return result

    start = np.array([*centre, *lower, bright / scale, background / scale, 0.3, 0.0, 0.0])
    fit = fit_grey_values(WithDifferences(model, _STEPS), start, grey[used] / scale)
    if fit is None:
        return None
    p = fit.parameters
    contrast = p[5] - p[6]
    moved = np.hypot(p[0] - centre[0], p[1] - centre[1])
    if (
        abs(contrast) < max(_LEAST_SIGNIFICANCE, 1 / _LARGEST_RESIDUAL) * fit.residual_rms
        or moved > np.sqrt(max(shape[0], shape[2]))
        or not abs(p[7]) < 3.0
    ):
        return None
    l1, l2, l3 = np.exp(p[2]), p[3], np.exp(p[4])
    found = (float(l1**2), float(l1 * l2), float(l2**2 + l3**2))
    covariance = fit.covariance[:2, :2]
    sigma = float(np.sqrt(np.trace(covariance) / 2))
    ellipse = Ellipse(
        u=float(p[0]),
        v=float(p[1]),
        sigma=sigma,
        shape=found,
        contrast=float(contrast / p[6]) if p[6] > 1e-3 else float(np.sign(contrast) * 1e3),
        covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
    )
    long, short = ellipse.axes
    whole = (
        np.sqrt(found[0]) - 0.5 <= min(p[0], width - 1 - p[0])
        and np.sqrt(found[2]) - 0.5 <= min(p[1], height - 1 - p[1])
    )  # fmt: skip
    sound = short >= _LEAST_ROUNDNESS * long and short > 0.7 and sigma < 1.0
    return ellipse if whole and sound else None


def _cholesky(shape: Sequence[float]) -> tuple[float, float, float] | None:
    """Return (log l1, l2, log l3) of the lower triangle of the shape's matrix; None if it is no ellipse."""
    a_uu, a_uv, a_vv = shape
    if not (a_uu > 0 and a_uu * a_vv - a_uv**2 > 0):
        return None
    l1 = np.sqrt(a_uu)
    l2 = a_uv / l1
    return (float(np.log(l1)), float(l2), float(np.log(np.sqrt(a_vv - l2**2))))


def _depth(parameters: Array, x: Array, y: Array) -> Array:
    return _edge(parameters, x, y)[0]


def _edge(parameters: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the distance (k, n) in px from the edge into the ellipse, and the edge's normal (u, v).

    The distance is of first order, exact for a circle.
    """
    u, v, log1, l2, log3 = (parameters[:, i, None] for i in range(5))
    # trial steps may diverge: no image has axes beyond these
    l1, l3 = (np.exp(np.clip(value, -_MOST_LOG, _MOST_LOG)) for value in (log1, log3))
    first = (x - u) / l1
    second = (y - v - l2 * first) / l3
    radius = np.sqrt(first**2 + second**2)
    # gradient of the radius, from L'^-1 (first, second)
    down = second / l3
    right = (first - l2 * down) / l1
    slope = np.maximum(np.hypot(right, down), 1e-12)
    return (1 - radius) * np.maximum(radius, 1e-9) / slope, right / slope, down / slope


def _candidates(level: Array, *, smallest: float, largest: float) -> list[tuple[float, ...]]:
    """Return the blobs that fill an ellipse at several thresholds, each as (u, v, a_uu, a_uv, a_vv, area)."""
    top = float(np.quantile(level, 0.999))
    lowest = max(0.1 * top, np.log1p(_LEAST_CONTRAST))
    if not top > lowest:
        return []
    groups: list[list[tuple[float, ...]]] = []
    for threshold in np.linspace(lowest, 0.9 * top, _THRESHOLDS):
        for blob in _blobs(level > threshold, smallest=smallest, largest=largest):
            for group in groups:
                if np.hypot(group[-1][0] - blob[0], group[-1][1] - blob[1]) < 0.35 * np.sqrt(blob[5]):
                    group.append(blob)
                    break
            else:
                groups.append([blob])
    # the median area stands for the threshold half way up the edge
    return [
        sorted(group, key=lambda one: one[5])[len(group) // 2]
        for group in groups
        if len(group) >= _PERSISTENCE
    ]


def _blobs(binary: NDArray[np.bool_], *, smallest: float, largest: float) -> list[tuple[float, ...]]:
    """Return connected blobs as ellipses of the same second moments, only those that fill their ellipse."""
    number, labels, stats, centres = cv2.connectedComponentsWithStats(
        binary.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S
    )
    if number <= 1:
        return []
    rows, columns = np.nonzero(labels)
    label = np.asarray(labels[rows, columns], dtype=np.intp)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    du, dv = columns - centres[label, 0], rows - centres[label, 1]
    moments = [np.bincount(label, one, number) / area for one in (du * du, du * dv, dv * dv)]
    height, width = binary.shape
    found = []
    for i in range(1, number):
        left, upper, wide, high = stats[i, :4]
        inside = left > 0 and upper > 0 and left + wide < width and upper + high < height
        if not inside or max(wide, high) > 1.2 * largest or max(wide, high) < 0.6 * smallest or area[i] < 5:
            continue
        # the second moments of an ellipse are a quarter of its shape's matrix, and those of a pixel are added
        shape = [4 * (moments[0][i]), 4 * moments[1][i], 4 * (moments[2][i])]
        determinant = shape[0] * shape[2] - shape[1] ** 2
        if determinant <= 0:
            continue
        filled = area[i] / (np.pi * np.sqrt(determinant))
        if 0.85 < filled < 1.2:
            found.append((float(centres[i, 0]), float(centres[i, 1]), *map(float, shape), float(area[i])))
    return found


def _distinct(ellipses: list[Ellipse]) -> list[Ellipse]:
    """Return the ellipses without duplicates; of two that overlap the more precise one stays."""
    kept: list[Ellipse] = []
    for ellipse in sorted(ellipses, key=lambda ellipse: ellipse.sigma):
        if all(np.hypot(ellipse.u - other.u, ellipse.v - other.v) > other.axes[1] for other in kept):
            kept.append(ellipse)
    return kept
