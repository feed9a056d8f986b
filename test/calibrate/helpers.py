"""A small simulated laboratory: a board of patches at poses recorded with the instrument's error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.geometry import see
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, load_scene

CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 44, height: 36, pixel_pitch: [160.0e-6, 160.0e-6], modulation_frequency: 20.0e6}
optics: {fx: 50.0, fy: 50.0, cx: 21.7, cy: 17.4}
radiometry: {gain: 120.0, gain_sigma: 0.01}
noise: {floor: 0.003, shot: 0.0, amplitude: 6.0}
"""

SCENE = """
format: rim_scene/1
surfaces:
- name: board
  type: plane
  pose: truth
  pose_sigma: [0.001, 0.0005]
  texture: {cell: [0.31, 0.27], values: [[0.1, 0.85, 0.3], [0.6, 0.2, 0.9], [0.45, 0.75, 0.15]]}
"""

POSE_SIGMA = (0.001, 0.0005)


def camera(tmp_path: Path, *effects: Effect) -> Camera:
    """The test's camera with some effects."""
    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA)
    return with_effects(load_camera(path), {one.name: one for one in effects})


def scene(tmp_path: Path) -> Scene:
    """The board, its poses from the recording."""
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return load_scene(path)


def record(
    truth: Camera,
    board: Scene,
    *,
    poses: int = 24,
    frames: int = 4,
    seed: int = 0,
    wrong: float = 1.0,
    roll: float = 0.0,
) -> Dataset:
    """Stations of a simulated recording; recorded poses are wrong by ``wrong`` times the instrument's sigma.

    Boards are rolled by up to ``roll`` degrees either way.
    """
    rng = np.random.default_rng([seed, 11])
    simulation = Simulation(truth, board, seed=seed)
    recorded: list[RawFrame] = []
    for station in range(poses):
        stated, true = _poses(rng, wrong, roll)
        settings = Settings(
            integration_time=(16.0, 60.0, 100.0)[station % 3],
            modulation_frequency=20e6,
            uptime=40.0 + 55.0 * station,
            ambient_temperature=20.0 + 4.0 * float(np.sin(station)),
        )
        stamp = station * 55_000_000_000 + 1
        for k in range(frames):
            exposure = Exposure(
                stamp=stamp + k * 40_000_000,
                settings=settings,
                poses={**board.fixed_poses(), "board": true},
                station=station,
                pose_stamp=stamp,
            )
            recorded.append(replace(simulation.frame(exposure), truth={"board": stated}))
    stations = list(reduce_frames(recorded, truth))
    return Dataset(stations, ["simulated"], [], len(recorded))


def with_wrong_pose(data: Dataset, number: int, by: float) -> Dataset:
    """The dataset with the recorded pose of one station so far off along the axis [m]."""
    one = data.stations[number]
    x, y, z = one.truth["board"].position
    moved = Pose((x, y, z + by), one.truth["board"].orientation)
    stations = [*data.stations]
    stations[number] = replace(one, truth={"board": moved})
    return replace(data, stations=stations)


def _poses(rng: np.random.Generator, wrong: float, roll: float) -> tuple[Pose, Pose]:
    """A pose as stated, and as it is."""
    turn = np.radians(rng.uniform(-35, 35, 2))
    half = turn / 2
    about_axis = float(np.sin(np.radians(rng.uniform(-roll, roll)) / 2)) if roll else 0.0
    orientation = (float(np.sin(half[0])), float(np.sin(half[1])), about_axis, 1.0)
    rotation = rotation_matrix(orientation)
    position = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0.6, 4.5)])
    error = wrong * rng.standard_normal(3) * np.array([POSE_SIGMA[0], POSE_SIGMA[1], POSE_SIGMA[1]])
    small = rotation @ rotation_matrix((error[1] / 2, error[2] / 2, 0.0, 1.0))
    moved = position + error[0] * rotation[:, 2]
    stated = Pose((float(position[0]), float(position[1]), float(position[2])), quaternion(rotation))
    return stated, Pose((float(moved[0]), float(moved[1]), float(moved[2])), quaternion(small))


def with_footprints(stated: Camera, board: Scene, data: Dataset, width: float, seed: int) -> Dataset:
    """The stations anew, one frame each, noise and all: light averaged over squares of ``width`` [px].

    S = mean of gain T rho cos(incidence) / d^2 exp(i 2 pi d / L), by 9 x 9 rays a pixel.
    """
    rng = np.random.default_rng(seed)
    down, across = np.gradient(stated.rays, axis=0), np.gradient(stated.rays, axis=1)
    period = stated.sensor.ambiguity
    frames = []
    for one in data.stations:
        time = one.settings.integration_time
        assert time is not None
        image = np.zeros(stated.shape, complex)
        for dv, du in np.ndindex(9, 9):
            rays = stated.rays + width / 9 * ((dv - 4) * down + (du - 4) * across)
            seen = see(board, board.poses_for(one.truth), rays / np.linalg.norm(rays, axis=-1, keepdims=True))
            light = stated.radiometry.gain * time * seen.reflectivity * seen.cos_incidence / seen.distance**2
            phasor = light * np.exp(2j * np.pi / period * seen.distance)
            image += np.where(seen.hit, phasor, 0.0) / 81
        amplitude, phase = np.abs(image), np.angle(image)
        relative = 2 * np.pi / period * stated.noise.sigma_distance(np.maximum(amplitude, 1.0))
        noise = relative * rng.normal(size=(2, *stated.shape))
        turns = np.mod((phase + noise[0]) / (2 * np.pi), 1.0)
        frames.append(
            RawFrame(
                stamp=one.stamp,
                distance=np.round(turns * 65536).astype(np.uint16),
                amplitude=np.round(amplitude * (1 + noise[1])).astype(np.uint16),
                settings=one.settings,
                truth=one.truth,
                pose_stamps=dict.fromkeys(one.truth, one.stamp),
            )
        )
    return Dataset(list(reduce_frames(frames, stated)), ["simulated"], [], len(frames))
