"""Corners of checkerboards in amplitude images, in sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.photogrammetry.corner_model import CornerModel
from rim_camera_ros.photogrammetry.greyfit import fit_grey_values
from rim_camera_ros.photogrammetry.sampling import Jaggedness, hidden_share

Array = NDArray[np.float64]
Image = NDArray[Any]

#: Enlargement at which OpenCV looks for a board; without it squares of 6 px are not found.
_ENLARGEMENT = 3
#: Largest radius in px of the window in which a corner is fitted, and the least that is still usable.
_LARGEST_WINDOW = 6.0
_SMALLEST_WINDOW = 2.5
#: Residuals in units of the step between the squares above which there is no corner.
_LARGEST_RESIDUAL = 0.25
#: Up to this distance [px] a pixel counts as one at an edge: half its diagonal, and some for the blur.
_BESIDE = 1.0


@dataclass(frozen=True, slots=True)
class Corner:
    """A corner at (u, v) in px (column, row) and its ``sigma`` in px (RMS of u and v).

    ``normals`` (2, 2): unit normals of the two edges, which are ``length`` px long in the window of the fit;
    ``jagged``: how jagged the edges are by the sampling. Errors by sampling that edges do not show are not in
    ``sigma``, see `sampling`.
    """

    u: float
    v: float
    sigma: float
    normals: Array
    length: float
    jagged: Jaggedness


def find_checkerboard(amplitude: Image, *, rows: int, columns: int) -> list[list[Corner]] | None:
    """Return the inner corners of a checkerboard, ``rows`` lists of ``columns``; None where it is not found.

    The whole board must be in the image. Which of the equivalent corners comes first is OpenCV's choice
    (cv2.findChessboardCorners). Raises ValueError for fewer than 3 rows or columns.
    """
    if min(rows, columns) < 3:
        raise ValueError(f"a checkerboard has at least 3 x 3 inner corners, not {rows} x {columns}")
    image = np.nan_to_num(np.asarray(amplitude, np.float32))
    low, high = np.quantile(image, [0.005, 0.995])
    if not high > low:
        return None
    grey = np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    large = cv2.resize(grey, None, fx=_ENLARGEMENT, fy=_ENLARGEMENT, interpolation=cv2.INTER_CUBIC)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(large, (columns, rows), flags=flags)
    if not found:
        return None
    # the centre of the first small pixel lies at (1 / enlargement - 1) / 2 of a large one
    grid = (corners.reshape(rows, columns, 2).astype(float) + 0.5) / _ENLARGEMENT - 0.5
    across, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    axes = np.stack([across, down], axis=-2).reshape(-1, 2, 2)
    refined = refine_corners(amplitude, grid.reshape(-1, 2), axes=axes)
    result: list[list[Corner]] = []
    for i in range(rows):
        row = [one for one in refined[i * columns : (i + 1) * columns] if one is not None]
        if len(row) != columns:
            return None
        result.append(row)
    return result


def refine_corners(
    amplitude: Image, approximate: Array, *, axes: Array, bends: Array | None = None
) -> list[Corner | None]:
    """Return the corners near approximate positions (n, 2) as (u, v) in px; None where there is none.

    ``axes`` (n, 2, 2): the vectors in px from each corner to the next along the two edges of the board that
    cross in it. ``bends`` (n, 2) 1/px: curvature of the edges by the lens, positive towards their normal, the
    edge turned from u to v; None: straight. OpenCV's cornerSubPix gives an approximate corner. A model is
    then fitted to the grey values: two crossing edges, blurred by the pixel's square and the optics, under a
    linear illumination.
    """
    image = np.nan_to_num(np.asarray(amplitude, np.float32))
    height, width = image.shape
    result: list[Corner | None] = []
    bends = np.zeros((len(axes), 2)) if bends is None else bends
    for start, edges, bend in zip(
        np.asarray(approximate, float), np.asarray(axes, float), bends, strict=True
    ):
        spacing = min(
            np.linalg.norm(edges[0]),
            np.linalg.norm(edges[1]),
            *(np.linalg.norm(edges[0] + sign * edges[1]) for sign in (1, -1)),
        )
        radius = min(0.8 * float(spacing), _LARGEST_WINDOW)
        room = min(start[0], start[1], width - 1 - start[0], height - 1 - start[1])
        if radius < _SMALLEST_WINDOW or not room >= 2:
            result.append(None)
            continue
        # a square window, in which the next corners must not lie
        half = max(int(min(0.45 * spacing, room - 1, _LARGEST_WINDOW)), 1)
        moved = cv2.cornerSubPix(
            image,
            start.astype(np.float32).reshape(1, 1, 2).copy(),
            (half, half),
            (-1, -1),
            (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3),
        ).reshape(2)
        near = np.linalg.norm(moved - start) < 0.4 * spacing
        result.append(_fit_corner(image, moved.astype(float) if near else start, edges, bend, radius))
    return result


def _fit_corner(image: Image, start: Array, edges: Array, bend: Array, radius: float) -> Corner | None:
    height, width = image.shape
    u0, u1 = max(int(np.ceil(start[0] - radius)), 0), min(int(start[0] + radius), width - 1)
    v0, v1 = max(int(np.ceil(start[1] - radius)), 0), min(int(start[1] + radius), height - 1)
    columns, rows = (grid.ravel() for grid in np.meshgrid(np.arange(u0, u1 + 1.0), np.arange(v0, v1 + 1.0)))
    near = np.hypot(columns - start[0], rows - start[1]) <= radius
    x, y = columns[near], rows[near]
    grey = np.asarray(image[v0 : v1 + 1, u0 : u1 + 1], np.float64).ravel()[near]
    if grey.size < 12:
        return None
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    scale = max(float(grey.std()), 1e-9)
    mean = float(grey.mean()) / scale

    model = CornerModel(x, y, start, bend)
    begin = np.array([*start, *angles, mean, 0.0, 0.3, 0.0, 0.0])
    step = float(np.mean(model.sides(begin) * (grey / scale - mean)))
    begin[5] = step if abs(step) > 1e-3 else 0.5
    fit = fit_grey_values(model, begin, grey / scale)
    if fit is None:
        return None
    p = fit.parameters
    sigma = float(np.sqrt(np.trace(fit.covariance[:2, :2]) / 2))
    turned = np.abs(np.angle(np.exp(1j * 2 * (p[2:4] - angles)))) / 2
    if (
        fit.residual_rms > 2 * _LARGEST_RESIDUAL * abs(p[5])
        or np.hypot(p[0] - start[0], p[1] - start[1]) > radius
        or turned.max() > np.deg2rad(30)
        or not abs(p[6]) < 3
        or not 0 < sigma < 1  # 0: without contrast, nothing determines it
    ):
        return None
    normals = np.column_stack([-np.sin(p[2:4]), np.cos(p[2:4])])
    beside = np.abs(model.depths(p)).min(axis=0) < _BESIDE
    # away from the edges there is noise alone
    noise = float(fit.squares[~beside].mean()) if not beside.all() else 0.0
    squares = float((fit.squares[beside] - noise).sum()) / (2 * p[5]) ** 2
    length = 2 * radius
    shown = length * sum(1 - hidden_share(normal, length) for normal in normals)
    return Corner(float(p[0]), float(p[1]), sigma, normals, length, Jaggedness(squares, shown))
