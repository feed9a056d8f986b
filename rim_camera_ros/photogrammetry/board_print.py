"""A board on paper at true scale, as PDF or SVG, with a ruler; and its scene file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from rim_camera_ros.errors import InputError
from rim_camera_ros.photogrammetry.board_design import BoardDesign, texture_of
from rim_camera_ros.yaml_files import write_whole

#: Sizes of paper in m, upright (width, height), in the order in which they are tried.
PAPERS = {
    "a4": (0.210, 0.297),
    "letter": (0.2159, 0.2794),
    "a3": (0.297, 0.420),
    "tabloid": (0.2794, 0.4318),
    "a2": (0.420, 0.594),
    "a1": (0.594, 0.841),
    "a0": (0.841, 1.189),
}
#: Margin that printers leave, and room for the ruler and the words below the board [m].
_MARGIN = 0.005
_FOOT = 0.016
_INCH = 0.0254
_POINTS = 72 / _INCH
#: Printed grey values are spread for the eye (sRGB): a level is a share of reflected light.
_GAMMA = 2.2


def paper_words(paper: str) -> str:
    """Return the name of a paper as it is printed: A4, letter."""
    return paper.upper() if len(paper) == 2 else paper


def own_page(design: BoardDesign) -> tuple[float, float]:
    """Return the page (width, height) in m that is just as large as board and ruler need."""
    return (design.size[0] + 2 * _MARGIN, design.size[1] + 2 * _MARGIN + _FOOT)


def smallest_paper(design: BoardDesign) -> str | None:
    """Return the name of the first paper that a board and its ruler fit; None where none is large enough."""
    return next((paper for paper in PAPERS if _page(design, paper) is not None), None)


def fitting_square(design: BoardDesign, paper: str, *, square: float) -> float:
    """Return the largest side [m] of squares, ``square`` in the design, with which it fits a paper.

    In whole millimetres, below 5 mm in tenths.
    """
    width, height = PAPERS[paper]
    scale = max(
        min((wide - 2 * _MARGIN) / design.size[0], (high - 2 * _MARGIN - _FOOT) / design.size[1])
        for wide, high in ((width, height), (height, width))
    )
    side = 1000 * scale * square + 1e-6
    return float(np.floor(side) / 1000 if side >= 5 else np.floor(10 * side) / 10_000)


def paper_for(design: BoardDesign, paper: str, *, square: float) -> tuple[float, float]:
    """Return the page (width, height) in m of a paper, the way up that a board of such squares [m] fits.

    Raises `InputError` where it fits neither.
    """
    page = _page(design, paper)
    if page is not None:
        return page
    wide, high = own_page(design)
    other = smallest_paper(design)
    raise InputError(
        f"the board with its ruler takes {wide * 1000:.0f} x {high * 1000:.0f} mm, more than "
        f"{paper_words(paper)}",
        place="--paper",
        remedy=f"--square {fitting_square(design, paper, square=square):g} fits it"
        + ("" if other is None else f", or --paper {other}"),
    )


def _page(design: BoardDesign, paper: str) -> tuple[float, float] | None:
    wide, high = own_page(design)
    width, height = PAPERS[paper]
    for page in ((width, height), (height, width)):
        if wide <= page[0] + 1e-9 and high <= page[1] + 1e-9:
            return page
    return None


def print_board(
    design: BoardDesign, path: Path, *, page: tuple[float, float], paper: str | None = None
) -> None:
    """Write a PDF or SVG (by the ending of ``path``) on a page of (width, height) m. Raises `RimError`.

    ``paper`` names the page in the line below the board.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    figure = Figure(figsize=(page[0] / _INCH, page[1] / _INCH), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    width, height = design.size
    left, top = (page[0] - width) / 2, (page[1] - _FOOT - height) / 2
    # metres of the page from its upper left corner
    axes.set_xlim(0, page[0])
    axes.set_ylim(page[1], 0)
    middle = np.array([left + width / 2, top + height / 2])
    for shape in design.shapes:
        grey = str(round(shape.level ** (1 / _GAMMA), 4))
        style: dict[str, Any] = {"facecolor": grey, "edgecolor": "none", "linewidth": 0, "antialiased": False}
        if shape.radius > 0:
            axes.add_patch(Circle(tuple(middle + shape.centre), shape.radius, **style))
        else:
            corner = middle + np.array(shape.centre) - np.array(shape.size) / 2
            axes.add_patch(Rectangle(tuple(corner), *shape.size, **style))
    for x in (left, left + width):
        for y in (top, top + height):
            # where the board ends: marks to cut along, outside of it
            axes.plot([x - np.sign(middle[0] - x) * 0.003, x], [y, y], color="0.6", lw=0.3)
            axes.plot([x, x], [y - np.sign(middle[1] - y) * 0.003, y], color="0.6", lw=0.3)
    where = "" if paper is None else f" on {paper_words(paper)}"
    words = f"{design.words}. Print{where} at 100 %"
    _ruler(axes, left=left, y=page[1] - _FOOT + 0.004, width=width, words=words)
    canvas: Any = FigureCanvasPdf(figure) if path.suffix == ".pdf" else FigureCanvasSVG(figure)
    save = canvas.print_pdf if path.suffix == ".pdf" else canvas.print_svg
    with mpl.rc_context({"svg.hashsalt": "rim", "pdf.fonttype": 42}):
        metadata = {"CreationDate": None} if path.suffix == ".pdf" else {"Date": None}
        write_whole(path, lambda file: save(file, metadata=metadata))


def _ruler(axes: Any, *, left: float, y: float, width: float, words: str) -> None:
    length = np.floor(width / 0.01 + 1e-6) * 0.01
    axes.plot([left, left + length], [y, y], color="black", lw=0.4)
    for k in range(round(length / 0.01) + 1):
        x, long = left + k * 0.01, 0.004 if k % 5 == 0 else 0.002
        axes.plot([x, x], [y, y + long], color="black", lw=0.4)
    text = (
        f"{words}: the line is {length * 1000:.0f} mm long. "
        "Use a laser printer: dyes of ink-jets can be white in the infrared."
    )
    points = min(6.5, width * _POINTS / (0.5 * len(text)))
    axes.text(left, y + 0.0055, text, fontsize=points, va="top", family="sans-serif")


def scene_text(design: BoardDesign, *, name: str, ink: float, paper: float, distance: float) -> str:
    """Return the scene file of a board, with poses for ``rim simulate`` around ``distance`` m."""
    texture = texture_of(design, ink=ink, paper=paper)
    width, height = design.size
    rows = yaml.safe_dump(texture.values.values.tolist(), default_flow_style=None, width=100_000)
    values = "\n".join(f"    {line}" for line in rows.splitlines())
    return f"""# {design.words[0].upper()}{design.words[1:]}, written by rim board.
# Origin in the middle, x right, y down as it is looked at. Reflectivities of ink and paper are guesses
# ({ink:g}, {paper:g}); those of grey fields are shares between them. The white margin belongs to the board.
# For rim simulate: pixels see an area where the camera file has mixed_pixels: {{blur: 0.0, footprint: 1.0}};
# without a footprint each sees a point, and corners are off by up to half a pixel.
format: rim_scene/1
surfaces:
- name: {name}
  type: rectangle
  pose: truth
  size: [{width:.10g}, {height:.10g}]
  texture:
    cell: [{design.cell:.10g}, {design.cell:.10g}]
    values:
{values}
schedule:                        # for rim simulate: distances, tilts, rolls that determine optics and poses
{_schedule(name, distance)}"""


def _schedule(name: str, distance: float) -> str:
    lines = []
    tilts = [(0, 0, 0), (25, 0, 0), (-25, 0, 90), (0, 25, 0)]
    tilts += [(0, -25, 90), (20, 20, 0), (-20, 20, 90), (20, -20, 180)]
    for k, (about_x, about_y, roll) in enumerate(tilts * 2):
        z = distance * (1.0 if k < len(tilts) else 1.4)
        turn = Rotation.from_euler("zxy", [roll, about_x, about_y], degrees=True).as_quat()
        shift = 0.12 * z * np.array([np.cos(2.4 * k), np.sin(2.4 * k)])
        orientation = ", ".join(f"{one:.9g}" for one in turn)
        lines.append(
            f"- {{frames: 5, rate: 10.0, integration_time: 16.0, uptime: {3600 + 10 * k}.0, poses: {{{name}: "
            f"{{position: [{shift[0]:.4f}, {shift[1]:.4f}, {z:.4f}], orientation: [{orientation}]}}}}}}"
        )
    return "\n".join(lines) + "\n"
