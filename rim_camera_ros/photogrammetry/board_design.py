"""Printable targets: checkerboard, ChArUco, AprilTag grid, circles, with a strip of grey fields.

A design is a list of shapes in metres in the frame of the board (origin in the middle, x right, y down as it
is looked at), from which both the print and the texture of the scene file are made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import Texture

Array = NDArray[np.float64]

Kind = Literal["checkerboard", "charuco", "apriltag", "circles"]
#: Least and greatest side of a square that is printed [m].
SIDES = (0.001, 1.0)
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Default dictionary of each kind with markers: few bits for small sensors, and Kalibr's.
DICTIONARIES = {"charuco": "DICT_4X4_100", "apriltag": "DICT_APRILTAG_36h11"}

#: Squares between the sides of a ChArUco's square and its marker, and between two tags, in modules.
_MARGIN = 2
_GAP = 2
#: Cells to the side of a square of a checkerboard and to the spacing of circles; a circle is half as wide.
_SQUARE = 2
_SPACING = 16
#: Points to the side of a cell by which the share of a circle in it is counted.
_FINE = 16
#: Largest number of cells of a texture: scene files of more are slow to read.
MOST_CELLS = 40_000


@dataclass(frozen=True)
class Shape:
    """A rectangle (``radius`` 0: ``size`` full width and height) or a circle, centred, of one ``level``.

    Lengths in m; level 0 is the ink, 1 the paper, a linear share of the reflected light between.
    """

    centre: tuple[float, float]
    level: float
    size: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.0


@dataclass(frozen=True)
class BoardDesign:
    """A printable board.

    ``cell`` [m]: side of a tile of the texture. ``levels`` (rows, columns): mean level of each tile, 0 ink to
    1 paper, row by row from the upper left. ``shapes`` are drawn on paper, one after the other.
    """

    kind: Kind
    cell: float
    levels: Array
    shapes: tuple[Shape, ...]
    words: str

    @property
    def size(self) -> tuple[float, float]:
        """Full width and height in m, white margin included."""
        rows, columns = self.levels.shape
        return (columns * self.cell, rows * self.cell)


class _Canvas:
    """Shapes on a grid of cells, whose corner is the upper left one of the pattern with its margin."""

    def __init__(self, columns: int, rows: int, cell: float) -> None:
        # an even number of cells, so that the middle of the board is a corner of the texture
        self.columns, self.rows = columns + columns % 2, rows + rows % 2
        if self.columns * self.rows > MOST_CELLS:
            raise InputError(
                f"the board has {self.columns * self.rows} cells, at most {MOST_CELLS} make a scene file",
                place="--columns, --rows",
                remedy="fewer squares, tags or circles",
            )
        self.cell = cell
        self.shapes: list[Shape] = []

    def rectangle(self, column: float, row: float, wide: float, high: float, level: float = 0.0) -> None:
        centre = self._at(column + wide / 2, row + high / 2)
        self.shapes.append(Shape(centre, level, size=(wide * self.cell, high * self.cell)))

    def circle(self, column: float, row: float, diameter: float) -> None:
        self.shapes.append(Shape(self._at(column, row), 0.0, radius=diameter / 2 * self.cell))

    def _at(self, column: float, row: float) -> tuple[float, float]:
        return ((column - self.columns / 2) * self.cell, (row - self.rows / 2) * self.cell)

    def design(self, kind: Kind, words: str) -> BoardDesign:
        levels = _rasterised(self.shapes, self.columns, self.rows, self.cell)
        return BoardDesign(kind, self.cell, levels, tuple(self.shapes), words)


def design_board(
    kind: str,
    *,
    columns: int,
    rows: int,
    square: float,
    greys: int = 6,
    dictionary: str | None = None,
) -> BoardDesign:
    """Return a board of ``columns`` x ``rows`` squares, tags or circles.

    ``square`` [m]: the side of a square, of a tag (black border included), or the spacing of the circles.
    ``greys`` fields from ink to paper stand in a strip below the pattern (0: none). ``dictionary`` names the
    markers as OpenCV does (DICT_4X4_100). Raises `InputError` for what cannot be made.
    """
    if kind not in KINDS:
        raise InputError(f"no kind of board '{kind}'", place="KIND", remedy=nearest_name(kind, KINDS))
    made: Kind = kind
    low, high = SIDES
    if not low <= square <= high:
        raise InputError(f"a side of {square:g} m", place="--square", remedy=f"from {low:g} to {high:g} m")
    least = 4 if made == "checkerboard" else 2
    if min(columns, rows) < least or max(columns, rows) > 200:
        raise InputError(
            f"{columns} x {rows} is no board", place="--columns, --rows", remedy=f"from {least} to 200 each"
        )
    if greys and not 2 <= greys <= 16:
        raise InputError(f"{greys} grey fields", place="--greys", remedy="0 or 2 to 16")
    if dictionary is not None and made not in DICTIONARIES:
        raise InputError(f"a {made} has no markers", place="--dictionary", remedy="leave it out")
    if made == "checkerboard":
        return _checkerboard(columns, rows, square, greys)
    if made == "circles":
        return _circles(columns, rows, square, greys)
    name = dictionary or DICTIONARIES[made]
    count = columns * rows // 2 if made == "charuco" else columns * rows
    images = marker_modules(name, count)
    return (_charuco if made == "charuco" else _tags)(columns, rows, square, greys, name, images)


def _strip(canvas: _Canvas, greys: int, *, top: float, field: float, left: float, width: float) -> None:
    """Draw grey fields from ink to paper over a width; the last is the paper itself."""
    each = width / greys if greys else 0.0
    for i in range(greys - 1):
        # whole cells, so that the texture says the same as the print
        first, last = round(left + i * each), round(left + (i + 1) * each)
        canvas.rectangle(first, top, last - first, field, i / (greys - 1))


def _checkerboard(columns: int, rows: int, square: float, greys: int) -> BoardDesign:
    margin = _SQUARE
    strip = 2 * _SQUARE if greys else 0
    wide, high = columns * _SQUARE, rows * _SQUARE
    canvas = _Canvas(wide + 2 * margin, high + 2 * margin + strip, square / _SQUARE)
    _squares(canvas, columns, rows, side=_SQUARE, margin=margin)
    _strip(canvas, greys, top=margin + high + _SQUARE, field=_SQUARE, left=margin, width=wide)
    words = f"checkerboard of {columns} x {rows} squares of {square * 1000:g} mm"
    return canvas.design("checkerboard", words)


def _squares(canvas: _Canvas, columns: int, rows: int, *, side: int, margin: int) -> None:
    """Draw the black squares; the upper left one is black (as in OpenCV since 4.6)."""
    for row in range(rows):
        for column in range(row % 2, columns, 2):
            canvas.rectangle(margin + column * side, margin + row * side, side, side)


def _charuco(
    columns: int, rows: int, square: float, greys: int, name: str, images: Sequence[NDArray[np.bool_]]
) -> BoardDesign:
    modules = len(images[0])
    side = modules + 2 * _MARGIN
    margin = side // 2
    wide, high = columns * side, rows * side
    strip = margin + side // 2 if greys else 0
    canvas = _Canvas(wide + 2 * margin, high + 2 * margin + strip, square / side)
    _squares(canvas, columns, rows, side=side, margin=margin)
    white = [(c, r) for r in range(rows) for c in range((r + 1) % 2, columns, 2)]
    for image, (column, row) in zip(images, white, strict=False):
        corner = (margin + column * side + _MARGIN, margin + row * side + _MARGIN)
        _marker(canvas, image, *corner)
    _strip(canvas, greys, top=margin + high + margin, field=side // 2, left=margin, width=wide)
    words = f"ChArUco of {columns} x {rows} squares of {square * 1000:g} mm, markers {name}"
    return canvas.design("charuco", words)


def _tags(
    columns: int, rows: int, side: float, greys: int, name: str, images: Sequence[NDArray[np.bool_]]
) -> BoardDesign:
    modules = len(images[0])
    step = modules + _GAP
    margin = 2 * _GAP
    wide, high = columns * step + _GAP, rows * step + _GAP
    strip = margin + modules // 2 if greys else 0
    canvas = _Canvas(wide + 2 * margin, high + 2 * margin + strip, side / modules)
    for row in range(rows + 1):
        for column in range(columns + 1):
            # Kalibr's squares: they make every corner of a tag a crossing of two edges
            canvas.rectangle(margin + column * step, margin + row * step, _GAP, _GAP)
    for i, image in enumerate(images):
        row, column = divmod(i, columns)
        _marker(canvas, image, margin + _GAP + column * step, margin + _GAP + row * step)
    _strip(canvas, greys, top=margin + high + margin, field=modules // 2, left=margin, width=wide)
    words = f"AprilTag grid of {columns} x {rows} tags {name} of {side * 1000:g} mm"
    return canvas.design("apriltag", words)


def _circles(columns: int, rows: int, spacing: float, greys: int) -> BoardDesign:
    margin = _SPACING // 2
    wide, high = (columns - 1) * _SPACING, (rows - 1) * _SPACING
    strip = _SPACING if greys else 0
    canvas = _Canvas(wide + 4 * margin, high + 4 * margin + strip, spacing / _SPACING)
    for row in range(rows):
        for column in range(columns):
            canvas.circle(2 * margin + column * _SPACING, 2 * margin + row * _SPACING, _SPACING / 2)
    _strip(canvas, greys, top=high + 4 * margin, field=margin, left=margin, width=wide + 2 * margin)
    words = f"{columns} x {rows} circles of {spacing * 500:g} mm, {spacing * 1000:g} mm apart"
    return canvas.design("circles", words)


def _marker(canvas: _Canvas, image: NDArray[np.bool_], column: int, row: int) -> None:
    """Draw the black modules, runs of a row as one rectangle."""
    for i, line in enumerate(image):
        black = np.flatnonzero(~line)
        for run in np.split(black, np.flatnonzero(np.diff(black) > 1) + 1):
            if run.size:
                canvas.rectangle(column + int(run[0]), row + i, len(run), 1)


def require_aruco() -> Any:
    """Return cv2.aruco. Raises `InputError` where this OpenCV was built without it."""
    if not hasattr(cv2, "aruco"):
        raise InputError(
            f"OpenCV {cv2.__version__} was built without cv2.aruco",
            place="markers",
            remedy="pip install 'opencv-python-headless>=4.8' or apt install python3-opencv, or use a "
            "checkerboard or circles",
        )
    return cv2.aruco


def marker_modules(name: str, count: int | None = None) -> list[NDArray[np.bool_]]:
    """Return the first markers (all) of a dictionary as images of modules (m, m), True white, with border.

    Raises `InputError` for an unknown dictionary, or one with fewer markers.
    """
    aruco = require_aruco()
    known = [one for one in dir(aruco) if one.startswith("DICT_")]
    if name not in known:
        raise InputError(f"no dictionary '{name}'", place="--dictionary", remedy=nearest_name(name, known))
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, name))
    count = len(dictionary.bytesList) if count is None else count
    if len(dictionary.bytesList) < count:
        raise InputError(
            f"{name} has {len(dictionary.bytesList)} markers, {count} are needed",
            place="--dictionary",
            remedy="another dictionary, or fewer columns and rows",
        )
    modules = int(dictionary.markerSize) + 2
    draw = getattr(aruco, "generateImageMarker", None) or aruco.drawMarker
    return [draw(dictionary, i, modules) > 127 for i in range(count)]


def _rasterised(shapes: Sequence[Shape], columns: int, rows: int, cell: float) -> Array:
    """Return the mean level of each cell (rows, columns): exact for rectangles of whole cells."""
    levels = np.ones((rows, columns))
    for shape in shapes:
        left, top = shape.centre[0] / cell + columns / 2, shape.centre[1] / cell + rows / 2
        half = (np.array(shape.size) / 2 if shape.radius == 0 else np.full(2, shape.radius)) / cell
        first = np.floor(np.array([left, top]) - half + 1e-6).astype(int)
        last = np.ceil(np.array([left, top]) + half - 1e-6).astype(int)
        window = (slice(first[1], last[1]), slice(first[0], last[0]))
        share: Any = 1.0
        if shape.radius > 0:
            fine = (np.arange(_FINE) + 0.5) / _FINE
            x = (np.arange(first[0], last[0])[:, None] + fine).ravel() - left
            y = (np.arange(first[1], last[1])[:, None] + fine).ravel() - top
            inside = np.hypot(x[None, :], y[:, None]) <= shape.radius / cell
            share = inside.reshape(len(y) // _FINE, _FINE, len(x) // _FINE, _FINE).mean(axis=(1, 3))
        levels[window] = (1 - share) * levels[window] + share * shape.level
    return levels


def texture_of(design: BoardDesign, *, ink: float, paper: float) -> Texture:
    """Return the texture of a scene's rectangle for reflectivities of ink and paper."""
    rows, columns = design.levels.shape
    values = ink + (paper - ink) * design.levels
    # tile (0, 0) of a texture begins in the middle of the rectangle
    rolled = np.roll(values, (-(rows // 2), -(columns // 2)), axis=(0, 1))
    return Texture((design.cell, design.cell), NestedList(np.round(rolled, 4)))
