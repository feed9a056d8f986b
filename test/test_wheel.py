"""What `pip install .` gives in an empty environment: a wheel, and a `rim` that works without ROS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: The libraries are fetched from the package index: some 150 MB.
LIMIT = 1500

pytestmark = [pytest.mark.slow, pytest.mark.timeout(LIMIT + 100)]


def call(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command without what the environment of these tests would lend it."""
    lent = ("PYTHON", "VIRTUAL_ENV", "AMENT_", "ROS_")
    own = {name: value for name, value in os.environ.items() if not name.startswith(lent)}
    own |= {"PIP_CACHE_DIR": str(cwd / "cache"), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    return subprocess.run(
        [str(one) for one in command],
        cwd=cwd,
        env=own,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel of this tree and what it requires, in a folder of its own."""
    folder = tmp_path_factory.mktemp("wheel")
    ignored = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "install", "log", "test")
    shutil.copytree(ROOT, folder / "source", ignore=ignored)
    venv.create(folder / "env", with_pip=True)
    python = folder / "env" / "bin" / "python"
    built = call(
        python, "-m", "pip", "wheel", "--no-deps", "-w", folder / "wheels", folder / "source", cwd=folder
    )
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = (folder / "wheels").glob("rim_camera_ros-*.whl")
    done = call(python, "-m", "pip", "install", "--only-binary", ":all:", wheel, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def rim(environment: Path, *words: str | Path) -> str:
    done = call(environment / "env" / "bin" / "rim", *words, cwd=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def test_the_wheel_holds_what_the_program_reads(environment: Path) -> None:
    (wheel,) = (environment / "wheels").glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    package = (path for path in (ROOT / "rim_camera_ros").rglob("*") if path.is_file())
    wanted = {path.relative_to(ROOT).as_posix() for path in package if "__pycache__" not in path.parts}
    assert wanted <= set(names)
    shared = {Path(name).name for name in names if ".data/data/share/rim_camera_ros/calibration/" in name}
    own = {path.name for path in (ROOT / "calibration").rglob("*") if path.is_file() and path.name[0] != "."}
    assert own <= shared
    assert not [name for name in names if name.startswith("test/")]


def test_rim_simulates_and_corrects(environment: Path) -> None:
    assert sys.version_info[:2] >= (3, 12)
    output = rim(environment, "info", "sr3000")
    assert "SR-3000" in output
    assert "176 x 144" in output
    rim(environment, "simulate", "wall", "--camera", "sr3000", "--frames", "3", "--out", "bag")
    assert "3 frames" in rim(environment, "info", "bag")
    rim(environment, "correct", "bag", "--camera", "sr3000", "--out", "corrected", "--ply", "cloud.ply")
    head = (environment / "cloud.ply").read_bytes()[:400].decode("ascii", "replace")
    assert head.startswith("ply\n")
    assert "element vertex " in head
    # nothing of ROS is there, and nothing of this checkout
    where = call(
        environment / "env" / "bin" / "python",
        "-c",
        "import importlib.util as u, rim_camera_ros; "
        "print(rim_camera_ros.__file__, u.find_spec('rclpy'), u.find_spec('pytest'))",
        cwd=environment,
    ).stdout.split()
    assert Path(where[0]).is_relative_to(environment / "env")
    assert where[1:] == ["None", "None"]
