"""Interruption and faults of the program itself: exit status, one line, nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.cli import main
from rim_camera_ros.pipeline import simulate

from .helpers_cli import CAMERA, SCENE, nothing_left, process, run, write_text

Capture = pytest.CaptureFixture[str]
FAULT = "this is a fault of the program: please report it"


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Put the signal handlers back: after an interruption `main` leaves the signals ignored."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def endless(tmp_path: Path) -> list[str | Path]:
    """Arguments of a simulation that does not end by itself; it writes into the folder work."""
    (tmp_path / "work").mkdir()
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    out = tmp_path / "work" / "bag"
    return ["simulate", scene, "--camera", camera, "--frames", "100000000", "--out", out]


def wait_for_output(running: subprocess.Popen[str], folder: Path) -> None:
    """Wait until the process writes messages."""
    end = time.monotonic() + 60
    while not any(one.stat().st_size for one in folder.rglob("*.mcap")):
        assert running.poll() is None, running.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.mark.parametrize("seed", range(4))
def test_many_interruptions(tmp_path: Path, endless: list[str | Path], seed: int) -> None:
    """Ctrl-C again and again, at any time of the clearing up."""
    rng = np.random.default_rng(seed)
    with nothing_left(tmp_path / "work"):
        running = process(*endless)
        wait_for_output(running, tmp_path / "work")
        while running.poll() is None:
            running.send_signal(signal.SIGINT)
            time.sleep(float(rng.uniform(0, 2e-3)))
        out, err = running.communicate(timeout=30)
        assert (running.returncode, out, err) == (130, "", "rim: interrupted\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_endings(tmp_path: Path, endless: list[str | Path], number: signal.Signals) -> None:
    """A closed terminal or a shutdown leaves no half recording either."""
    with nothing_left(tmp_path / "work"):
        running = process(*endless)
        wait_for_output(running, tmp_path / "work")
        running.send_signal(number)
        _, err = running.communicate(timeout=30)
        assert (running.returncode, err) == (130, "rim: interrupted\n")


def test_ignored_signals_stay_ignored(tmp_path: Path, endless: list[str | Path]) -> None:
    """As under nohup."""

    def ignore() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    with nothing_left(tmp_path / "work"):
        running = process(*endless, preexec_fn=ignore)
        wait_for_output(running, tmp_path / "work")
        running.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=30)
        assert running.returncode == 130


def raising(error: BaseException) -> Any:
    def replacement(*_: Any, **__: Any) -> Any:
        raise error

    return replacement


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ZeroDivisionError("two\nlines"), 1, f"rim: ZeroDivisionError: two lines ({FAULT})"),
        (MemoryError(), 1, "rim: out of memory"),
        (
            ModuleNotFoundError("No module named 'cv2.x'", name="cv2.x"),
            1,
            "rim: the Python module 'cv2.x' is not installed (install what the package needs: "
            f"{sys.executable} -m pip install '<its folder>[diagnosis]')",
        ),
        (
            ModuleNotFoundError("No module named 'rim_camera_ros.x'", name="rim_camera_ros.x"),
            1,
            f"rim: ModuleNotFoundError: No module named 'rim_camera_ros.x' ({FAULT})",
        ),
        (KeyboardInterrupt(), 130, "rim: interrupted"),
    ],
)  # fmt: skip
def test_exceptions(
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    error: BaseException,
    status: int,
    line: str,
) -> None:
    monkeypatch.delenv("RIM_TRACEBACK", raising=False)
    monkeypatch.setattr(simulate.Simulation, "frame", raising(error))
    with nothing_left(tmp_path):
        found = run(capsys, "simulate", "wall", "--camera", "pmd3ks", "--out", tmp_path / "bag")
    assert found == (status, "", f"{line}\n")


def test_the_traceback_on_request(capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RIM_TRACEBACK", "1")
    status, _, err = run(capsys, "simulate", "wall", "--camera", "sr300", "--out", tmp_path / "bag")
    assert status == 2
    assert "Traceback" in err
    assert "find_camera" in err
    assert err.splitlines()[-1].startswith("rim: sr300: ")


def test_handlers_are_put_back(capsys: Capture) -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert main(["info", "sr2"]) == 0
    assert signal.getsignal(signal.SIGTERM) is before
    capsys.readouterr()


def test_a_reader_that_goes_away_at_once() -> None:
    """As in ``rim info board --json | true``, with more output than a pipe holds."""
    command = f"{sys.executable} -m rim_camera_ros.cli info track_line --json | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False, env=dict(os.environ)
    )
    assert (done.returncode, done.stderr) == (0, "")
