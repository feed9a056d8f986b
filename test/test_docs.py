"""The pages of the effects are those of the classes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_effect_pages_are_up_to_date() -> None:
    tool = ROOT / "docs" / "tools" / "effect_pages.py"
    done = subprocess.run(
        [sys.executable, str(tool), "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}\nrun {tool.relative_to(ROOT)}"
