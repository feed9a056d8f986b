"""``rim reproduce``: the thesis' experiments simulated and reduced, compared with its numbers."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

from rim_camera_ros.commands.common import Stages, add_command, check_file, check_outputs
from rim_camera_ros.commands.output_folder import OutputFolder
from rim_camera_ros.errors import InputError
from rim_camera_ros.yaml_files import write_whole

if TYPE_CHECKING:
    from rim_camera_ros.reproduce.run import Done

_EXAMPLES = """
rim reproduce
rim reproduce --out reproduction
rim reproduce --only grey_wedge incidence --json
rim reproduce --out docs/reproduction --page docs/reproduction.md --force
"""
#: Files of an earlier run, which `--force` replaces.
_REPORT, _INDEX = "reproduction.json", "index.html"


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "reproduce",
        "Repeat the measurements of the thesis. Simulates its experiments with the shipped cameras, reduces "
        "them as the thesis did, and prints its numbers, ours and the deviations (about two minutes).",
        _EXAMPLES,
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the page with pictures")
    parser.add_argument("--page", type=Path, metavar="FILE", help="Markdown page, with the pictures of --out")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="run these experiments only")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument("--quiet", action="store_true", help="no progress and no table")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Reproduce, write, and print the table."""
    _check(given)
    try:
        from rim_camera_ros.reproduce.report import json_report, text_report
        from rim_camera_ros.reproduce.run import chosen, reproduce
    except ImportError as error:
        if error.name is None or not error.name.startswith("matplotlib"):
            raise
        remedy = "pip install 'rim_camera_ros[reports]', or apt install python3-matplotlib"
        raise InputError("matplotlib is not installed", remedy=remedy) from None
    experiments = chosen(given.only)
    with Stages(quiet=given.quiet) as stages:
        done = reproduce(experiments, progress=stages.show)
        if given.out is not None:
            stages.show("pictures")
            _write_folder(done, given.out)
    if given.page is not None:
        _write_page(done, given)
    if given.json:
        print(json.dumps(json_report(done), indent=1, allow_nan=False))
    elif not given.quiet:
        print(text_report(done))
    return 0


def _check(given: argparse.Namespace) -> None:
    """Check the options before any work."""
    if given.page is not None and given.out is None:
        raise InputError("--page needs --out, the folder of its pictures")
    if given.page is not None and given.page.suffix != ".md":
        raise InputError("a Markdown page ends in .md", file=given.page, place="--page")
    check_outputs({"--out": given.out, "--page": given.page}, [])
    check_file(given.page, force=given.force)
    if given.out is not None:
        _folder(given.out).check(force=given.force)


def _folder(path: Path) -> OutputFolder:
    return OutputFolder(path, own={_REPORT, _INDEX}, of="a reproduction", mark=_REPORT)


def _write_folder(done: Sequence[Done], folder: Path) -> None:
    """Write pictures, page and rows into a new folder first: the old one stays until all is written."""
    from rim_camera_ros.reproduce.pictures import png
    from rim_camera_ros.reproduce.report import file_name, html_page, json_report

    with _folder(folder).written() as temporary:
        for figure in done:
            for picture in figure.outcome.pictures:
                (temporary / file_name(picture)).write_bytes(png(picture))
        (temporary / _INDEX).write_text(html_page(done), encoding="utf-8")
        report = json.dumps(json_report(done), indent=1, allow_nan=False) + "\n"
        (temporary / _REPORT).write_text(report, encoding="utf-8")


def _write_page(done: Sequence[Done], given: argparse.Namespace) -> None:
    from rim_camera_ros.reproduce.report import markdown_page

    folder = PurePath(os.path.relpath(given.out, given.page.absolute().parent))
    command = f"rim reproduce --out {given.out.as_posix()} --page {given.page.as_posix()} --force"
    if given.only:
        command += f" --only {' '.join(given.only)}"
    content = markdown_page(done, folder, command).encode()
    write_whole(given.page, lambda stream: stream.write(content))
