"""A process ends in time although a library keeps the interpreter's lock for ever."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

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
