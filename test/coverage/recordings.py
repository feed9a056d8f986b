"""Recordings of a board, simulated, as frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene
from test.calibrate import helpers

CYCLIC = CyclicError(harmonics=(Harmonic(order=4, amplitude=0.008, phase=0.6),))
SETTINGS = Settings(integration_time=60.0, modulation_frequency=20e6)
#: Seconds between two poses.
PAUSE = 20


def recorded(
    tmp_path: Path,
    poses: Sequence[Pose],
    *,
    scene: Scene | None = None,
    frames: int = 4,
    drift: float = 0.0,
) -> list[RawFrame]:
    """Frames of the board at poses; it moves away by ``drift`` [m] from frame to frame and turns with it."""
    truth, board = helpers.camera(tmp_path, CYCLIC), scene or helpers.scene(tmp_path)
    simulation = Simulation(truth, board, seed=7)
    result = []
    for number, pose in enumerate(poses):
        stamp = (1 + PAUSE * number) * 1_000_000_000
        for k in range(frames):
            x, y, z = pose.position
            turned = (0.0, math.sin(k * drift), 0.0, math.cos(k * drift))
            true = Pose((x, y, z + k * drift), turned if drift else pose.orientation)
            exposure = Exposure(stamp + k * 40_000_000, SETTINGS, {"board": true}, number, stamp)
            result.append(replace(simulation.frame(exposure), truth={"board": pose}))
    return result


def at(*distances: float) -> list[Pose]:
    return [Pose((0.07, -0.04, distance)) for distance in distances]
