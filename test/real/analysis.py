"""What the two real recordings are known to show, computed from clouds alone."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]

#: Amplitude classes of the black squares and their step in mm as published with the recording.
BLACK_STEPS = (
    (600, 800, 18.6),
    (800, 1000, 12.5),
    (1000, 1200, 6.6),
    (1200, 1500, 3.7),
    (1500, 2000, 0.4),
    (2000, 3000, -1.6),
    (3000, 5000, -3.2),
)
SQUARE = 0.03


def plane_fit(points: Array, weights: Array | None = None) -> tuple[Array, float]:
    """Return the unit normal and the offset p of the least-squares plane normal . X = p of points (N, 3)."""
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    normal = axes[2] if axes[2] @ centre > 0 else -axes[2]
    return normal, float(normal @ centre)


def ray_residual(points: Array, normal: Array, offset: float) -> Array:
    """Return measured distance minus that to the plane along each point's ray, in metres."""
    length = np.linalg.norm(points, axis=-1)
    return length - offset / ((points / length[..., None]) @ normal)


def board_frame(points: Array, position: Array, orientation: Array) -> Array:
    """Return the board coordinates (H, W, 2) of where the rays meet the board at its pose."""
    rotation = Rotation.from_quat(orientation).as_matrix()
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    rays = points / length
    depth = (position @ rotation[:, 2]) / (rays @ rotation[:, 2])
    local = (rays * depth[..., None] - position) @ rotation
    return local[..., :2]


def edge_distance(local: Array) -> Array:
    """Return how far pixels are inside their square [px], from board coordinates (H, W, 2) in squares."""
    inside = 0.5 - np.abs(local - np.floor(local) - 0.5)
    steps = [np.maximum(*(np.abs(one) for one in np.gradient(local[..., k]))) for k in (0, 1)]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.min(inside / np.stack(steps, axis=-1), axis=-1))


def black_squares(
    frames: Iterable[tuple[Array, Array, Array]], *, margin: float = 0.0, least: int = 6
) -> tuple[Array, Array]:
    """Return mean amplitude and step [m] of every black square of a checkerboard.

    ``frames``: (cloud (H, W, 4), position (3,), orientation (4,)) of the board. Per frame a plane is
    fitted through the interiors of the white squares; the step is the median ray residual of a black one.
    Interiors are the inner 0.56 of a square that is ``margin`` [px] from its edges, ``least`` pixels.
    """
    amplitudes, steps = [], []
    for cloud, position, orientation in frames:
        points, amplitude = cloud[..., :3].astype(float), cloud[..., 3].astype(float)
        with np.errstate(invalid="ignore"):
            local = board_frame(points, np.asarray(position), np.asarray(orientation)) / SQUARE
            cell = np.floor(local)
            inner = np.abs(local - cell - 0.5).max(axis=-1) < 0.28
            if margin > 0:
                inner &= edge_distance(local) >= margin
        usable = inner & np.isfinite(points[..., 2]) & (amplitude > 0)
        squares: dict[tuple[int, int], Array] = {}
        keys = cell[usable].astype(int)
        index = np.flatnonzero(usable.ravel())
        for key in np.unique(keys, axis=0):
            # the 5 x 7 inner corners bound 6 x 8 squares; the outermost may be cut by the image's mask
            if -1 <= key[0] <= 7 and -1 <= key[1] <= 7:
                squares[tuple(key)] = index[(keys == key).all(axis=1)]
        squares = {key: one for key, one in squares.items() if one.size >= least}
        if len(squares) < 12:
            continue
        flat_points, flat_amplitude = points.reshape(-1, 3), amplitude.ravel()
        level = {key: float(np.median(flat_amplitude[one])) for key, one in squares.items()}
        by_parity = [[v for k, v in level.items() if (k[0] + k[1]) % 2 == p] for p in (0, 1)]
        if not all(by_parity):
            continue
        parity = [np.median(one) for one in by_parity]
        white_parity = int(parity[1] > parity[0])
        white = [one for key, one in squares.items() if (key[0] + key[1]) % 2 == white_parity]
        if len(white) < 6:
            continue
        white_index = np.concatenate(white)
        normal, offset = plane_fit(flat_points[white_index])
        good = np.abs(ray_residual(flat_points[white_index], normal, offset)) < 0.02
        normal, offset = plane_fit(flat_points[white_index[good]])
        for key, one in squares.items():
            if (key[0] + key[1]) % 2 != white_parity:
                amplitudes.append(level[key])
                steps.append(float(np.median(ray_residual(flat_points[one], normal, offset))))
    return np.array(amplitudes), np.array(steps)


def wall_residual(clouds: Iterable[Array], *, wall_beyond: float = 1.6) -> dict[str, float]:
    """Return what the wall of the O3D303 recording shows, in metres.

    The mean cloud of the frames; pixels farther than ``wall_beyond`` are the wall. ``low``, ``high``: 1st and
    99th percentile of the smooth (7 x 7 median) residual from its plane; ``pattern``: RMS of the rest
    of it, in the mean of the frames; ``noise``: of that mean.
    """
    stack = np.stack([cloud[..., :3] for cloud in clouds]).astype(float)
    length = np.linalg.norm(stack, axis=-1)
    valid = np.isfinite(length).all(axis=0)
    mean = stack.mean(axis=0)
    wall = valid & (mean[..., 2] > wall_beyond)
    wall = scipy.ndimage.binary_erosion(wall, iterations=4)
    normal, offset = plane_fit(mean[wall])
    for _ in range(5):
        residual = ray_residual(mean, normal, offset)
        near = wall & (np.abs(residual) < 0.05)
        normal, offset = plane_fit(mean[near])
    residual = np.where(near, ray_residual(mean, normal, offset), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        smooth = scipy.ndimage.generic_filter(residual, np.nanmedian, size=7, mode="nearest")
    rough = (residual - smooth)[near]
    return {
        "distance": float(np.median(length.mean(axis=0)[near])),
        "share": float(near.mean()),
        "low": float(np.nanpercentile(smooth[near], 1)),
        "high": float(np.nanpercentile(smooth[near], 99)),
        "pattern": float(np.sqrt(np.mean(rough**2))),
        "noise": float(np.median(length.std(axis=0, ddof=1)[near]) / np.sqrt(len(length))),
    }
