"""Ctrl-C in the first second: whatever is being imported, one line at most and the documented exit status."""

from __future__ import annotations

import ast
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rim_camera_ros import interruption
from rim_camera_ros.cli import COMMANDS
from rim_camera_ros.interruption import PROGRAMS, program

ROOT = Path(__file__).resolve().parents[1]
NODES = sorted(name for name in PROGRAMS if name.endswith("_node"))
#: Seconds after the package has begun to be imported.
MOMENTS = (0.0, 0.1, 0.35, 0.8)


@pytest.fixture(autouse=True)
def _hear_signals() -> Iterator[None]:
    """Children inherit what is ignored: SIGINT by a shell in the background, SIGHUP by nohup."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)}
    for number, handler in before.items():
        if handler == signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal, by what the kernel says."""
    status = Path(f"/proc/{pid}/status").read_text()
    found = re.search(r"^SigCgt:\s*([0-9a-f]+)$", status, re.MULTILINE)
    assert found
    return bool(int(found[1], 16) >> (number - 1) & 1)


def interrupted(*command: str, after: float, number: signal.Signals, tmp_path: Path) -> tuple[int, str]:
    """Start a program, send it a signal so long [s] after its first handler was there, twice; status, output.

    Before that the interpreter itself starts, and Ctrl-C is between it and the shell.
    """
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 101),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "log"),
    }
    output = tmp_path / "output.txt"
    with output.open("wb") as file:
        running = subprocess.Popen(
            [sys.executable, "-m", *command], env=environment, stdout=file, stderr=subprocess.STDOUT,
            cwd=tmp_path,
        )  # fmt: skip
    try:
        end = time.monotonic() + 30.0
        with contextlib.suppress(FileNotFoundError):
            while not catches(running.pid, signal.SIGTERM) and running.poll() is None:
                assert time.monotonic() < end
                time.sleep(0.001)
        with contextlib.suppress(subprocess.TimeoutExpired):
            running.wait(after)
        for _ in range(2):
            running.send_signal(number)
        return running.wait(30.0), output.read_text()
    finally:
        running.kill()
        running.wait()


def module_of(executable: str) -> str:
    """Return the module of a node, as setup.py names it."""
    found = re.search(rf"{executable} = \{{NAME\}}(\.[a-z._]+):main", (ROOT / "setup.py").read_text())
    assert found
    return f"rim_camera_ros{found[1]}"


@pytest.mark.parametrize("after", MOMENTS)
@pytest.mark.parametrize("node", NODES)
def test_a_node_ends_with_status_0_and_no_traceback(tmp_path: Path, node: str, after: float) -> None:
    pytest.importorskip("rclpy")
    number = signal.SIGINT if round(after * 100) % 2 else signal.SIGTERM
    status, text = interrupted(module_of(node), after=after, number=number, tmp_path=tmp_path)
    assert status == 0, text
    assert not re.search(r"Traceback|Exception|KeyboardInterrupt|Error|\[ERROR\]", text), text


#: Command lines that work for longer than the test waits, or end at once; none may end with a traceback.
LINES = {
    "simulate": ["simulate", "room", "--camera", "sr3000", "--frames", "100000", "--out", "bag"],
    "record": ["record", "--out", "bag"],
    "reproduce": ["reproduce"],
    "plan": ["plan", "--camera", "sr3000"],
    "info": ["info", "room", "--camera", "sr3000"],
    "compare": ["compare", "sr3000", "sr3000_every_effect"],
    "board": ["board", "checkerboard", "--out", "board"],
    **{
        name: [name, "--help"]
        for name in ("calibrate", "diagnose", "correct", "import", "camera", "poses", "optics")
    },
}


@pytest.mark.parametrize("executable", [*NODES, "rim"])
def test_while_a_library_is_imported(tmp_path: Path, executable: str) -> None:
    """Libraries that take for ever to import stand in for slow ones: the signal comes in the midst of it."""
    for library in ("numpy", "rclpy"):
        (tmp_path / f"{library}.py").write_text(
            "import time\nprint('importing', flush=True)\ntime.sleep(60)\n"
        )
    module = "rim_camera_ros.cli" if executable == "rim" else module_of(executable)
    with subprocess.Popen(
        [sys.executable, "-m", module, *(["plan", "--camera", "sr3000"] if executable == "rim" else [])],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == "importing\n"
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=30.0)
    assert (running.returncode, errors) == ((130, "rim: interrupted\n") if executable == "rim" else (0, ""))


@pytest.mark.long
@pytest.mark.parametrize("after", MOMENTS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_ends_with_status_130_and_one_line(tmp_path: Path, command: str, after: float) -> None:
    if command == "record":
        pytest.importorskip("rclpy")
    status, text = interrupted(
        "rim_camera_ros.cli", *LINES[command], after=after, number=signal.SIGINT, tmp_path=tmp_path
    )
    assert not re.search(r"Traceback|Exception ignored|KeyboardInterrupt", text), text
    if status == 130:
        assert text.splitlines()[-1:] == ["rim: interrupted"], text
        assert text.count("interrupted") == 1, text
    elif command == "record":  # Ctrl-C is how a recording ends
        assert (status, text.splitlines()[-1][:24]) == (1, "rim: no frame came on /c"), text
    else:  # it was done before
        assert status == 0, text
        assert after > 0.0
        assert "interrupted" not in text


def test_the_programs_are_those_that_are_installed() -> None:
    (call,) = [
        one
        for one in ast.walk(ast.parse((ROOT / "setup.py").read_text()))
        if isinstance(one, ast.keyword) and one.arg == "entry_points"
    ]
    installed = re.findall(r"['\"{]([a-z_]+) = ", ast.unparse(call))
    assert set(installed) == set(PROGRAMS) - {"demo"}


@pytest.mark.parametrize(
    ("command", "script", "expected"),
    [
        (["python3", "-m", "rim_camera_ros.cli", "info"], "-m", "rim"),
        (["python3", "-X", "dev", "-Wm", "-Im", "rim_camera_ros.nodes.people.node"], "-m", None),
        (["python3", "-X", "dev", "-Im", "rim_camera_ros.nodes.people.node"], "-m", "people_node"),
        (["python3", "-m", "rim_camera_ros.nodes.camera_node"], "-m", "camera_node"),
        (["python3", "-m", "rim_camera_ros.demo"], "-m", "demo"),
        (["python3", "-m", "rim_camera_ros.devices.acquisition_process", "5"], "-m", None),
        (["python3", "-m", "other.cli"], "-m", None),
        (["python3", "-m", "pytest", "rim_camera_ros.cli"], "-m", None),
        (
            ["/usr/bin/python3", "/ws/install/lib/rim_camera_ros/driver_node"],
            "/ws/lib/driver_node",
            "driver_node",
        ),
        (["python3", "/opt/lab/.venv/bin/rim", "info"], "/opt/lab/.venv/bin/rim", "rim"),
        (["python3", "analysis.py", "rim"], "analysis.py", None),
        (["python3", "-c", "import rim_camera_ros"], "-c", None),
        (["python3"], "", None),
    ],
)
def test_which_program_a_process_is(command: list[str], script: str, expected: str | None) -> None:
    assert program(command, script) == expected


def test_other_programs_that_import_the_package_keep_their_handlers() -> None:
    code = (
        "import signal; before = signal.getsignal(signal.SIGINT); import rim_camera_ros.cli;"
        "assert signal.getsignal(signal.SIGINT) is before; print('kept')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.stdout, done.returncode) == ("kept\n", 0), done.stderr


def test_what_runs_first_imports_next_to_nothing() -> None:
    tree = ast.parse(Path(interruption.__file__).read_text())
    modules = {
        name
        for one in ast.walk(tree)
        if isinstance(one, ast.Import | ast.ImportFrom)
        for name in ([one.module] if isinstance(one, ast.ImportFrom) else [alias.name for alias in one.names])
    }
    assert modules == {"__future__", "atexit", "collections.abc", "os", "signal", "sys", "types"}
