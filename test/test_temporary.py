"""Outputs of several runs, and what killed ones leave behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode

from rim_camera_ros import temporary
from rim_camera_ros.bags import Recording
from rim_camera_ros.commands.output_folder import OutputFolder
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.temporary import claimed, clear, temporary_file, temporary_folder
from rim_camera_ros.yaml_files import write_whole

from .helpers_bags import pair
from .helpers_bags import write_bag as write_compressed
from .helpers_cli import CAMERA, SCENE, process, run, write_text

_HOLD = """
import sys, time
from pathlib import Path
from rim_camera_ros.temporary import claimed, temporary_file, temporary_folder
folder = Path(sys.argv[1])
(temporary_folder(folder, "out.yaml").path / "array.npy").write_bytes(b"x")
temporary_file(folder, "out.yaml")
with claimed(folder / "out.yaml"):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds a hidden file, a hidden folder and the claim of out.yaml."""
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as one:
        assert one.stdout is not None
        assert one.stdout.readline() == "held\n"
        yield one
        one.kill()


def names(folder: Path) -> list[str]:
    return sorted(one.name for one in folder.iterdir())


def test_what_a_living_process_holds_stays_and_what_a_killed_one_left_goes(
    holder: subprocess.Popen[str], tmp_path: Path
) -> None:
    # like ours, but of nobody's making
    (tmp_path / ".out.yaml.rim-notes").write_text("mine")
    (tmp_path / ".out.yaml.12345678").write_text("mine")
    (tmp_path / ".link.rim-12345678").symlink_to(tmp_path / ".out.yaml.12345678")
    foreign = [".link.rim-12345678", ".out.yaml.12345678", ".out.yaml.rim-notes"]
    clear(tmp_path)
    assert len(names(tmp_path)) == 6
    with pytest.raises(InputError, match=r"out\.yaml: another run is writing it \(wait until it ends"):
        claimed(tmp_path / "out.yaml").__enter__()
    with claimed(tmp_path / "other.yaml"):
        pass
    holder.kill()
    holder.wait()
    assert len(names(tmp_path)) == 6
    write_whole(tmp_path / "new.yaml", lambda stream: stream.write(b"a"))
    assert names(tmp_path) == [*foreign, "new.yaml"]
    with claimed(tmp_path / "out.yaml"):
        assert names(tmp_path) == [*foreign[:2], ".out.yaml.rim-claim", foreign[2], "new.yaml"]
    assert names(tmp_path) == [*foreign, "new.yaml"]


def test_two_runs_to_one_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second is refused before its work, whichever command it is; after the first it may write."""
    camera, scene = write_text(tmp_path / "camera.yaml", CAMERA), write_text(tmp_path / "scene.yaml", SCENE)
    out = tmp_path / "bag"
    arguments = ("simulate", scene, "--camera", camera, "--out", out, "--force", "--quiet")
    with process(*arguments, "--frames", "100000000") as first:
        deadline = time.monotonic() + 60
        while not any(tmp_path.glob(".bag.rim-*/bag/*.mcap")) and time.monotonic() < deadline:
            assert first.poll() is None, first.communicate()[1]
            time.sleep(0.01)
        status, printed, error = run(capsys, *arguments, "--frames", "2")
        assert (status, printed) == (2, "")
        assert error == f"rim: {out}: another run is writing it (wait until it ends, or give another name)\n"
        status, _, error = run(
            capsys, "diagnose", tmp_path, "--camera", camera, "--scene", scene, "--out", out
        )
        assert "another run is writing it" in error or "lies in" in error
        first.send_signal(signal.SIGKILL)
    assert len([one for one in names(tmp_path) if one.startswith(".")]) == 2
    assert run(capsys, *arguments, "--frames", "2")[0] == 0
    assert names(tmp_path) == ["bag", "camera.yaml", "scene.yaml"]


def test_unpacked_recordings_of_killed_runs_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    lines = [line for i in range(3) for line in pair(i)]
    bag = write_compressed(tmp_path / "bag", lines, compression=CompressionMode.FILE)
    script = (
        "import sys, time; from rim_camera_ros.bags import Recording; from pathlib import Path\n"
        "recording = Recording(Path(sys.argv[1])).__enter__(); frames = recording.frames(); next(frames)\n"
        "print('open', flush=True); time.sleep(600)"
    )
    environment = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
    command = [sys.executable, "-c", script, str(bag)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as killed:
        assert killed.stdout is not None
        assert killed.stdout.readline() == "open\n"
        assert len(names(tmp_path / "tmp")) == 1
        killed.kill()
    assert len(names(tmp_path / "tmp")) == 1
    with Recording(bag) as recording:
        assert len(list(recording.frames())) == 3
    assert names(tmp_path / "tmp") == []


def test_what_stood_there_is_not_lost_when_a_run_is_killed_while_it_is_replaced(tmp_path: Path) -> None:
    """Between the two moves the old one lies in the hidden folder alone."""
    target = tmp_path / "out"
    target.mkdir()
    (target / "old").write_text("old")
    work = temporary_folder(tmp_path, "out")
    (work.path / "new").mkdir()
    target.rename(work.path / "replaced")
    os.close(work.lock)  # as the system does of a killed process
    clear(tmp_path)
    assert (work.path / "replaced" / "old").read_text() == "old"
    # and where it stands again the rest goes
    (work.path / "replaced").rename(target)
    clear(tmp_path)
    assert names(tmp_path) == ["out"]


def test_a_folder_that_cannot_be_put_in_place_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "report.json").write_text("old")
    folder = OutputFolder(target, own={"report.json"}, of="a report", mark="report.json")
    rename = Path.rename

    def fail(self: Path, other: Path) -> Path:
        if self.name == "new":
            raise OSError(28, "No space left on device")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError, match="No space left"), folder.written() as new:
        (new / "report.json").write_text("new")
    assert names(tmp_path) == ["out"]
    assert (target / "report.json").read_text() == "old"


def test_clearing_and_writing_at_once(tmp_path: Path) -> None:
    """Whoever clears may come between the making of a file and its lock; no write may fail of it."""
    stop = threading.Event()

    def sweep() -> None:
        while not stop.is_set():
            clear(tmp_path)

    def write(number: int) -> None:
        for i in range(60):
            content = f"{number} {i}".encode()
            write_whole(tmp_path / f"{number}.txt", lambda stream, content=content: stream.write(content))
            assert (tmp_path / f"{number}.txt").read_bytes() == content

    with ThreadPoolExecutor(6) as pool:
        sweeps = [pool.submit(sweep) for _ in range(2)]
        for one in [pool.submit(write, number) for number in range(4)]:
            one.result()
        stop.set()
        for one in sweeps:
            one.result()
    assert names(tmp_path) == ["0.txt", "1.txt", "2.txt", "3.txt"]


def test_without_locks_nothing_is_removed_and_everything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".a.rim-12345678").write_text("of another machine")

    def flock(handle: int, operation: int) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(temporary.fcntl, "flock", flock)
    with claimed(tmp_path / "a"):
        write_whole(tmp_path / "a", lambda stream: np.save(stream, np.arange(3)))
    assert names(tmp_path) == [".a.rim-12345678", "a"]


def test_long_names(tmp_path: Path) -> None:
    name = "ü" * 120 + ".yaml"
    with claimed(tmp_path / name):
        write_whole(tmp_path / name, lambda stream: stream.write(b"x"))
    assert names(tmp_path) == [name]


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    def fail(stream: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(RimError, match="out: cannot be written: No space left on device"):
        write_whole(tmp_path / "out", fail)
    one = temporary_file(tmp_path, "other")
    assert len(names(tmp_path)) == 1
    one.close()
    assert names(tmp_path) == []
