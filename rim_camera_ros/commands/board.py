"""``rim board``: a printable target and its scene file."""

from __future__ import annotations

import argparse
from pathlib import Path

from rim_camera_ros.commands.common import add_command, add_output, check_file, check_outputs, positive
from rim_camera_ros.errors import InputError
from rim_camera_ros.photogrammetry.board_design import DICTIONARIES, KINDS, design_board
from rim_camera_ros.photogrammetry.board_print import PAPERS, paper_for, print_board, scene_text
from rim_camera_ros.yaml_files import write_whole

_EXAMPLES = """
rim board checkerboard --out board                         # 8 x 5 squares of 30 mm: board.pdf, board.yaml
rim board charuco --columns 7 --rows 5 --square 0.05 --paper a2 --out charuco
rim board apriltag --columns 4 --rows 3 --square 0.06 --paper a3 --out tags
rim board circles --out circles --format svg
"""
#: Columns, rows and side [m] of each kind, for paper of A4 or A3.
_DEFAULTS = {
    "checkerboard": (8, 5, 0.03),
    "charuco": (6, 4, 0.04),
    "apriltag": (4, 3, 0.045),
    "circles": (7, 4, 0.03),
}


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
        "--paper", choices=[*PAPERS, "exact"], default="exact", help="page (exact: the board's own)"
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
    design = design_board(
        given.kind,
        columns=given.columns or columns,
        rows=given.rows or rows,
        square=given.square or square,
        greys=given.greys,
        dictionary=given.dictionary,
    )
    name = given.out.name.removesuffix(".yaml").removesuffix(".pdf").removesuffix(".svg")
    drawing, scene = (given.out.with_name(f"{name}.{end}") for end in (given.format, "yaml"))
    check_outputs({"the print": drawing, "the scene": scene}, [])
    for path in (drawing, scene):
        check_file(path, force=given.force)
    page = paper_for(design, None if given.paper == "exact" else given.paper)
    # about half of an image of 45 deg
    distance = given.distance or 2.0 * max(design.size)
    text = scene_text(design, name=given.name, ink=given.ink, paper=given.white, distance=distance)
    print_board(design, drawing, page=page)
    write_whole(scene, lambda file: file.write(text.encode()))
    if not given.quiet:
        print(
            f"{design.words}, {design.size[0] * 1000:.0f} x {design.size[1] * 1000:.0f} mm with its margin, "
            f"on a page of {page[0] * 1000:.0f} x {page[1] * 1000:.0f} mm\nwritten: {drawing}, {scene}\n"
            "print at 100 %, measure the ruler, glue it to something flat"
        )
    return 0
