"""What `colcon build` installs from this source tree, as users with a ROS workspace get it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("colcon_core")

NAME = "rim_camera_ros"
ROOT = Path(__file__).resolve().parents[1]
EXECUTABLES = ("camera_node", "driver_node", "correction_node", "calibration_node", "people_node", "rim")
SHARED = ("launch", "config", "calibration")

pytestmark = pytest.mark.timeout(180)


def files(folder: Path) -> dict[str, bytes]:
    """Contents of all files below the folder by relative path, without hidden ones and byte code."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }


def sources(folder: Path) -> list[str]:
    """Files below the folder without what is compiled."""
    return [name for name in files(folder) if not name.endswith(".so")]


def run(*command: str | Path, cwd: Path) -> str:
    environment = {
        **os.environ,
        "COLCON_HOME": str(cwd / "colcon_home"),  # not the developer's own defaults
        "AMENT_PREFIX_PATH": sys.prefix,
    }
    environment.pop("PYTHONPATH", None)
    done = subprocess.run(
        command,
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def build(workspace: Path, *options: str) -> Path:
    """Build a copy of this package in the workspace."""
    ignored = shutil.ignore_patterns(".*", "__pycache__", "*.so", "*.egg-info", "build", "install", "log")
    shutil.copytree(ROOT, workspace / "src" / NAME, ignore=ignored)
    # by module, so that the colcon of this environment runs, activated or not
    call = "import sys; from colcon_core.command import main; sys.exit(main())"
    run(sys.executable, "-c", call, "--log-base", "log", "build", *options, cwd=workspace)
    return workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("workspace"))


@pytest.fixture(scope="module")
def prefix(workspace: Path) -> Path:
    return workspace / "install" / NAME


def in_workspace(workspace: Path, command: str) -> str:
    """Output of a shell command after sourcing the workspace as a user does."""
    return run("bash", "-c", f". install/local_setup.bash && {command}", cwd=workspace)


@pytest.mark.parametrize("executable", EXECUTABLES)
def test_ros2_run_finds_the_executable(prefix: Path, executable: str) -> None:
    path = prefix / "lib" / NAME / executable
    assert path.is_file()
    assert os.access(path, os.X_OK)


def test_package_is_in_the_ament_index(prefix: Path) -> None:
    assert (prefix / "share/ament_index/resource_index/packages" / NAME).is_file()
    assert (prefix / "share" / NAME / "package.xml").read_bytes() == (ROOT / "package.xml").read_bytes()


@pytest.mark.parametrize("folder", SHARED)
def test_every_file_is_shared(prefix: Path, folder: str) -> None:
    expected = files(ROOT / folder)
    assert expected, f"{folder}/ is empty"
    assert files(prefix / "share" / NAME / folder) == expected


def test_every_module_is_installed(prefix: Path) -> None:
    """A subpackage without __init__.py or a data file that package_data misses would not be installed."""
    (installed,) = prefix.glob(f"lib/python3*/site-packages/{NAME}")
    assert sorted(sources(installed)) == sorted(sources(ROOT / NAME))


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_compiled_kernels_are_installed(workspace: Path) -> None:
    code = f"from {NAME}.pipeline import kernels; print(kernels.LIBRARY is not None)"
    assert in_workspace(workspace, f"{sys.executable} -c '{code}'").strip() == "True"


def test_imports_come_from_the_workspace(workspace: Path, prefix: Path) -> None:
    where = in_workspace(workspace, f"{sys.executable} -c 'import {NAME}; print({NAME}.__file__)'")
    assert Path(where.strip()).is_relative_to(prefix)


def test_sourcing_puts_rim_on_the_path(workspace: Path, prefix: Path) -> None:
    shown = in_workspace(workspace, "cd / && command -v rim && rim --help")
    assert shown.startswith(f"{prefix}/bin/rim\n")
    assert "usage: rim" in shown
    assert "usage: rim" in in_workspace(workspace, f"{prefix}/lib/{NAME}/rim --help")  # ros2 run


@pytest.mark.long
def test_symlink_install_runs_from_the_source(tmp_path: Path) -> None:
    workspace = build(tmp_path, "--symlink-install")
    for executable in EXECUTABLES:
        assert (workspace / "install" / NAME / "lib" / NAME / executable).is_file()
    assert "usage: rim" in in_workspace(workspace, "rim --help")
    where = in_workspace(workspace, f"{sys.executable} -c 'import {NAME}; print({NAME}.__file__)'")
    assert Path(where.strip()).resolve() == workspace / "src" / NAME / NAME / "__init__.py"
    assert files(workspace / "install" / NAME / "share" / NAME / "config") == files(ROOT / "config")
