"""A board in one amplitude image: OpenCV's detectors find it, its texture shows which way round it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Pose
from rim_camera_ros.optics import Optics, project, rays_through
from rim_camera_ros.photogrammetry.board_design import require_aruco
from rim_camera_ros.photogrammetry.texture_targets import TextureTargets, detect_markers
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Surface

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Enlargements of the image at which detectors look, in their order.
_ENLARGEMENTS = (1, 2, 3)
#: Images larger than this are not enlarged further [px to the longer side].
_LARGEST = 1600
#: Fewest points that give a pose.
_LEAST_POINTS = 4
#: Points to the side of the board at which its texture is compared with the image.
_COMPARED = 60
#: Least correlation of texture and image with which a detected board is accepted.
LEAST_CORRELATION = 0.4
#: ... and with which it is accepted without a search in other versions of the image (enlarged, other grey
#: values): a detector may find one marker of many, or blobs that are not the circles.
_SURE = 0.8
#: Two orientations of the board whose correlations differ by less are not distinguishable.
_SAME = 0.1


@dataclass(frozen=True)
class FoundBoard:
    """A board in an image.

    ``pose``: approximate, of its surface in the optical frame; ``points`` (n, 2) px, as detected;
    ``correlation`` of its texture with the image there; ``ambiguous``: turned by 180 degrees it looks alike.
    """

    pose: Pose
    points: Array
    correlation: float
    ambiguous: bool


def find_board(
    amplitude: NDArray[Any],
    surface: Surface,
    targets: TextureTargets,
    optics: Optics,
    *,
    near: Pose | None = None,
) -> FoundBoard | None:
    """Find a board in an amplitude image (H, W); None where it is not seen.

    ``optics``: those of the camera, approximately. ``near``: of a board that looks alike when turned by 180
    degrees, the orientation nearer to this pose is taken. Raises `InputError` for markers without cv2.aruco.
    """
    image = np.nan_to_num(np.asarray(amplitude, np.float32))
    greys = list(_greys(image))
    found: FoundBoard | None = None
    for scale in _ENLARGEMENTS:
        if scale > 1 and scale * max(image.shape) > _LARGEST:
            break
        for grey in greys:
            large = grey
            if scale > 1:
                enlarged = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
                large = np.asarray(enlarged, np.uint8)
            best = _best(_laid(large, targets, scale), grey, surface, optics, near)
            if best is not None and best.correlation >= _SURE:
                return best
            if best is not None and (found is None or best.correlation > found.correlation):
                found = best
    return found


def _greys(image: NDArray[np.float32]) -> Iterator[Grey]:
    """Yield the image as 8 bits: as it is, near and far made alike, and with missing pixels white.

    Amplitudes fall with the square of the distance; saturated pixels of some cameras hold 0.
    """
    seen = image[image > 0]
    if seen.size < 16:
        return
    bright = float(np.quantile(seen, 0.99))
    root = np.sqrt(np.clip(image / bright, 0.0, 1.0))
    yield (root * 255).astype(np.uint8)
    even = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(4, 4))
    yield np.asarray(even.apply((root * 255).astype(np.uint8)), np.uint8)
    if (image <= 0).any():
        yield (np.where(image > 0, root, 1.0) * 255).astype(np.uint8)


def _laid(grey: Grey, targets: TextureTargets, scale: int) -> Iterator[tuple[Array, Array]]:
    """Yield points (n, 2) of the board [m] and of the image [px] as detected, for each orientation."""
    if targets.dictionary:
        require_aruco()
        seen = detect_markers(grey, targets.dictionary)
        known = [number for number in seen if number in targets.markers]
        if known:
            on_board = np.concatenate([targets.markers[number] for number in known])
            yield on_board, _unscaled(np.concatenate([seen[number] for number in known]), scale)
        return
    rows, columns = targets.shape
    points = _circles(grey, rows, columns) if targets.circles else _corners(grey, rows, columns)
    if points is None:
        return
    image = _unscaled(points, scale)
    names = tuple(targets.circles) or targets.lattice
    if targets.circles:
        on_board = np.array([targets.circles[name][:2] for name in names])
    else:
        on_board = np.array([targets.crossings[name] for name in names])
    grid = on_board.reshape(rows, columns, 2)
    ways = [grid, grid[::-1, ::-1]]
    if rows == columns:
        ways += [np.rot90(grid, 1), np.rot90(grid, 3)]
    # a detector that counts from another corner has one of the two axes reversed
    for way in ways + [one[:, ::-1] for one in ways]:
        if _same_sense(way, image.reshape(rows, columns, 2)):
            yield way.reshape(-1, 2), image


def _same_sense(board: Array, image: Array) -> bool:
    """Whether both grids have the same handedness: a board is seen from its front, never mirrored."""

    def turn(grid: Array) -> float:
        down, across = grid[-1, 0] - grid[0, 0], grid[0, -1] - grid[0, 0]
        return float(across[0] * down[1] - across[1] * down[0])

    return turn(board) * turn(image) > 0


def _unscaled(points: Array, scale: int) -> Array:
    # the centre of the first small pixel lies at (1 / scale - 1) / 2 of a large one
    return (np.asarray(points, float).reshape(-1, 2) + 0.5) / scale - 0.5


def _corners(grey: Grey, rows: int, columns: int) -> Array | None:
    if min(rows, columns) < 3:
        return None
    found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    return np.asarray(corners, float).reshape(-1, 2) if found else None


def _circles(grey: Grey, rows: int, columns: int) -> Array | None:
    found, centres = cv2.findCirclesGrid(
        grey, (columns, rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    )
    if not found:
        found, centres = cv2.findCirclesGrid(grey, (columns, rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
    return np.asarray(centres, float).reshape(-1, 2) if found else None


# --- which way round -------------------------------------------------------------------------------


def _best(
    ways: Iterator[tuple[Array, Array]],
    grey: Grey,
    surface: Surface,
    optics: Optics,
    near: Pose | None,
) -> FoundBoard | None:
    found: list[FoundBoard] = []
    for on_board, points in ways:
        pose = resection(on_board, points, optics)
        if pose is not None:
            correlation = _correlation(grey, surface, pose, optics)
            found.append(FoundBoard(pose, points, correlation, ambiguous=False))
    if not found:
        return None
    found.sort(key=lambda found_board: -found_board.correlation)
    if found[0].correlation < LEAST_CORRELATION:
        return None
    alike = [found_board for found_board in found if found_board.correlation > found[0].correlation - _SAME]
    if len(alike) == 1:
        return found[0]
    best = min(alike, key=lambda found_board: _turned(found_board.pose, near))
    return FoundBoard(best.pose, best.points, best.correlation, ambiguous=True)


def _turned(pose: Pose, near: Pose | None) -> float:
    """Return the angle in rad from another pose; without one from an upright board."""
    other = np.eye(3) if near is None else rotation_matrix(near.orientation)
    cosine = (np.trace(other.T @ rotation_matrix(pose.orientation)) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def resection(on_board: Array, points: Array, optics: Optics) -> Pose | None:
    """Return the pose of a plane from its points (n, 2) m and images (n, 2) px; None where none is found.

    cv2.solvePnP for planes (Collins and Bartoli 2014), then its iteration to the least squares.
    """
    rays = rays_through(optics, points)
    whole = np.isfinite(rays).all(axis=1)
    if whole.sum() < _LEAST_POINTS:
        return None
    object_points = np.column_stack([on_board[whole], np.zeros(int(whole.sum()))])
    image_points = np.ascontiguousarray(rays[whole, :2] / rays[whole, 2:])
    try:
        count, turns, shifts, _ = cv2.solvePnPGeneric(
            object_points, image_points, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        if not count:
            return None
        turn, shift = cv2.solvePnPRefineLM(object_points, image_points, np.eye(3), None, turns[0], shifts[0])
    except cv2.error:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float)
    x, y, z = (float(one) for one in np.ravel(shift))
    if not (z > 0 and np.isfinite([x, y, z]).all() and np.isfinite(rotation).all() and rotation[2, 2] > 0):
        return None
    return Pose((x, y, z), quaternion(rotation))


def _correlation(grey: Grey, surface: Surface, pose: Pose, optics: Optics) -> float:
    """Return the correlation of a board's reflectivity with an image of `_greys` at its points."""
    assert surface.size is not None
    assert surface.texture is not None
    x, y = ((np.arange(_COMPARED) + 0.5) / _COMPARED - 0.5) * np.array(surface.size)[:, None]
    local = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rotation = rotation_matrix(pose.orientation)
    points = local @ rotation[:, :2].T + np.array(pose.position)
    uv = project(optics, points)
    height, width = grey.shape
    inside = np.isfinite(uv).all(axis=1) & (uv > 1).all(axis=1) & (uv < (width - 2, height - 2)).all(axis=1)
    if inside.sum() < _COMPARED:
        return 0.0
    place = uv[inside].astype(np.float32)
    seen = cv2.remap(grey, place[:, 0], place[:, 1], cv2.INTER_LINEAR).ravel().astype(float)
    # falloff undone, as far as the board is tilted
    seen *= points[inside, 2] / pose.position[2]
    expected = surface.texture.reflectivity(local[inside, 0], local[inside, 1])
    if np.ptp(seen) == 0 or np.ptp(expected) == 0:
        return 0.0
    return float(np.corrcoef(seen, np.sqrt(expected))[0, 1])
