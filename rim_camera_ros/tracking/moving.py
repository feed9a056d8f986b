"""Moving points -> clusters on the floor, one for each person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import RimError
from rim_camera_ros.tracking.ground import Ground

Array = NDArray[np.float64]

#: Side [m] of the cells of the floor into which points are sorted before they are clustered.
CELL = 0.05
#: Mean distance of a cylinder's visible half in front of its axis, in radii, over its apparent width.
_NEAR_SIDE = np.pi / 4


@dataclass(frozen=True, kw_only=True)
class ClusterSettings:
    """Which clusters of moving points count as persons; lengths in m.

    ``reach``: cells of the floor nearer to each other than this belong together. ``minimum_area`` [m^2] of a
    cluster as seen by the camera; a cell is a core of DBSCAN if a tenth of this area lies within ``reach``.
    ``lowest``, ``highest``: heights above the floor between which points are used. ``tallest_below``: a
    cluster with a lower top is not a person. ``maximum_sigma``: points with more noise are excluded.
    ``body_radius``: that of the cylinder whose near side is seen, for trunk and legs together.
    """

    reach: float = 0.15
    minimum_area: float = 0.08
    lowest: float = 0.15
    highest: float = 2.3
    tallest_below: float = 0.8
    maximum_sigma: float = 0.15
    body_radius: float = 0.15


@dataclass(frozen=True)
class Detection:
    """A cluster of moving points in the floor's frame.

    ``position`` (2,) of the body's axis [m], ``area`` [m^2] across the rays, ``top`` [m] above the floor,
    ``cells`` (N, 2) [m] on the floor with ``cell_areas`` (N,) [m^2].
    """

    position: Array
    area: float
    top: float
    cells: Array
    cell_areas: Array

    @property
    def width(self) -> float:
        """Largest distance in m of two cells along the longer of the principal axes."""
        centred = self.cells - np.average(self.cells, axis=0, weights=self.cell_areas)
        axes = np.linalg.eigh(centred.T @ (centred * self.cell_areas[:, None]))[1]
        return float(np.ptp(centred @ axes[:, -1]))


def solid_angle(points: NDArray[Any]) -> float:
    """Return the solid angle [sr] of a pixel, from an organised cloud (H, W, >=3) in m with NaN.

    Raises `RimError` for a cloud without neighbouring points in both directions.
    """
    length = np.linalg.norm(points[..., :3].astype(float), axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = points[..., :3] / length
    steps = []
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(rays, axis=axis), axis=-1)
        steps.append(float(np.median(step[np.isfinite(step)])) if np.isfinite(step).any() else 0.0)
    if not all(steps):
        raise RimError("the cloud has no neighbouring points", remedy="only organised clouds serve")
    return steps[0] * steps[1]


def moving_points(
    points: NDArray[Any], moving: NDArray[np.bool_], sigma: NDArray[Any], settings: ClusterSettings
) -> NDArray[np.float32]:
    """Return the moving points (N, 3) [m] of an organised cloud (H, W, >=3), in the optical frame.

    Pixels (H, W) of ``moving`` without neighbours of their kind (opening by 3 x 3) and those with a ``sigma``
    (H, W) [m] above ``settings.maximum_sigma`` are excluded.
    """
    with np.errstate(invalid="ignore"):
        clear = moving & (sigma <= settings.maximum_sigma)
    opened = cv2.morphologyEx(clear.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    chosen: NDArray[np.float32] = points[..., :3][opened > 0]
    return chosen[np.isfinite(chosen).all(axis=1)]


def clusters(
    points: NDArray[Any], ground: Ground, settings: ClusterSettings, *, pixel: float
) -> list[Detection]:
    """Return the people among moving points (N, 3) [m] of the optical frame.

    ``pixel``: solid angle of a pixel [sr].

    By DBSCAN (Ester et al. 1996) on cells of the floor, weighted with the area that the camera sees in them,
    so that a distant person counts as much as one nearby. Raises `RimError` where scikit-learn is missing.
    """
    on_floor = ground.from_optical(points)
    keep = (on_floor[:, 2] >= settings.lowest) & (on_floor[:, 2] <= settings.highest)
    on_floor, areas = on_floor[keep], np.sum(np.asarray(points, float)[keep] ** 2, axis=1) * pixel
    if not len(on_floor):
        return []
    _, cell_of = np.unique(np.floor(on_floor[:, :2] / CELL), axis=0, return_inverse=True)
    cell_of = cell_of.reshape(-1)  # numpy 2.0 returned it with another shape
    cell_areas = np.bincount(cell_of, areas)
    cells = np.column_stack([np.bincount(cell_of, areas * on_floor[:, i]) / cell_areas for i in (0, 1)])
    labels = _dbscan(cells, cell_areas, settings)
    found = []
    for label in range(labels.max() + 1):
        mine = labels == label
        area = float(cell_areas[mine].sum())
        # without the highest percent: single points are not a head
        top = float(np.percentile(on_floor[mine[cell_of], 2], 99))
        if area >= settings.minimum_area and top >= settings.tallest_below:
            found.append(detection(cells[mine], cell_areas[mine], top=top, body_radius=settings.body_radius))
    return found


def detection(cells: Array, areas: Array, *, top: float, body_radius: float) -> Detection:
    """Return a detection of cells (N, 2) [m] with areas (N,) [m^2].

    A camera only sees the near side, so that the centroid lies in front of the body's axis (a drawback of the
    centroid that sec. 1.1.1 names). For a cylinder the difference is pi / 4 of its radius, by which the
    position is moved along the ray.
    """
    centroid = np.average(cells, axis=0, weights=areas)
    away = centroid / max(float(np.linalg.norm(centroid)), 1e-9)
    return Detection(
        position=centroid + _NEAR_SIDE * body_radius * away,
        area=float(areas.sum()),
        top=top,
        cells=cells,
        cell_areas=areas,
    )


def divided(one: Detection, positions: Array, *, body_radius: float) -> list[Detection]:
    """Divide a cluster among people whose ``positions`` (K, 2) [m] are expected in it.

    Each cell is assigned to the nearest position; a position without cells gets no detection.
    """
    centres = positions - _NEAR_SIDE * body_radius * positions / np.linalg.norm(positions, axis=1)[:, None]
    nearest = np.argmin(np.linalg.norm(one.cells[:, None] - centres[None], axis=2), axis=1)
    return [
        detection(one.cells[mine], one.cell_areas[mine], top=one.top, body_radius=body_radius)
        for k in range(len(positions))
        if (mine := nearest == k).any()
    ]


def dbscan() -> Any:
    """Return scikit-learn's DBSCAN, whose import takes two seconds; `RimError` where it is missing."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError:
        raise RimError(
            "scikit-learn is not installed, moving points cannot be clustered",
            remedy="sudo apt install python3-sklearn, or pip install 'rim_camera_ros[diagnosis]'",
        ) from None
    return DBSCAN


def _dbscan(cells: Array, areas: Array, settings: ClusterSettings) -> NDArray[np.int64]:
    weights = areas / (0.1 * settings.minimum_area)
    result: NDArray[np.int64] = dbscan()(eps=settings.reach, min_samples=1).fit_predict(
        cells, sample_weight=weights
    )
    return result
