"""A printed board of known poses before a camera whose driver publishes as a Femto's does, without poses."""

from __future__ import annotations

import contextlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.cli import main
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import load_scene
from test.imports.drivers import femto_lines, write_driver_bag

ROOT = Path(__file__).resolve().parents[2]
STATIONS, FRAMES = 8, 3

#: Pixels have an extent, so that corners lie where they are; 4 periods of 40 mm are what the file will lack.
CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 112, height: 84, pixel_pitch: [30.0e-6, 30.0e-6], modulation_frequency: 20.0e6}
optics: {fx: 113.0, fy: 112.0, cx: 56.7, cy: 41.2, d: [-0.12, 0.08, 0.001, -0.0007, 0.0]}
radiometry: {gain: 600.0}
noise: {floor: 0.002, shot: 0.0, amplitude: 6.0}
effects: {mixed_pixels: {blur: 0.3, footprint: 1.0}}
"""
CYCLIC = CyclicError(harmonics=(Harmonic(order=4, amplitude=0.04, phase=0.6),))


@dataclass(frozen=True)
class OwnBoard:
    """A folder with ``my_bag`` as the driver recorded it, ``board.yaml``, and what README made of them.

    These are ``bag`` and ``camera.yaml`` by all ``commands`` (lists of words) but the last. ``truth``: the
    camera as it is; ``poses`` of the board by the stamps of the first frames [ns].
    """

    folder: Path
    truth: Camera
    poses: dict[int, Pose]
    commands: list[list[str]]


def commands_of(page: str) -> list[list[str]]:
    """Return the arguments of the commands of a page that lead from a driver's bag to a diagnosis."""
    block = re.search(r"^    rim import my_bag.*\n(?:    rim .*\n)+", page, flags=re.MULTILINE)
    assert block is not None
    return [shlex.split(line, comments=True)[1:] for line in block[0].splitlines()]


@pytest.fixture(scope="session")
def own_board(tmp_path_factory: pytest.TempPathFactory) -> OwnBoard:
    folder = tmp_path_factory.mktemp("own_board")
    (folder / "true.yaml").write_text(CAMERA)
    plain = load_camera(folder / "true.yaml")
    truth = with_effects(plain, {**plain.effects, "cyclic_error": CYCLIC})
    words = ["--columns", "5", "--rows", "4", "--square", "0.05", "--greys", "0", "--quiet"]
    assert main(["board", "checkerboard", *words, "--out", str(folder / "board")]) == 0
    poses = board_poses()
    write_as_a_femto(folder / "my_bag", truth, list(recorded(truth, folder / "board.yaml", poses)))
    commands = commands_of((ROOT / "README.md").read_text())
    with contextlib.chdir(folder):
        for one in commands[:-1]:
            assert main([*one, "--quiet"]) == 0
    return OwnBoard(folder, truth, poses, commands)


def board_poses() -> dict[int, Pose]:
    """Return poses 0.5 to 1.2 m away, tilted by up to 25 degrees, rolled by quarters of a turn."""
    rng = np.random.default_rng(3)
    poses = {}
    for number, z in enumerate(np.linspace(0.5, 1.2, STATIONS).tolist()):
        turn = Rotation.from_euler("zxy", [90 * (number % 4), *rng.uniform(-25, 25, 2)], degrees=True)
        x, y = 0.12 * z * np.cos(2.4 * number), 0.12 * z * np.sin(2.4 * number)
        a, b, c, d = turn.as_quat().tolist()
        poses[10**9 + number * 5 * 10**9] = Pose((float(x), float(y), z), (a, b, c, d))
    return poses


def recorded(truth: Camera, scene: Path, poses: dict[int, Pose]) -> Iterator[RawFrame]:
    """Yield the frames of each pose, at one of two integration times."""
    simulation = Simulation(truth, load_scene(scene), seed=1)
    for number, (first, pose) in enumerate(poses.items()):
        settings = Settings(integration_time=(8.0, 16.0)[number % 2], modulation_frequency=20e6)
        for k in range(FRAMES):
            exposure = Exposure(
                stamp=first + k * 10**8,
                settings=settings,
                poses={"board": pose},
                station=number,
                pose_stamp=first,
            )
            yield replace(simulation.frame(exposure), truth={}, pose_stamps={})


def write_as_a_femto(path: Path, camera: Camera, frames: list[RawFrame]) -> None:
    """Write what a Femto publishes of frames."""
    write_driver_bag(path, *femto_lines(frames, camera), ros1=False)
