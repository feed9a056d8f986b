"""A picture of the coverage for RViz and rqt: the array, distance by amplitude, and a bar for each effect."""

from __future__ import annotations

import math
import sys
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.plan import NARROWED
from rim_camera_ros.coverage.evaluate import AMPLITUDE_CLASSES, Coverage

Image = NDArray[np.uint8]

WIDTH, HEIGHT = 760, 600
_PANEL, _TOP, _MARGIN, _LINE = 340, 40, 20, 20
_PAPER, _INK, _GREY = (255, 255, 255), (30, 30, 30), (215, 215, 215)
_GOOD, _POOR, _BAD = (0, 114, 178), (230, 159, 0), (213, 94, 0)  # Okabe and Ito: distinguishable for all
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Report(NamedTuple):
    """The coverage and its picture; ``problem``: why there is none; ``ended``: no reports follow."""

    coverage: Coverage | None
    picture: Image | None = None
    problem: str = ""
    ended: bool = False

    @property
    def words(self) -> str:
        """The problem, and whether further reports may follow."""
        end = "; no more is said of the coverage, and the recording is not affected"
        return self.problem + (end if self.ended else "")


def print_report(report: Report) -> None:
    """Print the coverage to standard error."""
    lines = [f"coverage: {report.words}"] if report.coverage is None else report.coverage.lines()
    start = "\r\033[K" if sys.stderr.isatty() else ""
    print(start + "\n".join(lines), file=sys.stderr, flush=True)


def coverage_picture(coverage: Coverage, *, ambiguity: float) -> Image:
    """Return the picture, rgb8 (H, W, 3); ``ambiguity`` [m]: the end of the axis of distances."""
    picture: Image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    head = f"{coverage.stations} stations, {coverage.frames} frames; last: {coverage.last}"
    _text(picture, head, (_MARGIN, 24), most=WIDTH - 2 * _MARGIN)
    right = _MARGIN + _PANEL + 2 * _MARGIN
    bottom = _panel(picture, coverage.seen, (_MARGIN, _TOP), "stations in which each pixel was used")
    # distance to the right, amplitude upwards
    readings = np.log1p(coverage.readings.T[::-1])
    words = f"distance 0 to {ambiguity:.2g} m, amplitude 1 to 2^{AMPLITUDE_CLASSES} counts"
    bottom = max(bottom, _panel(picture, readings, (right, _TOP), words))
    bottom += 24
    words = f"by how much uncertainties shrank; full and blue: determined (x{NARROWED:g} and more)"
    _text(picture, words, (_MARGIN, bottom), most=WIDTH - 2 * _MARGIN)
    _bars(picture, coverage, bottom + 12)
    if coverage.moved is not None:
        _text(picture, f"NOT at rest: {coverage.moved * 1e3:.2g} mm", (_MARGIN, HEIGHT - 34), _BAD)
    if coverage.next is not None:
        words = f"next: {coverage.next.words}"
        _text(picture, words, (_MARGIN, HEIGHT - 12), most=WIDTH - 2 * _MARGIN)
    return picture


def _panel(picture: Image, values: NDArray[Any], at: tuple[int, int], words: str) -> int:
    """Draw values as an image with a title below; return the row below it."""
    high = float(values.max()) or 1.0
    shade = np.round(255 * (1 - values / high)).astype(np.uint8)
    height = min(int(_PANEL * values.shape[0] / values.shape[1]), 255)
    shown = cv2.resize(shade, (_PANEL, height), interpolation=cv2.INTER_NEAREST)
    dark = np.array(_GOOD, float)
    colours = dark + (255 - dark) * (shown[..., None] / 255.0)
    x, y = at
    picture[y : y + height, x : x + _PANEL] = colours.astype(np.uint8)
    cv2.rectangle(picture, (x, y), (x + _PANEL, y + height), _INK, 1)
    _text(picture, words, (x, y + height + 16), most=_PANEL)
    return y + height + 16


def _bars(picture: Image, coverage: Coverage, top: int) -> None:
    """Draw a bar of each effect's factor, full from the factor at which it is determined."""
    rows = max(1, (HEIGHT - 60 - top) // _LINE)
    ordered = sorted(coverage.factors.items(), key=lambda one: one[1])
    for number, (name, factor) in enumerate(ordered[: 2 * rows]):
        x = _MARGIN + (number // rows) * (_PANEL + 2 * _MARGIN)
        y = top + (number % rows) * _LINE
        share = min(max(math.log(max(factor, 1.0)) / math.log(NARROWED), 0.0), 1.0)
        _text(picture, name, (x, y + 10), most=175)
        left, length = x + 180, 110
        cv2.rectangle(picture, (left, y), (left + length, y + 12), _GREY, -1)
        colour = _GOOD if share == 1.0 else _POOR
        cv2.rectangle(picture, (left, y), (left + round(share * length), y + 12), colour, -1)
        _text(picture, f"x{factor:.2g}", (left + length + 6, y + 10))


def _text(
    picture: Image,
    words: str,
    at: tuple[int, int],
    colour: tuple[int, int, int] = _INK,
    *,
    most: int | None = None,
) -> None:
    """Write words, smaller where they would be wider than ``most`` pixels."""
    scale = 0.45
    if most is not None:
        wide = cv2.getTextSize(words, _FONT, scale, 1)[0][0]
        scale *= min(1.0, most / max(wide, 1))
    cv2.putText(picture, words, at, _FONT, scale, colour, 1, cv2.LINE_AA)
