"""``rim compare``: where and by how much two camera files differ."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rim_camera_ros.commands.common import add_command, camera_of, check_file, check_outputs
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.yaml_files import write_whole

_EXAMPLES = """
rim compare before.yaml after.yaml
rim compare sr3000 mine.yaml --out compared.html     # with pictures
rim compare a.yaml b.yaml --json
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "compare",
        "Say where and by how much two camera files differ. Corrected distances of a wall over the image and "
        "the distance, the share of each effect in it, rays, and every number that differs.",
        _EXAMPLES,
    )
    parser.add_argument("one", metavar="A", help="camera file, or the name of a shipped one")
    parser.add_argument("other", metavar="B", help="camera file that is compared with it")
    parser.add_argument("--out", type=Path, metavar="FILE", help="page with pictures to write (.html)")
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument("--quiet", action="store_true", help="no table")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Compare, print, and write the page."""
    files = [find_camera(given.one), find_camera(given.other)]
    if given.out is not None:
        if given.out.suffix not in (".html", ".htm"):
            raise InputError(
                "a page ends in .html", file=given.out, place="--out", remedy=f"give {given.out}.html"
            )
        check_outputs({"--out": given.out}, files)
        check_file(given.out, force=given.force)
    cameras = [camera_of(given.one), camera_of(given.other)]
    from rim_camera_ros.reports.comparison import compare, comparison_json, comparison_text

    names = (given.one, given.other)
    try:
        found = compare(*cameras)
    except InputError as error:
        raise error.located(files[1]) from None
    if given.out is not None:
        try:
            from rim_camera_ros.reports.comparison_page import comparison_page

            page = comparison_page(found, names=names).encode()
        except ImportError as error:
            remedy = "pip install 'rim_camera_ros[reports]', or apt install python3-matplotlib"
            raise InputError(f"no page can be drawn: {error}", remedy=remedy) from None
        write_whole(given.out, lambda stream: stream.write(page))
    if given.json:
        print(json.dumps(comparison_json(found, names), indent=1, allow_nan=False))
    elif not given.quiet:
        print(comparison_text(found, names))
    return 0
