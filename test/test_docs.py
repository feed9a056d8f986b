"""The pages of the effects are those of the classes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_effect_pages_are_up_to_date() -> None:
    tool = ROOT / "docs" / "tools" / "effect_pages.py"
    done = subprocess.run(
        [sys.executable, str(tool), "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}\nrun {tool.relative_to(ROOT)}"


def test_the_readme_lists_every_parameter() -> None:
    pytest.importorskip("rclpy")
    from rim_camera_ros.nodes import correction_node, driver_parameters

    readme = (ROOT / "README.md").read_text()
    for spec in (*driver_parameters.SPECS, *correction_node.SPECS):
        rows = [line for line in readme.splitlines() if line.startswith(f"| `{spec.name}` |")]
        assert any(spec.description in row for row in rows), spec.name
