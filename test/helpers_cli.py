"""Running ``rim`` in this process and as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.cli import main
from rim_camera_ros.frame import Intrinsics, RawFrame, Settings

CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 12, height: 9, pixel_pitch: [40.0e-6, 40.0e-6], modulation_frequency: 20.0e6}
optics: {fx: 14.0, fy: 15.0, cx: 5.3, cy: 4.1}
noise: {floor: 0.004, shot: 0.0, amplitude: 20.0}
"""

SCENE = """
format: rim_scene/1
surfaces:
- {name: wall, type: plane, pose: {position: [0, 0, 2.5]}, reflectivity: 0.7}
"""


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Return status, standard output and standard error of ``rim`` in this process."""
    status = main([str(one) for one in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def process(*arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """Start ``rim`` as a process, which hears Ctrl-C and the end of a terminal also where tests do not.

    A shell in the background ignores the first, nohup the second.
    """
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)
    command = [sys.executable, "-m", "rim_camera_ros.cli", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": dict(os.environ)}
    return subprocess.Popen(command, text=True, **(pipes | options))


def write_text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def raw_frame(stamp: int, shape: tuple[int, int] = (9, 12), **settings: Any) -> RawFrame:
    """A frame of asymmetric values."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return RawFrame(
        stamp=stamp,
        distance=(20000 + 37 * u + 11 * v).astype(np.uint16),
        amplitude=(900 + 5 * u + 3 * v).astype(np.uint16),
        settings=Settings(
            **{"integration_time": 60.0, "modulation_frequency": 20e6, "uptime": 400.0} | settings
        ),
        intrinsics=Intrinsics(width=shape[1], height=shape[0], fx=14.0, fy=15.0, cx=5.3, cy=4.1),
        device="test",
    )


def write_bag(path: Path, frames: list[RawFrame]) -> Path:
    with RecordingWriter(path) as writer:
        for frame in frames:
            writer.write_raw(frame)
    return path


@contextmanager
def nothing_left(folder: Path) -> Iterator[None]:
    """Assert that a folder holds afterwards what it held before."""
    before = sorted(str(one) for one in folder.rglob("*"))
    yield
    assert sorted(str(one) for one in folder.rglob("*")) == before
