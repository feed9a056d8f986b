"""Pictures of the reproduction as PNG, in the style of the other reports."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rim_camera_ros.reports.figures import LOCK, STYLE, draw_map, draw_panel
from rim_camera_ros.reproduce.results import Picture

_DOTS_PER_INCH = 80


def png(picture: Picture) -> bytes:
    """Return a picture as PNG; the same picture gives the same bytes."""
    with LOCK, matplotlib.rc_context(STYLE):
        figure = Figure(figsize=_size(picture), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        if picture.panels:
            _panels(figure, picture)
        else:
            _maps(figure, picture)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=_DOTS_PER_INCH, metadata={"Software": None})
    return stream.getvalue()


def _grid(picture: Picture) -> tuple[int, int]:
    count = len(picture.panels or picture.maps)
    columns = min(picture.columns, count)
    return -(-count // columns), columns


def _size(picture: Picture) -> tuple[float, float]:
    rows, columns = _grid(picture)
    width = 6.0 if columns == 1 else 4.4 if columns == 2 else 3.6
    return width * columns, 3.2 * rows


def _panels(figure: Any, picture: Picture) -> None:
    rows, columns = _grid(picture)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, axis in zip(picture.panels, axes, strict=False):
        draw_panel(axis, panel)
    for axis in axes[len(picture.panels) :]:
        axis.set_visible(False)


def _maps(figure: Any, picture: Picture) -> None:
    axes = figure.subplots(1, len(picture.maps), squeeze=False)[0]
    for axis, field in zip(axes, picture.maps, strict=True):
        draw_map(figure, axis, field, picture.unit)
