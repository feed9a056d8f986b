"""The cameras and frames that are measured, for one size of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera, Validity
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import load_scene

SIZES = ((176, 144), (640, 480))
SETTINGS = Settings(integration_time=100, uptime=200.0, ambient_temperature=24.0)


def camera_of(name: str, width: int, height: int) -> Camera:
    """Return a shipped camera, with its sensor and lens scaled to a size in pixels."""
    camera = load_camera(find_camera(name))
    scale = width / camera.sensor.width
    optics = camera.optics
    return replace(
        camera,
        sensor=replace(camera.sensor, width=width, height=height),
        optics=replace(
            optics, fx=optics.fx * scale, fy=optics.fy * scale, cx=optics.cx * scale, cy=optics.cy * scale
        ),
        validity=Validity(),
    )


def plain(width: int, height: int) -> Camera:
    """Return a camera with cyclic, per-pixel and amplitude terms."""
    camera = camera_of("sr3000", width, height)
    effects = {name: camera.effects[name] for name in ("cyclic_error", "amplitude_offset")}
    effects["fixed_pattern_offset"] = FixedPatternOffset.example(camera)
    return with_effects(camera, effects)


def scattering(width: int, height: int, *, compact: bool = False) -> Camera:
    """Return a camera whose only effect is stray light of two kernels, ``compact`` within a few pixels."""
    camera = camera_of("sr3000", width, height)
    sigmas = ((4.0, 5.0), (7.0, 6.0)) if compact else ((width / 14, width / 12), (width / 3, width / 4))
    kernels = tuple(Kernel(w, sigma) for w, sigma in zip((0.1, 0.12), sigmas, strict=True))
    return with_effects(replace(camera, minimum_amplitude=0.0), {"scattering": Scattering(kernels=kernels)})


def every_effect() -> Camera:
    """Return the shipped camera with every effect."""
    return load_camera(find_camera("sr3000_every_effect"))


def room(camera: Camera) -> tuple[Simulation, Exposure]:
    """Return a simulation of the furnished room and an exposure of it."""
    scene = load_scene(find_scene("room"))
    poses: dict[str, Pose] = scene.fixed_poses()
    return Simulation(camera, scene, seed=1), Exposure(stamp=10**18, settings=SETTINGS, poses=poses)


def frame_of(camera: Camera) -> RawFrame:
    """Return a frame of the room, in counts."""
    simulation, exposure = room(camera)
    return simulation.frame(exposure)


def spot(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [m] and amplitude of a lit disc in the middle of a dark image."""
    height, width = camera.shape
    v, u = np.mgrid[:height, :width]
    lit = np.hypot(u - width / 2, v - height / 2) < height / 8
    return 1.0 + u / width + v / height, np.where(lit, 4000.0 + 3.0 * u, 0.0)
