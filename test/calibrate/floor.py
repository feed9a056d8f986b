"""Recordings like that of a SwissRanger carried over a tiled floor: poses alike, known from the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import load_scene

CAMERA = """
format: rim_camera/1
device: SR4000
sensor: {{width: {width}, height: {height}, modulation_frequency: 30.0e6, distance_lsb: 0.00030517578125}}
optics: {{fx: {focal}, fy: {focal}, cx: {cx}, cy: {cy}}}
radiometry: {{gain: 25000.0, gain_sigma: 0.05}}
noise: {{floor: 0.002, shot: 0.17, amplitude: 9.0}}
"""

#: What the floor is: two kinds of tiles; and what the scene file says of it.
TILES = "texture: {cell: [0.33, 0.33], values: [[0.6, 0.42], [0.42, 0.6]]}"
ONE_COLOUR = "reflectivity: 0.5"
UNKNOWN = "reflectivity: unknown"
SCENE = """
format: rim_scene/1
surfaces:
- {{name: floor, type: plane, pose: truth, pose_sigma: {sigma}, {colour}}}
"""

#: Height of the camera [m] and the angle of its axis below the horizon [rad].
HEIGHT, DOWN = 0.8, 0.55


def floor_camera(folder: Path, *effects: Effect, scale: int = 1) -> Camera:
    """Write ``camera.yaml`` without effects, 176 x 144 pixels over ``scale``; return it with some."""
    width, height = 176 // scale, 144 // scale
    path = folder / "camera.yaml"
    path.write_text(
        CAMERA.format(
            width=width, height=height, focal=250.9 / scale, cx=width / 2 + 1.7, cy=height / 2 - 0.6
        )
    )
    return with_effects(load_camera(path), {one.name: one for one in effects})


def floor_scene(folder: Path, colour: str, *, sigma: Sequence[float] = (0.005, 0.003)) -> Path:
    """Write the scene file of a floor with errors of its poses of ``sigma`` [m, rad]."""
    path = folder / f"scene_{colour.split(':')[0]}_{len(colour)}.yaml"
    path.write_text(SCENE.format(sigma=list(sigma), colour=colour))
    return path


def floor_pose(rng: np.random.Generator) -> Pose:
    """Return the pose of the floor seen by a camera that is carried: it sways by centimetres and degrees."""
    height = HEIGHT + 0.02 * rng.standard_normal()
    down, roll = DOWN + 0.03 * rng.standard_normal(), 0.02 * rng.standard_normal()
    # the optical frame: y down, z forward; the floor's normal away from the camera
    normal = np.array([np.sin(roll) * np.cos(down), np.cos(roll) * np.cos(down), np.sin(down)])
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    turn = rng.uniform(0, 2 * np.pi)
    first = np.cos(turn) * along + np.sin(turn) * np.cross(normal, along)
    axes = np.stack([first, np.cross(normal, first), normal], axis=1)
    start = rng.uniform(-0.3, 0.3, 2)
    position = height * normal + axes[:, :2] @ start
    return Pose(tuple(position.tolist()), quaternion(axes))


def _moved(pose: Pose, by: float) -> Pose:
    axes = rotation_matrix(pose.orientation)
    turn = rotation_matrix((float(np.sin(by / 6)), 0.0, 0.0, float(np.cos(by / 6))))
    position = np.array(pose.position) + by * axes[:, 2]
    return Pose(tuple(position.tolist()), quaternion(turn @ axes))


def write_floor(
    path: Path,
    camera: Camera,
    folder: Path,
    *,
    poses: int,
    seed: int = 0,
    frames: int = 1,
    wrong: float = 0.0,
    drift: float = 0.0,
) -> None:
    """Write a recording of a tiled floor by a camera with its effects, each pose of so many frames.

    The poses that it states err along the normal by ``wrong`` [m], 1 sigma. From the first frame of a
    pose to its last the floor falls by ``drift`` [m], and turns by as many thirds of a radian: not stated.
    """
    scene = load_scene(floor_scene(folder, TILES))
    rng = np.random.default_rng([seed, 5])
    simulation = Simulation(camera, scene, seed=seed)
    settings = Settings(integration_time=1.0, modulation_frequency=30e6)
    with RecordingWriter(path) as writer:
        for number in range(poses):
            pose, stamp = floor_pose(rng), (number + 1) * 1_000_000_000
            along = wrong * rng.standard_normal() * rotation_matrix(pose.orientation)[:, 2]
            stated = replace(pose, position=tuple((np.array(pose.position) + along).tolist()))
            for k in range(frames):
                moved = drift * (k - (frames - 1) / 2) / max(frames - 1, 1)
                frame = simulation.frame(
                    Exposure(
                        stamp=stamp + k * 40_000_000,
                        settings=settings,
                        poses={"floor": _moved(pose, moved)},
                        station=number,
                        pose_stamp=stamp,
                    )
                )
                writer.write_raw(replace(frame, truth={"floor": stated}))
