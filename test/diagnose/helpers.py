"""A small camera with a cyclic error before a wall that moves, as files."""

from __future__ import annotations

from typing import Any

import numpy as np

from rim_camera_ros.cli import main

CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 24, height: 20, pixel_pitch: [160.0e-6, 160.0e-6], modulation_frequency: 20.0e6}
optics: {fx: 30.0, fy: 30.0, cx: 11.7, cy: 9.2}
radiometry: {gain: 200.0}
noise: {floor: 0.003, shot: 0.0, amplitude: 4.0}
"""
CYCLIC = "effects: {cyclic_error: {harmonics: [{order: 4, amplitude: 0.009, phase: 0.7}]}}\n"
#: c / (2 f) of 20 MHz.
AMBIGUITY = 299_792_458 / 40e6
DISTANCES = np.linspace(0.9, 4.3, 18)


def scene_text() -> str:
    """A wall at 18 distances, turned a little, its schedule as in formats.md."""
    lines = [
        "format: rim_scene/1",
        "surfaces:",
        "- {name: wall, type: plane, pose: truth, pose_sigma: [0.0005, 0.0003], reflectivity: 0.7}",
        "schedule:",
    ]
    for i, z in enumerate(DISTANCES):
        half = 0.08 * np.sin(1.7 * i)
        orientation = [0.0, float(np.sin(half)), 0.0, float(np.cos(half))]
        pose = f"{{position: [0.0, 0.0, {z:.4f}], orientation: {[round(x, 9) for x in orientation]}}}"
        lines.append(
            f"- {{frames: 4, rate: 5, integration_time: 60, uptime: {1000 + 7 * i}, ambient: 20.0, "
            f"poses: {{wall: {pose}}}}}"
        )
    return "\n".join(lines) + "\n"


def run(*words: Any, **options: Any) -> None:
    """Run a command, which must succeed; ``options`` by their names without dashes."""
    given = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert main([*map(str, (*words, *given)), "--quiet"]) == 0
