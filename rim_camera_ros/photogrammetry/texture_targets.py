"""Targets in the texture of a scene's rectangle: crossings of edges, circles, and the markers between them.

The scene file's description of a board is enough to find it: its texture is analysed once, with the
detectors that are used for the images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rim_camera_ros.photogrammetry.board_design import marker_modules
from rim_camera_ros.scene import Surface

Array = NDArray[np.float64]

#: Step between the tiles of a crossing, as a share of that between the darkest and the brightest tile.
_CONTRAST = 0.5
#: Dictionaries of markers. OpenCV's own larger ones begin with the markers of the smaller ones.
_DICTIONARIES = (
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
    "DICT_ARUCO_ORIGINAL",
    *(f"DICT_{bits}X{bits}_1000" for bits in (4, 5, 6, 7)),
)
_SMALLER = (50, 100, 250)
#: Fewest markers that make a board, fewest circles, and crossings of a checkerboard to either side.
_LEAST_MARKERS = 2
_LEAST_CIRCLES = 4
_LEAST_CROSSINGS = 2
#: A blob is a circle where its area differs from that of its circle by less than this share.
_ROUND = 0.12
#: Largest number of tiles of a texture that is searched for targets.
_MOST_TILES = 1_000_000


@dataclass(frozen=True)
class TextureTargets:
    """Targets of a surface in its own frame.

    ``crossings``: (x, y) m of corners where two edges cross by (row, column) of the texture's grid, 0 at the
    surface's origin; ``arms``: how far [m] along x and y the edges of each lead undisturbed to both sides.
    ``circles``: (x, y, radius) m by (row, column), ordered as they stand. ``markers``: corners (4, 2) m by
    id, clockwise from the marker's own upper left, of ``dictionary`` (a name of cv2.aruco; '' without).
    """

    crossings: Mapping[tuple[int, int], Array]
    arms: Mapping[tuple[int, int], Array]
    circles: Mapping[tuple[int, int], tuple[float, float, float]]
    markers: Mapping[int, Array]
    dictionary: str

    @property
    def lattice(self) -> tuple[tuple[int, int], ...]:
        """The (row, column) of a full grid of crossings, row by row; empty where they are no checkerboard."""
        return _lattice(self.crossings)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid of crossings, or else of circles."""
        names = self.lattice or tuple(self.circles)
        return (len({row for row, _ in names}), len({column for _, column in names}))


def targets_of(surface: Surface) -> TextureTargets | None:
    """Return the targets of a textured rectangle, None where there are none."""
    if surface.type != "rectangle" or surface.texture is None:
        return None
    assert surface.size is not None
    values = surface.texture.values.values
    key = (values.shape, values.tobytes(), surface.texture.cell, surface.size)
    return _targets(*key)


@lru_cache(maxsize=16)
def _targets(
    shape: tuple[int, ...], values: bytes, cell: tuple[float, float], size: tuple[float, float]
) -> TextureTargets | None:
    tiles = np.frombuffer(values).reshape(shape)
    if np.ptp(tiles) == 0:
        return None
    # tiles cut by the rim count, with their inner parts
    half_columns, half_rows = (math.ceil(size[k] / 2 / cell[k] - 1e-6) for k in (0, 1))
    if 4 * half_columns * half_rows > _MOST_TILES:
        return None
    rows = np.arange(-half_rows, half_rows) % shape[0]
    columns = np.arange(-half_columns, half_columns) % shape[1]
    grid = tiles[np.ix_(rows, columns)]
    origin = (half_rows, half_columns)
    crossings, arms = _crossings(grid, modules=0)
    dictionary, markers = ("", {}) if not crossings or _lattice(crossings) else _markers(grid)
    if markers:
        crossings, arms = _crossings(grid, modules=_side(markers))
    metres = np.array(cell)

    def metric(points: Array) -> Array:
        result: Array = (points - np.array([origin[1], origin[0]])) * metres
        return result

    circles: dict[tuple[int, int], tuple[float, float, float]] = {}
    if not markers and len(_lattice(crossings)) == 0:
        crossings, arms = {}, {}
        circles = _circles(grid, origin, metres)
    if not (crossings or circles or markers):
        return None
    return TextureTargets(
        crossings={
            (i - origin[0], j - origin[1]): metric(np.array([j, i], float)) for i, j in sorted(crossings)
        },
        arms={(i - origin[0], j - origin[1]): np.array(arms[i, j]) * metres for i, j in sorted(crossings)},
        circles=circles,
        markers={number: metric(corners) for number, corners in sorted(markers.items())},
        dictionary=dictionary,
    )


def _lattice(names: Any) -> tuple[tuple[int, int], ...]:
    """Return the names row by row if they are a full regular grid."""
    rows, columns = sorted({row for row, _ in names}), sorted({column for _, column in names})
    full = len(names) == len(rows) * len(columns) and min(len(rows), len(columns)) >= _LEAST_CROSSINGS
    even = all(len(set(np.diff(row))) == 1 for row in (rows, columns)) if full else False
    return tuple((row, column) for row in rows for column in columns) if full and even else ()


# --- crossings -------------------------------------------------------------------------------------


def _crossings(
    grid: Array, *, modules: int
) -> tuple[dict[tuple[int, int], None], dict[tuple[int, int], tuple[float, float]]]:
    """Return the corners (i, j) between tiles where two edges cross, and their arms (x, y) in tiles.

    With markers of ``modules`` tiles only corners count from which edges along both axes are as long as a
    marker: inside of markers edges are shorter.
    """
    step = _CONTRAST * float(np.ptp(grid))
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    saddle = (np.minimum(a, d) - np.maximum(b, c) > step) | (np.minimum(b, c) - np.maximum(a, d) > step)
    found: dict[tuple[int, int], None] = {}
    arms: dict[tuple[int, int], tuple[float, float]] = {}
    for i, j in np.argwhere(saddle) + 1:
        right, left = (_edge(one) for one in (grid[i - 1 : i + 1, j:], grid[i - 1 : i + 1, :j][:, ::-1]))
        down, up = (_edge(one.T) for one in (grid[i:, j - 1 : j + 1], grid[:i, j - 1 : j + 1][::-1]))
        if modules and min(max(right, left), max(down, up)) < modules:
            continue
        reach = _uniform(grid, int(i), int(j), most=min(right, left, down, up))
        # off the edges an arm is undisturbed within the uniform squares, up to their diagonal
        arms[int(i), int(j)] = tuple(
            min(float(one), 1.4 * reach) for one in (min(right, left), min(down, up))
        )  # type: ignore[assignment]
        found[int(i), int(j)] = None
    return found, arms


def _edge(pair: Array) -> int:
    """Return over how many tiles the two lines (2, n) keep their first values."""
    changed = np.flatnonzero((pair != pair[:, :1]).any(axis=0))
    return int(changed[0]) if changed.size else pair.shape[1]


def _uniform(grid: Array, i: int, j: int, *, most: int) -> int:
    """Return the side in tiles of the largest four squares around a corner that have one value each."""
    for n in range(most, 1, -1):
        quarters = (
            grid[i - n : i, j - n : j],
            grid[i - n : i, j : j + n],
            grid[i : i + n, j - n : j],
            grid[i : i + n, j : j + n],
        )
        if all(quarter.shape == (n, n) and np.ptp(quarter) == 0 for quarter in quarters):
            return n
    return 1


# --- markers ---------------------------------------------------------------------------------------


def _side(markers: Mapping[int, Array]) -> int:
    if not markers:
        return 0
    return round(float(np.median([np.linalg.norm(marker[1] - marker[0]) for marker in markers.values()])))


def _markers(grid: Array) -> tuple[str, dict[int, Array]]:
    """Return the dictionary that explains most of the texture, and its markers' corners (4, 2) in tiles.

    A module of a marker is one tile.
    """
    low, high = float(grid.min()), float(grid.max())
    bright = grid > (low + high) / 2
    best: tuple[str, dict[int, Array]] = ("", {})
    if not hasattr(cv2, "aruco"):
        return best
    for name in (dictionary for dictionary in _DICTIONARIES if hasattr(cv2.aruco, dictionary)):
        table = _table(name)
        side = math.isqrt(len(next(iter(table)))) + 2
        if min(bright.shape) < side:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(bright, (side, side))
        ring = windows[..., 0, :] | windows[..., -1, :] | windows[..., :, 0] | windows[..., :, -1]
        found: dict[int, Array] = {}
        for i, j in np.argwhere(~ring.any(axis=-1)):
            match = table.get(windows[i, j, 1:-1, 1:-1].tobytes())
            if match is not None:
                square = np.array([[j, i], [j + side, i], [j + side, i + side], [j, i + side]], float)
                found[match[0]] = np.roll(square, match[1], axis=0)
        if len(found) > len(best[1]) and len(found) >= _LEAST_MARKERS:
            best = (name, found)
    name, found = best
    for count in _SMALLER:
        if name.endswith("_1000") and max(found) < count:
            return name.replace("_1000", f"_{count}"), found
    return best


@lru_cache(maxsize=16)
def _table(dictionary: str) -> dict[bytes, tuple[int, int]]:
    """Return id and quarter turns (clockwise) of each marker by its bits, row by row."""
    result: dict[bytes, tuple[int, int]] = {}
    for number, image in enumerate(marker_modules(dictionary)):
        for turns in range(4):
            result.setdefault(
                np.ascontiguousarray(np.rot90(image, -turns)[1:-1, 1:-1]).tobytes(), (number, turns)
            )
    return result


def detect_markers(image: NDArray[np.uint8], dictionary: str) -> dict[int, Array]:
    """Return the corners (4, 2) px of the markers in a grey image by id, without ids that are seen twice.

    By cv2.aruco, whose classes came with OpenCV 4.7.
    """
    aruco: Any = cv2.aruco
    table = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
    parameters = (getattr(aruco, "DetectorParameters_create", None) or aruco.DetectorParameters)()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    if hasattr(aruco, "ArucoDetector"):
        corners, ids, _ = aruco.ArucoDetector(table, parameters).detectMarkers(image)
    else:
        corners, ids, _ = aruco.detectMarkers(image, table, parameters=parameters)
    numbers = [] if ids is None else [int(one) for one in np.ravel(ids)]
    return {
        number: np.asarray(corner, float).reshape(4, 2)
        for number, corner in zip(numbers, corners, strict=True)
        if numbers.count(number) == 1
    }


# --- circles ---------------------------------------------------------------------------------------


def _circles(
    grid: Array, origin: tuple[int, int], metres: Array
) -> dict[tuple[int, int], tuple[float, float, float]]:
    """Return the dark discs of a texture that stand in a full grid; tiles on their rims are partly dark."""
    low, high = float(grid.min()), float(grid.max())
    dark = (high - grid) / (high - low)
    labels, count = ndimage.label(dark > 0.02, structure=np.ones((3, 3)))
    found = []
    for number, window in enumerate(ndimage.find_objects(labels), 1):
        if count > _MOST_TILES // 100 or window is None:
            return {}
        share = np.where(labels[window] == number, dark[window], 0.0)
        area = float(share.sum())
        if share.shape[0] < 4 or area <= 0:
            continue
        i, j = (np.arange(size) + 0.5 for size in share.shape)
        row, column = share.sum(axis=1) @ i / area, share.sum(axis=0) @ j / area
        radius = math.sqrt(area / math.pi)
        reach = np.hypot(i[:, None] - row, j[None, :] - column)
        inner, outer = reach < radius * (1 - _ROUND) - 0.7, reach > radius * (1 + _ROUND) + 0.7
        if share[inner].min(initial=1.0) < 1 - _ROUND or share[outer].max(initial=0.0) > _ROUND:
            continue
        place = np.array([window[1].start + column - origin[1], window[0].start + row - origin[0]])
        found.append((*(place * metres), radius * math.sqrt(metres[0] * metres[1])))
    if len(found) < _LEAST_CIRCLES:
        return {}
    radius = float(np.median([one[2] for one in found]))
    found = [one for one in found if abs(one[2] - radius) < _ROUND * radius]
    rows, columns = (_levels([one[k] for one in found], radius) for k in (1, 0))
    named = {(_nearest(rows, one[1]), _nearest(columns, one[0])): one for one in found}
    return dict(sorted(named.items())) if len(named) == len(rows) * len(columns) == len(found) else {}


def _levels(values: list[float], apart: float) -> list[float]:
    ordered = np.sort(values)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > apart) + 1)
    return [float(group.mean()) for group in groups]


def _nearest(levels: list[float], value: float) -> int:
    return int(np.argmin(np.abs(np.array(levels) - value)))
