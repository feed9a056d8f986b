"""Scenes: surfaces with poses and reflectivities, and the motion of the camera in front of them.

A surface is the x-y plane of its frame (a sphere is centred on it); poses are in the camera optical
frame (x right, y down, z forward). Lengths in metres.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose
from rim_camera_ros.parameters import NestedList, decode, quantity
from rim_camera_ros.rotations import quaternion, rotation_matrix, screw
from rim_camera_ros.yaml_files import read_yaml

Array = NDArray[np.float64]

SCENE_FORMAT = "rim_scene/1"
TRUTH = "truth"
UNKNOWN = "unknown"
#: Assumed reflectivity where none is stated.
_GREY = 0.5
#: Least distance of a surface from the optical centre [m]: the light of a nearer one would have no bound.
LEAST_DISTANCE = 0.001

_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class ScenePose:
    """A pose in a scene file; ``free`` names the components that are not known."""

    position: tuple[float, float, float] = quantity("m", "x y z; its surface 1 mm or more from the origin")
    orientation: tuple[float, float, float, float] = quantity("-", "x y z w", default=(0.0, 0.0, 0.0, 1.0))
    free: tuple[Literal["x", "y", "z", "roll", "pitch", "yaw"], ...] = quantity(
        "-", "components to be estimated", default=()
    )

    def __post_init__(self) -> None:
        norm = math.sqrt(sum(q * q for q in self.orientation))
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"orientation is not a unit quaternion x y z w (its norm is {norm:.4g})")

    @property
    def pose(self) -> Pose:
        return Pose(self.position, self.orientation)


@dataclass(frozen=True)
class Texture:
    """Tiles that repeat: ``values[i][j]`` is the reflectivity of rows i and columns j of ``cell`` metres."""

    cell: tuple[float, float] = quantity("m", "tile width and height", above=0.0)
    values: NestedList = quantity("-", "reflectivity of each tile", minimum=0.0, maximum=1.0)

    def __post_init__(self) -> None:
        if self.values.values.ndim != 2 or self.values.values.size == 0:
            raise ValueError("values must be a list of rows of reflectivities")

    def reflectivity(self, x: Array, y: Array) -> Array:
        """Return the reflectivity at surface coordinates in metres."""
        rows, columns = self.values.values.shape
        i = np.floor(y / self.cell[1]).astype(np.int64) % rows
        j = np.floor(x / self.cell[0]).astype(np.int64) % columns
        result: Array = self.values.values[i, j]
        return result

    def tile(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Return the number of the tile, row by row, at surface coordinates in metres."""
        rows, columns = self.values.values.shape
        i = np.floor(y / self.cell[1]).astype(np.int64) % rows
        j = np.floor(x / self.cell[0]).astype(np.int64) % columns
        return np.asarray(i * columns + j)


@dataclass(frozen=True)
class Surface:
    """One surface of a scene."""

    name: str = quantity("-", "unique name")
    type: Literal["plane", "rectangle", "disc", "sphere"] = quantity("-", "shape")
    pose: str | ScenePose = quantity("-", "position and orientation, or 'truth'")
    size: tuple[float, float] | None = quantity("m", "rectangle: full width, height", default=None, above=0.0)
    radius: float | None = quantity("m", "disc, sphere", default=None, above=0.0)
    reflectivity: float | Literal["unknown"] = quantity(
        "-",
        "diffuse; unknown: amplitudes are taken as they are measured and say nothing of the surface",
        default=0.8,
        minimum=0.0,
        maximum=1.0,
    )
    texture: Texture | None = quantity("-", "replaces the reflectivity", default=None)
    reflectivity_sigma: float = quantity(
        "-", "relative 1-sigma of every tile's reflectivity; 0: known", default=0.1, minimum=0.0, maximum=1.0
    )
    pose_sigma: tuple[float, float] = quantity(
        "m, rad", "1-sigma of the reference: along the normal, tilt", default=(0.001, 0.0005), minimum=0.0
    )
    pose_common: float = quantity(
        "-",
        "share of the variance of pose_sigma that is the same in all poses of a recording",
        default=0.5,
        minimum=0.0,
        maximum=1.0,
    )
    pose_scale_sigma: float = quantity(
        "-",
        "relative 1-sigma of the positions of all poses together, as of a board that is found in images: "
        "focal length and size of the board",
        default=0.0,
        minimum=0.0,
        maximum=0.5,
    )
    flatness_sigma: float = quantity(
        "m",
        "rectangle, disc: 1-sigma of its departure from a plane, which is the same in all poses: a bow along "
        "each axis, from the middle to the edge, and a twist, from the middle to a corner",
        default=0.001,
        minimum=0.0,
        maximum=0.1,
    )

    def __post_init__(self) -> None:
        if not self.name.strip() or "/" in self.name or not self.name.isprintable() or len(self.name) > 100:
            raise ValueError(f"'{self.name[:100]}' is no name: up to 100 characters that print, without /")
        if isinstance(self.pose, str) and self.pose != TRUTH:
            raise ValueError(
                f"pose must be a group with position and orientation, or truth, not '{self.pose}'"
            )
        if (self.type == "rectangle") != (self.size is not None):
            raise ValueError("a rectangle needs 'size: [width, height]', and only a rectangle has one")
        if (self.type in ("disc", "sphere")) != (self.radius is not None):
            raise ValueError("a disc or sphere needs 'radius', and only they have one")
        if self.reflectivity == UNKNOWN and self.texture is not None:
            raise ValueError("reflectivity is unknown, but texture states it: keep one of them")

    @property
    def half_extent(self) -> tuple[float, float] | None:
        """Half of the width and height [m] of a rectangle or a disc; None for other surfaces."""
        if self.size is not None:
            return self.size[0] / 2, self.size[1] / 2
        return (self.radius, self.radius) if self.type == "disc" and self.radius is not None else None

    @property
    def is_described(self) -> bool:
        """Whether the scene file says how much light the surface reflects."""
        return self.reflectivity != UNKNOWN

    @property
    def nominal_reflectivity(self) -> float:
        """The reflectivity without texture; that of a grey where it is unknown."""
        return float(self.reflectivity) if self.is_described else _GREY

    @property
    def tiles(self) -> int:
        """Number of tiles whose reflectivity is stated, 1 without texture."""
        return 1 if self.texture is None else int(self.texture.values.values.size)

    def pose_covariance(self, pose: Pose) -> Array:
        """Return the covariance (3, 3) of the errors of a recorded pose.

        The errors are the shift along the normal [m] and the rotations about the surface's x and y axes
        [rad]. The covariance is that recorded with the pose, or else that by ``pose_sigma``.
        """
        if pose.covariance is None:
            offset, tilt = self.pose_sigma
            return np.diag([offset**2, tilt**2, tilt**2])
        rotation = rotation_matrix(pose.orientation)
        errors = np.zeros((3, 6))
        errors[0, :3] = rotation[:, 2]
        errors[1:, 3:] = rotation[:, :2].T
        result: Array = errors @ np.array(pose.covariance).reshape(6, 6) @ errors.T
        return result

    def distance(self, pose: Pose) -> float:
        """Return the distance of the surface's nearest point from the optical centre in metres."""
        position = np.array(pose.position)
        if self.radius is not None and self.type == "sphere":
            return float(abs(np.linalg.norm(position) - self.radius))
        x, y, z = -position @ rotation_matrix(pose.orientation)
        beyond = (0.0, 0.0)
        if self.size is not None:
            beyond = (max(abs(x) - self.size[0] / 2, 0.0), max(abs(y) - self.size[1] / 2, 0.0))
        elif self.radius is not None:
            beyond = (max(math.hypot(x, y) - self.radius, 0.0), 0.0)
        return math.hypot(z, *beyond)

    def lengths(self, pose: Pose, origins: Array, directions: Array) -> Array:
        """Return the lengths (N,) along rays at which the surface is met; inf where it is not.

        ``origins`` (N, 3) or (3,), ``directions`` (N, 3) of length 1.
        """
        position = np.array(pose.position)
        if self.type == "sphere":
            assert self.radius is not None
            to_centre = position - origins
            along = np.sum(to_centre * directions, axis=-1)
            discriminant = along**2 - np.sum(to_centre**2, axis=-1) + self.radius**2
            with np.errstate(invalid="ignore"):
                length = along - np.sqrt(discriminant)
            return np.where((discriminant > 0) & (length > 0), length, np.inf)
        rotation = rotation_matrix(pose.orientation)
        normal = rotation[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            length = ((position - origins) @ normal) / (directions @ normal)
        met = np.isfinite(length) & (length > 0)
        if self.type != "plane":
            safe = np.where(met, length, 0.0)[..., None]
            local = (origins + safe * directions - position) @ rotation[:, :2]
            if self.size is not None:
                met &= (np.abs(local[..., 0]) <= self.size[0] / 2) & (
                    np.abs(local[..., 1]) <= self.size[1] / 2
                )
            elif self.radius is not None:
                met &= np.sum(local**2, axis=-1) <= self.radius**2
        return np.where(met, length, np.inf)


@dataclass(frozen=True)
class CameraMotion:
    """Twist of the camera in its own optical frame."""

    linear: tuple[float, float, float] = quantity("m/s", "velocity", default=(0.0, 0.0, 0.0))
    angular: tuple[float, float, float] = quantity("rad/s", "angular velocity", default=(0.0, 0.0, 0.0))

    @property
    def moves(self) -> bool:
        return any(self.linear) or any(self.angular)

    def carry(self, pose: Pose, seconds: float) -> Pose:
        """Return the pose of a surface at rest as the moving camera sees it ``seconds`` later."""
        if not self.moves or seconds == 0:
            return pose
        rotation, translation = screw(np.array(self.linear) * seconds, np.array(self.angular) * seconds)
        position = rotation.T @ (np.array(pose.position) - translation)
        orientation = quaternion(rotation.T @ rotation_matrix(pose.orientation))
        return Pose((float(position[0]), float(position[1]), float(position[2])), orientation)


@dataclass(frozen=True)
class Station:
    """A sequence of frames with fixed poses and settings; values that are not given stay as before."""

    frames: int = quantity("-", "number of frames", default=100, minimum=1, maximum=1e7)
    rate: float = quantity("Hz", "frames per second", default=25.0, minimum=1e-3, maximum=1e6)
    integration_time: float | None = quantity("device unit", "setting", default=None, above=0.0)
    uptime: float | None = quantity("s", "since power-on, of the first frame", default=None, minimum=0.0)
    ambient: float | None = quantity("degC", "ambient temperature", default=None)
    poses: Mapping[str, ScenePose] = quantity("-", "pose by surface name", default=_EMPTY)


@dataclass(frozen=True)
class Scene:
    """A scene file's content."""

    surfaces: tuple[Surface, ...] = quantity("-", "what the camera may see", most=200)
    format: str = SCENE_FORMAT
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    schedule: tuple[Station, ...] = quantity("-", "stations, one after the other", default=(), most=10_000)
    stray_light: float = quantity(
        "counts",
        "1-sigma of light by way of what is not in the scene, one phasor a pose and its gradients",
        default=0.0,
        minimum=0.0,
    )

    def __post_init__(self) -> None:
        if self.format != SCENE_FORMAT:
            raise ValueError(f"format is '{self.format}', expected {SCENE_FORMAT}")
        if not self.surfaces:
            raise ValueError("surfaces is empty: nothing can be seen")
        names = [surface.name for surface in self.surfaces]
        twice = sorted({one for one in names if names.count(one) > 1})
        if twice:
            raise ValueError(f"surface name '{twice[0]}' is given twice")
        for i, station in enumerate(self.schedule):
            for name in station.poses:
                if name not in names:
                    raise ValueError(f"schedule.{i}.poses names '{name}', which is not a surface")

    @property
    def needs_truth(self) -> tuple[str, ...]:
        """Names of the surfaces whose pose comes from the recording."""
        return tuple(surface.name for surface in self.surfaces if surface.pose == TRUTH)

    def fixed_poses(self) -> dict[str, Pose]:
        """Return the poses that the scene file itself states."""
        return {
            surface.name: surface.pose.pose
            for surface in self.surfaces
            if isinstance(surface.pose, ScenePose)
        }

    def poses_for(self, truth: Mapping[str, Pose]) -> dict[str, Pose]:
        """Return the pose of every surface, those with ``pose: truth`` taken from ``truth``.

        Raises `InputError`, which names the surface, if one has no pose.
        """
        poses = self.fixed_poses()
        for name in self.needs_truth:
            if name not in truth:
                raise InputError(
                    f"surface '{name}' has pose: truth, but no pose is known for this frame",
                    remedy=f"give --poses BAG with /ground_truth/{name}/pose before its first frame, "
                    "or a pose in the scene file or its schedule",
                )
            poses[name] = truth[name]
        return poses


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene file. Raises `InputError` with file, place and remedy."""
    document = read_yaml(path)
    if isinstance(document.data, dict) and document.data.get("format") != SCENE_FORMAT:
        found = document.data.get("format")
        raise document.error(
            ("format",) if "format" in document.data else (),
            f"not a scene file: format is {found!r}",
            f"expected format: {SCENE_FORMAT}",
        )
    scene = decode(Scene, document.data, document)
    surfaces = tuple(
        replace(one, pose=_normalised(one.pose)) if isinstance(one.pose, ScenePose) else one
        for one in scene.surfaces
    )
    schedule = tuple(
        replace(one, poses=MappingProxyType({name: _normalised(pose) for name, pose in one.poses.items()}))
        for one in scene.schedule
    )
    scene = replace(scene, surfaces=surfaces, schedule=schedule)
    for place, surface, pose in _stated(scene):
        if surface.distance(pose.pose) < LEAST_DISTANCE:
            raise document.error(
                (*place, "position"),
                f"'{surface.name}' lies {surface.distance(pose.pose):.2g} m from the optical centre",
                f"place it {LEAST_DISTANCE:g} m away or more, x y z in metres before the camera",
            )
    return scene


def _stated(scene: Scene) -> Iterator[tuple[tuple[str | int, ...], Surface, ScenePose]]:
    """Yield the poses that a scene file states, with their place in it and their surface."""
    for number, surface in enumerate(scene.surfaces):
        if isinstance(surface.pose, ScenePose):
            yield ("surfaces", number, "pose"), surface, surface.pose
    by_name = {surface.name: surface for surface in scene.surfaces}
    for number, station in enumerate(scene.schedule):
        for name, pose in station.poses.items():
            yield ("schedule", number, "poses", name), by_name[name], pose


def _normalised(pose: ScenePose) -> ScenePose:
    q = np.array(pose.orientation)
    q = q / np.linalg.norm(q)
    return replace(pose, orientation=(float(q[0]), float(q[1]), float(q[2]), float(q[3])))
