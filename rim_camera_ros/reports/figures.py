"""Figures as SVG: curves with bands, residuals over covariates, maps over the array, matrices.

Importing this needs matplotlib. Lengths are in mm here; callers convert.
"""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[Any]

# messages on fonts that it replaces are of no use on the terminal
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)

#: Before, after, and further curves.
BEFORE, AFTER = "#b9632f", "#1f6f8b"
COLOURS = ("#1f6f8b", "#b9632f", "#5d8a3a", "#7a4f9a", "#a8324a", "#4c5b6b")
_GREY = "#5b6878"
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.edgecolor": "#9aa5b1",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": _GREY,
    "xtick.color": _GREY,
    "ytick.color": _GREY,
    "axes.grid": True,
    "grid.color": "#e6eaee",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "rim_camera_ros",
}
#: Parameters of matplotlib are global.
LOCK = threading.Lock()


@dataclass(frozen=True)
class Curve:
    """A curve over x with its 1-sigma (None: none); drawn as points with bars where ``points``."""

    x: Array
    y: Array
    sigma: Array | None = None
    label: str = ""
    points: bool = False
    colour: str | None = None
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves over one axis."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log: bool = False
    log_y: bool = False


def panels(items: Sequence[Panel], *, columns: int = 3, height: float = 2.5, width: float = 3.5) -> bytes:
    """Return panels of curves with bands of 95 % (1.96 sigma)."""
    columns = min(columns, len(items))
    rows = -(-len(items) // columns)

    def draw(figure: Any) -> None:
        axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        for panel, axis in zip(items, axes, strict=False):
            draw_panel(axis, panel)
        for axis in axes[len(items) :]:
            axis.set_visible(False)

    return svg((width * columns, height * rows), draw)


def draw_panel(axis: Any, panel: Panel) -> None:
    for number, curve in enumerate(panel.curves):
        colour = curve.colour or COLOURS[number % len(COLOURS)]
        band = None if curve.sigma is None else 1.96 * curve.sigma
        if curve.points:
            axis.errorbar(
                curve.x, curve.y, yerr=band, fmt="o", ms=3.2, lw=1, capsize=0, color=colour, label=curve.label
            )
            continue
        axis.plot(curve.x, curve.y, color=colour, lw=1.5, ls="--" if curve.dashed else "-", label=curve.label)
        if band is not None:
            axis.fill_between(curve.x, curve.y - band, curve.y + band, color=colour, alpha=0.22, lw=0)
    axis.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    if panel.log:
        axis.set_xscale("log")
    if panel.log_y:
        axis.set_yscale("log")
    if any(curve.label for curve in panel.curves):
        axis.legend(loc="best", handlelength=1.4, borderaxespad=0.2)


@dataclass(frozen=True)
class Covariate:
    """Values (N,) of a covariate with its axis' label; logarithmic where ``log``."""

    label: str
    values: Array
    log: bool = False


def residuals(
    covariates: Sequence[Covariate], before: Array, after: Array, *, expected: Array, bins: int = 24
) -> bytes:
    """Return residuals [mm] before and after over covariates, a row of two panels for each.

    Shown are the median of each class and the band with its middle 68 %; dashed is the expected 1-sigma of
    single values. Both sides have their own scales.
    """

    def draw(figure: Any) -> None:
        axes = figure.subplots(len(covariates), 2, squeeze=False)
        for number, (row, covariate) in enumerate(zip(axes, covariates, strict=True)):
            known = np.isfinite(covariate.values)
            edges = class_edges(covariate.values[known], bins, log=covariate.log)
            for axis, values, colour, title in (
                (row[0], before, BEFORE, "before"),
                (row[1], after, AFTER, "after"),
            ):
                _draw_classes(axis, covariate.values[known], values[known], expected[known], edges, colour)
                axis.set(xlabel=covariate.label, ylabel="residual [mm]")
                if covariate.log:
                    axis.set_xscale("log")
                if number == 0:
                    axis.set_title(title)

    return svg((10.4, 2.15 * len(covariates)), draw)


def class_edges(values: Array, count: int, *, log: bool) -> Array:
    """Return edges of classes between the 0.5 and 99.5 % quantiles, or around each of a few values."""
    few = np.unique(values)
    if few.size <= 12:
        if few.size == 1:
            return np.array([few[0] - 0.5, few[0] + 0.5])
        middle = (few[1:] + few[:-1]) / 2
        return np.concatenate([[2 * few[0] - middle[0]], middle, [2 * few[-1] - middle[-1]]])
    low, high = np.quantile(values, [0.005, 0.995])
    return np.geomspace(low, high, count + 1) if log and low > 0 else np.linspace(low, high, count + 1)


def _draw_classes(axis: Any, x: Array, values: Array, expected: Array, edges: Array, colour: str) -> None:
    place = np.searchsorted(edges, x, side="right") - 1
    centres, rows = [], []
    for k in range(len(edges) - 1):
        mine = place == k
        if mine.sum() < 20:
            continue
        low, middle, high = np.quantile(values[mine], [0.16, 0.5, 0.84])
        centres.append((edges[k] + edges[k + 1]) / 2)
        rows.append((low, middle, high, float(np.median(expected[mine]))))
    axis.axhline(0.0, color="#9aa5b1", lw=0.8)
    if not rows:
        return
    low, middle, high, noise = np.array(rows).T
    axis.fill_between(centres, low, high, color=colour, alpha=0.16, lw=0)
    axis.plot(centres, middle, color=colour, lw=1.5, marker="o", ms=2.4)
    for sign in (1, -1):
        axis.plot(centres, sign * noise, color=_GREY, lw=0.8, ls=(0, (4, 3)))
    reach = max(float(np.max(np.abs(middle))), float(np.quantile(np.maximum(-low, high), 0.8)))
    axis.set_ylim(-1.25 * reach, 1.25 * reach)


@dataclass(frozen=True)
class Map:
    """An image over the array with a title.

    ``limit``: the colours reach from -limit to limit (None: by itself); ``from_zero``: no negative values,
    colours from 0.
    """

    title: str
    image: Array
    limit: float | None = None
    from_zero: bool = False


def maps(items: Sequence[Map], unit: str) -> bytes:
    """Return images over the array side by side, each with its colour bar."""

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, len(items), squeeze=False)[0]
        for axis, one in zip(axes, items, strict=True):
            draw_map(figure, axis, one, unit)

    return svg((10.4, 3.0 if len(items) > 2 else 3.8), draw)


def draw_map(figure: Any, axis: Any, one: Map, unit: str) -> None:
    """Draw an image over the array into an axis, with its colour bar in ``unit``."""
    finite = one.image[np.isfinite(one.image)]
    limit = one.limit
    if limit is None:
        limit = float(np.quantile(np.abs(finite), 0.98)) if finite.size else 1.0
    limit = max(limit, 1e-9)
    axis.grid(False)
    picture = axis.imshow(
        one.image,
        cmap="viridis" if one.from_zero else "RdBu_r",
        vmin=0.0 if one.from_zero else -limit,
        vmax=limit,
        interpolation="nearest",
    )
    axis.set(title=one.title, xlabel="column [px]", ylabel="row [px]")
    bar = figure.colorbar(picture, ax=axis, shrink=0.82, pad=0.02)
    bar.set_label(unit, color=_GREY)
    bar.outline.set_visible(False)


def matrix(labels: Sequence[str], values: Array) -> bytes:
    """Return a matrix of correlations (N, N) with its labels."""
    size = min(10.4, 3.2 + 0.21 * len(labels))

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        axis.grid(False)
        picture = axis.imshow(values, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
        ticks = range(len(labels))
        small = 8 if len(labels) < 40 else 6
        axis.set_xticks(ticks, labels, rotation=90, fontsize=small)
        axis.set_yticks(ticks, labels, fontsize=small)
        axis.tick_params(length=0)
        for spine in axis.spines.values():
            spine.set_visible(False)
        bar = figure.colorbar(picture, ax=axis, shrink=0.6, pad=0.02)
        bar.set_label("correlation", color=_GREY)
        bar.outline.set_visible(False)

    return svg((size, size * 0.9), draw)


def svg(size: tuple[float, float], draw: Any) -> bytes:
    with LOCK, matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained", dpi=100)
        FigureCanvasSVG(figure)
        draw(figure)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None}, bbox_inches="tight", pad_inches=0.05)
    return stream.getvalue()
