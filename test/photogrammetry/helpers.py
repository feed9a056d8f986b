"""Target fields, stations and images of them for the tests of rim_camera_ros.photogrammetry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera import Camera, Noise, Optics, Radiometry, Sensor
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.noise import sigma_amplitude
from rim_camera_ros.optics import project
from rim_camera_ros.photogrammetry import ImagePoint, Observations, Target, TargetField
from rim_camera_ros.photogrammetry.projection import ellipse_centre_offset
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, ScenePose, Surface

#: Kahlmann 2007, table 3.2, as plumb_bob (calibration/sr3000.yaml).
SR3000 = Optics(
    fx=199.8875,
    fy=199.8875,
    cx=89.9925,
    cy=82.3925,
    d=(-0.108270791, -0.0712066115, 0.00106655692, -0.00233270836, 0.47813457),
)
WIDTH, HEIGHT = 176, 144
#: The labels of the thesis' test field, fig. 3.5: 11.7 cm.
RADIUS = 0.0585


def camera(optics: Optics = SR3000) -> Camera:
    return Camera(
        sensor=Sensor(width=WIDTH, height=HEIGHT, pixel_pitch=(4e-5, 4e-5), modulation_frequency=20e6),
        optics=optics,
        radiometry=Radiometry(gain=500.0),
        noise=Noise(floor=0.0045, amplitude=28.0),
    )


def field(depth: float = 0.0, radius: float = RADIUS) -> TargetField:
    """25 labels as in fig. 3.5; ``depth`` puts them at five heights."""
    return TargetField(
        {
            f"t{i}{j}": Target((0.25 * (i - 2), 0.22 * (j - 2), depth * ((7 * i + 3 * j) % 5 - 2)), radius)
            for i in range(5)
            for j in range(5)
        }
    )


def stations(
    rng: np.random.Generator,
    count: int = 16,
    *,
    roll: bool = True,
    tilts: tuple[tuple[float, float], tuple[float, float]] = ((-40, 40), (-40, 40)),
) -> dict[int, Pose]:
    """Tilts about x and y within deg, 1.2 to 2 m away, with ``roll`` by 90 deg from one to the next."""
    poses = {}
    for i in range(count):
        turn = (90 * (i % 4) if roll else 0) + rng.uniform(-8, 8)
        angles = [rng.uniform(*tilts[0]), rng.uniform(*tilts[1]), turn]
        rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        x, y = rng.uniform(-0.1, 0.1, 2)
        poses[i] = Pose((float(x), float(y), float(rng.uniform(1.2, 2.0))), quaternion(rotation))
    return poses


def seen(
    targets: TargetField,
    poses: dict[int, Pose],
    rng: np.random.Generator,
    *,
    sigma: float = 0.05,
    optics: Optics = SR3000,
) -> Observations:
    """Centres of the ellipses with noise, where they are in the image; no approximate poses."""
    points = []
    radii = np.array([one.radius for one in targets.targets.values()])
    for station, pose in poses.items():
        rotation = rotation_matrix(pose.orientation)
        there = targets.positions @ rotation.T + pose.position
        image = project(optics, there)
        normals = np.tile(rotation[:, 2], (len(there), 1))
        image = image + ellipse_centre_offset(optics, there, normals, radii)
        image = image + sigma * rng.normal(size=image.shape)
        for name, (u, v) in zip(targets.targets, image, strict=True):
            if 4 < u < WIDTH - 5 and 4 < v < HEIGHT - 5:
                points.append(ImagePoint(name, station, float(u), float(v), sigma))
    return Observations(targets, tuple(points))


def vector(optics: Optics) -> np.ndarray:
    return np.array([optics.fx, optics.fy, optics.cx, optics.cy, *optics.d])


# --- images ----------------------------------------------------------------------------------------


def disc(
    name: str, centre: Sequence[float] | np.ndarray, rotation: np.ndarray, radius: float, **options: Any
) -> Surface:
    x, y, z = (float(one) for one in centre)
    options.setdefault("reflectivity", 0.85)
    pose = ScenePose((x, y, z), quaternion(rotation))
    return Surface(name=name, type="disc", radius=radius, pose=pose, **options)


def plate(rotation: np.ndarray, position: np.ndarray, **options: Any) -> Surface:
    """The black plate 2 mm behind the labels."""
    x, y, z = (float(one) for one in rotation @ np.array([0, 0, 0.002]) + position)
    pose = ScenePose((x, y, z), quaternion(rotation))
    return Surface(name="plate", type="rectangle", size=(1.3, 1.15), pose=pose, reflectivity=0.06, **options)


def labelled_plate(pose: Pose, targets: TargetField) -> Scene:
    rotation, position = rotation_matrix(pose.orientation), np.array(pose.position)
    surfaces = [plate(rotation, position)]
    for name, one in targets.targets.items():
        surfaces.append(disc(name, rotation @ np.array(one.position) + position, rotation, one.radius))
    wall = Surface(name="wall", type="plane", reflectivity=0.4, pose=ScenePose((0.0, 0.0, 3.5)))
    return Scene(surfaces=(*surfaces, wall))


def exposure(scene: Scene, *, stamp: int, station: int = 0, pose_stamp: int | None = None) -> Exposure:
    settings = Settings(integration_time=100.0, uptime=1000.0, ambient_temperature=20.0)
    return Exposure(
        stamp=stamp, settings=settings, poses=scene.fixed_poses(), station=station, pose_stamp=pose_stamp
    )


def area_sampled(
    cam: Camera, scene: Scene, *, rng: np.random.Generator, factor: int = 8, frames: int = 10
) -> RawFrame:
    """A frame whose pixels have an extent, ``factor`` x ``factor`` rays each; noise of a mean of ``frames``.

    Without mixed_pixels, whose blur in px would be another one at the finer pitch.
    """
    o, s = cam.optics, cam.sensor
    large = replace(
        cam,
        sensor=replace(s, width=s.width * factor, height=s.height * factor),
        optics=Optics(
            fx=o.fx * factor,
            fy=o.fy * factor,
            cx=(o.cx + 0.5) * factor - 0.5,
            cy=(o.cy + 0.5) * factor - 0.5,
            d=o.d,
        ),
    )
    frame = Simulation(large, scene, noise=False, quantised=False).frame(exposure(scene, stamp=1))
    amplitude = frame.amplitude.reshape(s.height, factor, s.width, factor).mean(axis=(1, 3))
    sigma = sigma_amplitude(cam.noise.sigma_distance(amplitude), amplitude, ambiguity=s.ambiguity)
    amplitude = amplitude + sigma / np.sqrt(frames) * rng.normal(size=amplitude.shape)
    return replace(
        frame, amplitude=np.rint(amplitude).clip(0), distance=frame.distance[::factor, ::factor].copy()
    )


def conic_centre(optics: Optics, centre: np.ndarray, rotation: np.ndarray, radius: float) -> np.ndarray:
    """Centre of the image of a circle by projective geometry (dual conic H C* H'), without distortion."""
    matrix = np.array([[optics.fx, 0, optics.cx], [0, optics.fy, optics.cy], [0, 0, 1.0]])
    homography = matrix @ np.column_stack([rotation[:, 0], rotation[:, 1], centre])
    dual = homography @ np.diag([radius**2, radius**2, -1.0]) @ homography.T
    result: np.ndarray = dual[:2, 2] / dual[2, 2]
    return result
