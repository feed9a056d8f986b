"""What the shell offers after the first letters, through argcomplete's own protocol."""

from __future__ import annotations

# ruff: noqa: E501 -- one line a case
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("argcomplete")

_SEPARATOR = "\013"


def completions(line: str, cwd: Path) -> list[str]:
    """Return what is offered for a command line with the cursor at its end."""
    environment = os.environ | {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": _SEPARATOR,
        "_ARGCOMPLETE_STDOUT_FILENAME": str(cwd / "offered"),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
    }
    (cwd / "offered").touch()
    command = [sys.executable, "-m", "rim_camera_ros.cli"]
    done = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return sorted(one.strip() for one in (cwd / "offered").read_text().split(_SEPARATOR) if one.strip())


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("rim ca", ["calibrate", "camera"]),
        ("rim diag", ["diagnose"]),
        ("rim correct --min", ["--minimum-amplitude"]),
        ("rim correct bag --camera sr", ["sr2", "sr3000", "sr3000_every_effect", "sr3000_with_second_camera"]),
        ("rim correct bag --camera mi", ["mine.yaml"]),
        ("rim simulate walk", ["walking_people"]),
        ("rim correct bag --without scattering,emi", ["scattering,emission_pattern", "scattering,emitter_offset"]),
        ("rim calibrate --effects sca", ["scattering"]),
        ("rim correct bag --topic dis", ["distance="]),
        ("rim info us", ["usb"]),
        ("rim correct bag --camera nothing", []),
    ],
)  # fmt: skip
def test_completions(tmp_path: Path, line: str, offered: list[str]) -> None:
    (tmp_path / "mine.yaml").touch()
    (tmp_path / "mine.txt").touch()
    assert completions(line, tmp_path) == offered
