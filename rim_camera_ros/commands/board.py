"""``rim board``: a printable target and its scene file."""

from __future__ import annotations

import argparse
from pathlib import Path

from rim_camera_ros.commands.common import add_command, add_output, check_file, check_outputs, positive
from rim_camera_ros.errors import InputError
from rim_camera_ros.photogrammetry.board_design import (
    DICTIONARIES,
    KINDS,
    SIDES,
    BoardDesign,
    design_board,
)
from rim_camera_ros.photogrammetry.board_print import (
    PAPERS,
    fitting_square,
    own_page,
    paper_for,
    paper_words,
    print_board,
    scene_text,
    smallest_paper,
)
from rim_camera_ros.yaml_files import write_whole

_EXAMPLES = """
rim board checkerboard --out board                    # 8 x 5 squares of 20 mm on A4: board.pdf, board.yaml
rim board checkerboard --paper a3 --out large         # the largest squares that fit
rim board charuco --columns 7 --rows 5 --square 0.05 --paper a2 --out charuco
rim board circles --paper letter --out circles --format svg
"""
#: Columns, rows and side [m] of each kind: for A4 and letter where a SwissRanger finds that at 1 m, else A3.
_DEFAULTS = {
    "checkerboard": (8, 5, 0.02),
    "charuco": (4, 4, 0.05),
    "apriltag": (3, 4, 0.05),
    "circles": (7, 4, 0.03),
}
#: Least number of pixels of a cell of the design with which it is found: squares are 2 cells, spacings of
#: circles 16, modules of markers 1 (simulated boards tilted by up to 30 deg).
_LEAST_PIXELS = {"checkerboard": 2.0, "charuco": 1.4, "apriltag": 1.4, "circles": 0.375}
#: Focal length [px] for which the greatest distance is stated: a SwissRanger's.
_FOCAL = 200.0


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "board",
        "Write a target to print at true scale and its scene file. With a ruler to check the print, and grey "
        "fields for terms that depend on the amplitude. rim poses finds it in recordings.",
        _EXAMPLES,
    )
    parser.add_argument("kind", metavar="KIND", help=f"one of {', '.join(KINDS)}")
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="NAME",
        help="writes NAME.pdf (or .svg) and NAME.yaml",
    )
    parser.add_argument("--columns", type=positive(int), help="squares, tags or circles in a row")
    parser.add_argument("--rows", type=positive(int), help="rows of them")
    parser.add_argument(
        "--square",
        type=positive(float),
        metavar="M",
        help="side of a square or tag, or spacing of circles, in m",
    )
    parser.add_argument(
        "--greys", type=int, default=6, metavar="N", help="grey fields in a strip, 0: none (6)"
    )
    parser.add_argument(
        "--dictionary",
        metavar="NAME",
        help="markers, as cv2.aruco names them ("
        + ", ".join(f"{kind}: {name}" for kind, name in DICTIONARIES.items())
        + ")",
    )
    parser.add_argument(
        "--paper",
        choices=[*PAPERS, "exact"],
        help="page, filled where no --square is given; exact: as large as the board (default: the smallest "
        "that it fits)",
    )
    parser.add_argument("--format", choices=["pdf", "svg"], default="pdf", help="of the print (pdf)")
    parser.add_argument(
        "--ink", type=float, default=0.06, help="reflectivity of the ink at the camera's light (0.06)"
    )
    parser.add_argument("--white", type=float, default=0.85, help="reflectivity of the paper (0.85)")
    parser.add_argument(
        "--distance",
        type=positive(float),
        metavar="M",
        help="about which the schedule for rim simulate puts it",
    )
    parser.add_argument("--name", default="board", help="name of the surface (board)")
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Write print and scene."""
    columns, rows, square = _DEFAULTS.get(given.kind, (0, 0, 0.0))
    if not 0 <= given.ink < given.white <= 1:
        raise InputError(
            f"reflectivities of ink {given.ink:g} and paper {given.white:g}",
            place="--ink, --white",
            remedy="0 to 1, the ink darker",
        )
    if not given.name.replace("_", "").isalnum():
        raise InputError(f"'{given.name}' is no name", place="--name", remedy="letters, digits and _")
    design, square = _design(given, (given.columns or columns, given.rows or rows), square)
    name = given.out.name.removesuffix(".yaml").removesuffix(".pdf").removesuffix(".svg")
    drawing, scene = (given.out.with_name(f"{name}.{end}") for end in (given.format, "yaml"))
    check_outputs({"the print": drawing, "the scene": scene}, [])
    for path in (drawing, scene):
        check_file(path, force=given.force)
    paper = given.paper or smallest_paper(design)
    if paper == "exact":
        paper = None
    page = own_page(design) if paper is None else paper_for(design, paper, square=square)
    # about half of an image of 45 deg
    distance = given.distance or 2.0 * max(design.size)
    text = scene_text(design, name=given.name, ink=given.ink, paper=given.white, distance=distance)
    print_board(design, drawing, page=page, paper=paper)
    write_whole(scene, lambda file: file.write(text.encode()))
    if not given.quiet:
        size = f"a page of {page[0] * 1000:.0f} x {page[1] * 1000:.0f} mm"
        where = size if paper is None else paper_words(paper)
        print(
            f"{design.words}, {design.size[0] * 1000:.0f} x {design.size[1] * 1000:.0f} mm with its margin, "
            f"for {where}\n{_reach(design, square, given.paper)}\nwritten: {drawing}, {scene}\n"
            f"print on {where} at 100 %, measure the ruler, glue it to something flat"
        )
    return 0


def _design(given: argparse.Namespace, shape: tuple[int, int], square: float) -> tuple[BoardDesign, float]:
    """Return the board of ``shape`` columns and rows, and the side [m] of its squares.

    The side is the requested one, else the largest that fits the requested paper, else ``square``.
    """

    def made(side: float) -> BoardDesign:
        return design_board(
            given.kind,
            columns=shape[0],
            rows=shape[1],
            square=side,
            greys=given.greys,
            dictionary=given.dictionary,
        )

    design = made(given.square or square)
    if given.square is not None or given.paper in (None, "exact"):
        return design, given.square or square
    largest = fitting_square(design, given.paper, square=square)
    return made(largest), largest


def _reach(design: BoardDesign, square: float, asked: str | None) -> str:
    """Return how far away the board is found, and squares that fit A4 where no paper was requested."""

    def distance(side: float) -> str:
        return f"about {_FOCAL * design.cell * side / square / _LEAST_PIXELS[design.kind]:.2g} m"

    text = f"found up to {distance(square)} away with a focal length of {_FOCAL:.0f} px (SR-3000)"
    smaller = fitting_square(design, "a4", square=square)
    if asked in (None, "exact") and SIDES[0] <= smaller < square:
        of_none = "" if smallest_paper(design) else "it fits no usual paper; "
        text += f"; {of_none}A4 would take --square {smaller:g}, up to {distance(smaller)}"
    return text
