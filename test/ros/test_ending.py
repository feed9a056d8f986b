"""A process ends in time although a library keeps the interpreter's lock for ever."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from test.ros.harness import World

# PyDLL keeps the interpreter's lock during the call, as rclpy does as it destroys a node
STUCK = """
import ctypes
from rim_camera_ros.nodes.common.ending import end_within
end_within(0.3, status={status})
ctypes.PyDLL(None).pause()
"""


@pytest.mark.parametrize("status", [0, 7])
def test_ends_with_its_status_while_the_lock_is_held(status: int) -> None:
    done = subprocess.run([sys.executable, "-c", STUCK.format(status=status)], timeout=30.0, check=False)
    assert done.returncode == status


def test_a_process_that_ends_by_itself_keeps_its_status() -> None:
    text = "from rim_camera_ros.nodes.common.ending import end_within; end_within(20.0, status=7)"
    assert subprocess.run([sys.executable, "-c", text], timeout=15.0, check=False).returncode == 0


def test_a_node_that_the_middleware_does_not_let_go_ends_with_its_status(
    world: World, tmp_path: Path
) -> None:
    """The time that it has is half a second here."""
    script = tmp_path / "stuck.py"
    script.write_text(
        "import ctypes, sys\n"
        "import rclpy\n"
        "from rim_camera_ros.nodes.common import run\n"
        "class Stuck:\n"
        "    status = 3\n"
        "    def __init__(self):\n"
        "        self.node = rclpy.create_node('stuck')\n"
        "        self.node.destroy_node = lambda: ctypes.PyDLL(None).pause()\n"
        "    def close(self):\n"
        "        print('closed')\n"
        "run._ENDING = 0.5\n"
        "sys.exit(run.run('stuck', lambda: [Stuck()]))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        env=world.environment,
        timeout=30.0,
        check=False,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert (done.returncode, done.stdout) == (3, "closed\n")
