"""The joint adjustment of a million samples against scipy's least squares with numeric derivatives.

Both fit the same model to the same frames: cyclic error, distance scale and angle of incidence, with three
errors of the reference instrument for each pose. One reduces frames to stations and streams them into normal
equations, the other has a residual for every pixel of every frame.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rim_camera_ros.camera import Camera, Sensor
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.noise import Noise
from rim_camera_ros.optics import Optics
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, Surface

Array = NDArray[np.float64]

WIDTH, HEIGHT = 44, 36
SIGMA = 0.004
POSE_SIGMA = (0.0005, 0.0003)
SETTING = 60.0
POSES = 20


@dataclass(frozen=True)
class Work:
    """Frames of known poses, the camera to start from, and the true one."""

    camera: Camera
    frames: list[RawFrame]
    scene: Scene

    @property
    def samples(self) -> int:
        return len(self.frames) * WIDTH * HEIGHT


def work(samples: int = 1_000_000) -> Work:
    """Return ``samples`` distances of a plane at `POSES` poses, each with the errors of the instrument."""
    camera = Camera(
        sensor=Sensor(
            width=WIDTH,
            height=HEIGHT,
            modulation_frequency=20e6,
            pixel_pitch=(160e-6, 160e-6),
            distance_lsb=1e-6,
        ),
        optics=Optics(fx=50.0, fy=50.0, cx=21.7, cy=17.4),
        noise=Noise(floor=SIGMA, shot=0.0, amplitude=0.0),
        minimum_amplitude=0.0,
    )
    camera = with_effects(camera, {one.name: one for one in _effects(0.9)})
    model = Model(camera)
    rng = np.random.default_rng(3)
    repeats = -(-samples // (POSES * WIDTH * HEIGHT))
    settings = Settings(integration_time=SETTING, modulation_frequency=20e6)
    frames = []
    for k in range(POSES):
        half = np.radians(rng.uniform(-40, 40, 2)) / 2
        rotation = rotation_matrix((float(np.sin(half[0])), float(np.sin(half[1])), 0.0, 1.0))
        pose = Pose((0.02 * k - 0.2, 0.1, 0.6 + 0.2 * k), quaternion(rotation))
        errors = rng.standard_normal(3) * np.array([POSE_SIGMA[0], POSE_SIGMA[1], POSE_SIGMA[1]])
        true = model.distances(_numbers(_camera_with(camera, _effects(1.0))), pose, errors)
        for i in range(repeats):
            noisy = true + SIGMA * rng.standard_normal(true.shape)
            frames.append(
                RawFrame(
                    stamp=1 + k * 10**10 + i * 10**7,
                    distance=noisy,
                    amplitude=np.full(true.shape, 500.0),
                    settings=settings,
                    truth={"board": pose},
                    pose_stamps={"board": 1 + k * 10**10},
                )
            )
    surface = Surface("board", "plane", "truth", pose_sigma=POSE_SIGMA, pose_common=0.0)
    return Work(camera, frames, Scene((surface,)))


def _effects(size: float) -> list[Any]:
    rows = {SETTING: (2e-9 * size, -1.0e-7 * size, 1e-6 * size, 2e-4 * size)}
    harmonics = (Harmonic(4, 0.02 * size, 0.6 * size), Harmonic(8, 0.006 * size, -1.1 * size))
    return [
        CyclicError(harmonics, (0.002 * size, -0.001 * size)),
        IncidenceAngle(rows),
        DistanceScale(1e-3 * size),
    ]


def _camera_with(camera: Camera, effects: list[Any]) -> Camera:
    return with_effects(camera, {one.name: one for one in effects})


def _numbers(camera: Camera) -> Array:
    numbers = camera_numbers(camera)
    return np.array([numbers[path] for path in PATHS])


#: Parameters in the order of `Model`.
PATHS = (
    *(f"effects.cyclic_error.harmonics.{i}.{name}" for i in (0, 1) for name in ("amplitude", "phase")),
    "effects.cyclic_error.gradient.0",
    "effects.cyclic_error.gradient.1",
    *(f"effects.incidence_angle.polynomial.60.{i}" for i in range(4)),
    "effects.distance_scale.scale",
)


class Model:
    """The distances of a plane, formula by formula."""

    def __init__(self, camera: Camera) -> None:
        self._rays = camera.rays
        self._wave = 2 * np.pi / camera.sensor.ambiguity
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        self._u, self._v = u - camera.optics.cx, v - camera.optics.cy

    def distances(self, numbers: Array, pose: Pose, errors: Array) -> Array:
        """Return what is measured (H, W) [m] of a plane, its stated pose wrong by offset [m] and tilts [rad].

        Linear in the errors, as in the adjustment.
        """
        rotation = rotation_matrix(pose.orientation)
        normal = rotation[:, 2]
        along = self._rays @ normal
        length = np.dot(pose.position, normal) / along
        arm = np.array(pose.position) - length[..., None] * self._rays
        angle = np.minimum(np.arccos(np.clip(np.abs(along), 0, 1)) * 200 / np.pi, 90.0)
        change = errors[0] / along
        for axis, error in ((rotation[:, 0], errors[1]), (rotation[:, 1], errors[2])):
            change = change + error * (arm @ np.cross(axis, normal)) / along
        a0, p0, a1, p1, gu, gv, i0, i1, i2, i3, scale = numbers
        shift = gu * self._u + gv * self._v
        slow, fast = 4 * self._wave * length + p0 + shift, 8 * self._wave * length + p1 + shift
        cyclic = a0 * np.sin(slow) + a1 * np.sin(fast)
        slope = 1 + scale + 4 * self._wave * a0 * np.cos(slow) + 8 * self._wave * a1 * np.cos(fast)
        quartic = (((i0 * angle + i1) * angle + i2) * angle + i3) * angle
        return np.asarray(length + cyclic - quartic + scale * length + slope * change)


def ours(given: Work) -> tuple[Array, Array]:
    """Return the parameters and their 1-sigma by the package: frames to stations, stations to equations."""
    stations = list(reduce_frames(given.frames, given.camera))
    dataset = Dataset(stations, ["bench"], [], len(given.frames))
    none = np.zeros((HEIGHT, WIDTH), bool)
    masks = [(used, none) for used, _ in Forward(dataset, given.scene, given.camera).pixels_used()]
    problem = Problem(dataset, given.scene, gain=False, pattern=False, robust=False, masks=masks)
    camera = replace(given.camera, radiometry=replace(given.camera.radiometry, gain_sigma=0.0))
    found = fit(problem, camera, tolerance=1e-3, iterations=12)
    sigma = found.sigma
    return np.array([found.parameters[p] for p in PATHS]), np.array([sigma[p] for p in PATHS])


def _priors(camera: Camera) -> Array:
    """Return the 1-sigma of the adjustment's weak prior of each parameter."""
    found = {
        f"effects.{name}.{path}": sigma
        for name, effect in camera.effects.items()
        for path, sigma in effect.priors().items()
    }
    return np.array([found[path] for path in PATHS])


def naive(given: Work) -> Array:
    """Return the parameters by scipy.optimize.least_squares: numeric derivatives, a residual per sample."""
    model = Model(given.camera)
    poses = [given.frames[i].truth["board"] for i in range(0, len(given.frames), len(given.frames) // POSES)]
    measured = np.stack([one.distance for one in given.frames]).reshape(POSES, -1, HEIGHT, WIDTH)
    prior = np.array([POSE_SIGMA[0], POSE_SIGMA[1], POSE_SIGMA[1]])
    start, priors = _numbers(given.camera), _priors(given.camera)
    scale = np.array([0.01, 1.0, 0.01, 1.0, 0.01, 0.01, 1e-9, 1e-7, 1e-5, 1e-4, 1e-3])

    def residuals(x: Array) -> Array:
        errors = x[len(PATHS) :].reshape(POSES, 3)
        parts = [
            (
                (measured[k] - model.distances(x[: len(PATHS)] * scale, poses[k], errors[k] * prior)) / SIGMA
            ).ravel()
            for k in range(POSES)
        ]
        away = (x[: len(PATHS)] * scale - start) / priors
        return np.concatenate([*parts, x[len(PATHS) :], away])

    x = np.concatenate([start / scale, np.zeros(3 * POSES)])
    found = least_squares(residuals, x, xtol=1e-10, ftol=1e-12, gtol=1e-12)
    return np.asarray(found.x[: len(PATHS)] * scale)


def measured[Result](run: Callable[[], Result]) -> tuple[Result, float, float]:
    """Return a run's result, its seconds, and the greatest memory that it allocated in MB."""
    tracemalloc.start()
    try:
        start = time.perf_counter()
        result = run()
        return result, time.perf_counter() - start, tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
