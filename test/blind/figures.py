"""The pictures of the proof: confusion matrices side by side, sensitivity curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from .score import CONSISTENT, SETUP, UNKNOWN, Result, identifiability, named_right, seen, truth_of
from .table import WHO, Score, confusion, label, local_strength, right_word

CONFUSION, SENSITIVITY, IDENTIFIABILITY = "confusion.png", "sensitivity.png", "identifiability.png"
_SEEN, _NAMED, _GREY = "#b9632f", "#1f6f8b", "#5b6878"
_LAST = (UNKNOWN, CONSISTENT, "wrong_parameters", SETUP, "failed")


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    # no version and no date in the file: the same results give the same bytes
    figure.savefig(path, dpi=110, metadata={"Software": None})


def draw_all(results: Sequence[Result], score: Score, folder: Path) -> list[str]:
    """Write the pictures into an existing folder and return their names."""
    names = []
    for name, draw in (
        (CONFUSION, lambda path: _confusions(results, path)),
        (SENSITIVITY, lambda path: _sensitivity(results, score, path)),
        (IDENTIFIABILITY, lambda path: _identifiability(results, path)),
    ):
        if draw(folder / name):
            names.append(name)
    return names


def _confusions(results: Sequence[Result], path: Path) -> bool:
    tables = [confusion(results, who) for who in WHO]
    rows = sorted({truth for one in tables for truth in one}, key=lambda t: (t in ("outside", "null"), t))
    said = {word for one in tables for counts in one.values() for word in counts}
    words = {*said, *map(right_word, rows)}
    columns = [*sorted(words - set(_LAST)), *(word for word in _LAST if word in words)]
    if not rows:
        return False
    figure = Figure(
        figsize=(3.0 + 0.62 * len(columns), 2.2 + 0.2 * len(rows)), layout="constrained", facecolor="white"
    )
    axes = figure.subplots(1, len(WHO), sharey=True, squeeze=False)[0]
    for axis, who, counts in zip(axes, WHO, tables, strict=True):
        matrix = np.array([[counts.get(t, {}).get(word, 0) for word in columns] for t in rows], float)
        total = matrix.sum(axis=1, keepdims=True)
        axis.imshow(
            matrix / np.maximum(total, 1.0),
            cmap="Blues",
            vmin=0.0,
            vmax=1.0,
            aspect="auto",
            interpolation="none",
        )
        for i, truth in enumerate(rows):
            for j, word in enumerate(columns):
                if matrix[i, j]:
                    dark = matrix[i, j] / total[i, 0] > 0.5
                    axis.text(
                        *(j, i, f"{matrix[i, j]:.0f}"),
                        ha="center",
                        va="center",
                        fontsize=6,
                        color="white" if dark else "black",
                    )
                if right_word(truth) == word:
                    axis.plot(
                        [j - 0.5, j + 0.5, j + 0.5, j - 0.5, j - 0.5],
                        [i - 0.5, i - 0.5, i + 0.5, i + 0.5, i - 0.5],
                        color=_SEEN,
                        linewidth=0.8,
                    )
        axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
        axis.set_yticks(range(len(rows)), rows, fontsize=7)
        axis.set_title(who, fontsize=9, fontweight="bold", loc="left")
        axis.set_xlabel("named first", fontsize=8)
    axes[0].set_ylabel("left out", fontsize=8)
    _save(figure, path)
    return True


def _sensitivity(results: Sequence[Result], score: Score, path: Path) -> bool:
    names = sorted(score.named.points)
    if not names:
        return False
    columns = 5
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(10.5, 0.6 + 1.5 * rows), layout="constrained", facecolor="white")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    grid = np.geomspace(0.01, 10.0, 100)
    for axis, name in zip(axes, names, strict=False):
        ones = [
            one
            for one in results
            if label(one) == name and one["case"]["kind"] in ("plain", "masked", "faint", "unknown")
        ]
        for flag, colour, offset in ((seen, _SEEN, 0.03), (named_right, _NAMED, -0.03)):
            axis.plot(
                [local_strength(one) for one in ones],
                [float(flag(one)) + offset for one in ones],
                "o",
                markersize=2.5,
                color=colour,
                alpha=0.7,
            )
        axis.plot(grid, score.seen.probability(name, grid), color=_SEEN, linewidth=1.0, label="noticed")
        axis.plot(grid, score.named.probability(name, grid), color=_NAMED, linewidth=1.4, label="named right")
        axis.axvline(2.0 * score.seen.points[name], color=_GREY, linewidth=0.8, linestyle=":")
        axis.set_xscale("log")
        axis.set_ylim(-0.1, 1.1)
        axis.set_title(name, fontsize=7.5, loc="left")
        axis.tick_params(labelsize=6.5)
    for axis in axes[len(names) :]:
        axis.axis("off")
    axes[0].legend(fontsize=6, frameon=False, loc="center left")
    figure.supxlabel("RMS of the effect over the single-frame sigma of its pixels", fontsize=8)
    figure.supylabel("share of cases", fontsize=8)
    _save(figure, path)
    return True


def _identifiability(results: Sequence[Result], path: Path) -> bool:
    points = [
        (left, local_strength(one), named_right(one))
        for one in results
        if truth_of(one) and len(one["truth"]["effects"]) == 1 and (left := identifiability(one))
    ]
    if not points:
        return False
    figure = Figure(figsize=(5.2, 3.6), layout="constrained", facecolor="white")
    axis = figure.subplots()
    for flag, marker, colour, text in ((True, "o", _NAMED, "named right"), (False, "x", _SEEN, "not")):
        chosen = [(left, strength) for left, strength, right in points if right is flag]
        axis.plot(
            [c[0] for c in chosen], [c[1] for c in chosen], marker, color=colour, markersize=4, label=text
        )
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.axvline(0.02, color=_GREY, linewidth=0.8, linestyle=":")
    axis.set_xlabel("identifiability: share of its energy that nothing else takes on", fontsize=8)
    axis.set_ylabel("RMS of the effect over sigma", fontsize=8)
    axis.tick_params(which="both", labelsize=7)
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.legend(fontsize=7, frameon=False)
    _save(figure, path)
    return True
