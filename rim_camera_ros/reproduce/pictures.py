"""Pictures of the reproduction as PNG, in the style of the other reports."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rim_camera_ros.reports.figures import _LOCK, _STYLE, Map, _draw_panel
from rim_camera_ros.reproduce.results import Picture

_DOTS_PER_INCH = 80


def png(picture: Picture) -> bytes:
    """Return a picture as PNG; the same picture gives the same bytes."""
    with _LOCK, matplotlib.rc_context(_STYLE):
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
    for one, axis in zip(picture.panels, axes, strict=False):
        _draw_panel(axis, one)
    for axis in axes[len(picture.panels) :]:
        axis.set_visible(False)


def _maps(figure: Any, picture: Picture) -> None:
    axes = figure.subplots(1, len(picture.maps), squeeze=False)[0]
    for axis, one in zip(axes, picture.maps, strict=True):
        _draw_map(figure, axis, one, picture.unit)


def _draw_map(figure: Any, axis: Any, one: Map, unit: str) -> None:
    finite = one.image[np.isfinite(one.image)]
    limit = float(np.quantile(np.abs(finite), 0.98)) if one.limit is None else one.limit
    axis.grid(False)
    image = axis.imshow(
        one.image,
        cmap="viridis" if one.from_zero else "RdBu_r",
        vmin=0.0 if one.from_zero else -limit,
        vmax=limit,
        interpolation="nearest",
    )
    axis.set(title=one.title, xlabel="column [px]", ylabel="row [px]")
    bar = figure.colorbar(image, ax=axis, shrink=0.82, pad=0.02)
    bar.set_label(unit)
    bar.outline.set_visible(False)
