from __future__ import annotations

from pathlib import Path

from rim_camera_ros.diagnose.run import Diagnosis


def write_page(result: Diagnosis, folder: Path, *, recording: str, camera: str, scene: str) -> None:
    return None
