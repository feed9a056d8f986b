"""Small simulated recordings on disk, with the camera and scene files that they are calibrated with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene

#: 1-sigma of the reference instrument in the tests: along the normal [m], tilt [rad].
POSE_SIGMA = (0.001, 0.0005)


def frames(
    truth: Camera,
    board: Scene,
    *,
    poses: int = 20,
    repeats: int = 4,
    seed: int = 0,
    device: str = "test 7",
    distances: tuple[float, float] = (0.6, 4.5),
    tilt: float = 35.0,
    wrong: float = 1.0,
    off: dict[int, float] | None = None,
) -> Iterator[RawFrame]:
    """Yield frames of a board; poses are recorded with the instrument's error times ``wrong``.

    ``tilt`` in degrees; ``off`` adds metres to the recorded depth of some poses.
    """
    rng = np.random.default_rng([seed, 23])
    simulation = Simulation(truth, board, seed=seed)
    for number in range(poses):
        turn = np.radians(rng.uniform(-tilt, tilt, 2)) / 2
        rotation = rotation_matrix(_unit(np.sin(turn[0]), np.sin(turn[1])))
        position = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(*distances)])
        error = wrong * rng.standard_normal(3) * np.array([POSE_SIGMA[0], POSE_SIGMA[1], POSE_SIGMA[1]])
        turned = rotation @ rotation_matrix(_unit(error[1] / 2, error[2] / 2))
        true = _pose(position + error[0] * rotation[:, 2], turned)
        stated = _pose(position + np.array([0.0, 0.0, (off or {}).get(number, 0.0)]), rotation)
        stamp = 1_000_000_000 + number * 55_000_000_000
        settings = Settings(
            integration_time=(16.0, 60.0, 100.0)[number % 3],
            modulation_frequency=20e6,
            uptime=40.0 + 55.0 * number,
            ambient_temperature=20.0 + 4.0 * float(np.sin(number)),
        )
        for k in range(repeats):
            exposure = Exposure(
                stamp=stamp + k * 40_000_000,
                settings=settings,
                poses={"board": true},
                station=number,
                pose_stamp=stamp,
            )
            yield replace(simulation.frame(exposure), truth={"board": stated}, device=device)


def write(path: Path, recorded: Iterator[RawFrame] | list[RawFrame]) -> Path:
    """Write frames as a recording."""
    with RecordingWriter(path) as writer:
        for one in recorded:
            writer.write_raw(one)
    return path


def _unit(x: float, y: float) -> tuple[float, float, float, float]:
    return (float(x), float(y), 0.0, float(np.sqrt(1 - x * x - y * y)))


def _pose(position: np.ndarray, rotation: np.ndarray) -> Pose:
    return Pose((float(position[0]), float(position[1]), float(position[2])), quaternion(rotation))
