"""Scenes and their stations, drawn at random."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .sensor import Array
from .tracing import Poses, Surface

SCENES = ("rich", "whitedist", "sweep", "corner", "board", "tilted", "passage")
POSE_SIGMA = (0.001, 0.0006)
GAIN_SIGMA = 0.01
FRAME_RATE = 25.0
AWAY = np.array([0.0, 0.0, -60.0])
"""Where an absent plate is: behind the camera."""


@dataclass
class Exposures:
    """Groups of frames equal but for noise: one per station unless an effect varies from frame to frame."""

    uptime: Array
    integration_time: Array
    ambient: Array
    power: Array
    station: "np.ndarray"
    true: dict[str, Poses]
    told: dict[str, Poses]
    frames: int = 3
    air: Callable[[Array], Array] = field(repr=False, default=lambda t: np.full(np.shape(t), 20.0))
    twist: tuple[Array, Array] | None = None

    def __len__(self) -> int:
        return len(self.uptime)

    def frame_by_frame(self) -> "Exposures":
        """The same frames, one per exposure."""
        index = np.repeat(np.arange(len(self)), self.frames)
        later = np.tile(np.arange(self.frames) / FRAME_RATE, len(self))
        return replace(
            self,
            uptime=self.uptime[index] + later,
            integration_time=self.integration_time[index],
            ambient=self.ambient[index],
            power=self.power[index],
            station=self.station[index],
            true={name: poses.take(index) for name, poses in self.true.items()},
            told={name: poses.take(index) for name, poses in self.told.items()},
            frames=1,
        )


@dataclass
class Scene:
    """Surfaces and exposures."""

    name: str
    surfaces: list[Surface]
    exposures: Exposures


def turned(tilts: Array) -> Array:
    """Rotation matrices of rotation vectors in degrees, (n, 3) to (n, 3, 3)."""
    return np.asarray(Rotation.from_rotvec(tilts, degrees=True).as_matrix())


def texture(rng: np.random.Generator, shape: tuple[int, int] = (16, 16)) -> Array:
    """Tiles of four greys."""
    return np.asarray(rng.choice([0.1, 0.25, 0.5, 0.85], size=shape, p=[0.20, 0.27, 0.27, 0.26]))


def reference_error(rng: np.random.Generator, poses: Poses, sigma: tuple[float, float]) -> Poses:
    """The poses as the reference instrument reports them: Student t (8 degrees of freedom), scaled."""
    count = len(poses.position)
    errors = rng.standard_t(8, size=(count, 3)) * np.sqrt(6.0 / 8.0)
    position = poses.position + poses.rotation[:, :, 2] * (errors[:, :1] * sigma[0])
    tilt = np.stack([errors[:, 1] * sigma[1], errors[:, 2] * sigma[1], np.zeros(count)], axis=1)
    return Poses(position, poses.rotation @ Rotation.from_rotvec(tilt).as_matrix())


def air_temperature(rng: np.random.Generator, *, monotonic: bool) -> Callable[[Array], Array]:
    """Ambient temperature over uptime, degC."""
    low, span = rng.uniform(14.0, 19.0), rng.uniform(7.0, 12.0)
    if monotonic:
        sign, scale = rng.choice([-1.0, 1.0]), rng.uniform(900.0, 2500.0)
        return lambda t: (
            low + span / 2.0 + sign * span * (np.asarray(t) / scale) / (1.0 + np.asarray(t) / scale)
        )
    period, phase, second = rng.uniform(1400.0, 2600.0), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.2)
    return lambda t: (
        low
        + span / 2.0 * (1.0 + np.sin(2.0 * np.pi * np.asarray(t) / period + phase))
        + second * span * np.sin(2.0 * np.pi * np.asarray(t) / (0.37 * period) + 2.0 * phase)
    )


def draw_scene(
    name: str, seed: int, *, stations: int = 40, frames: int = 3, monotonic_air: bool = False
) -> Scene:
    """A scene of `SCENES` with its stations.

    Raises
    ------
    ValueError: the scene is unknown.
    """
    if name not in SCENES:
        raise ValueError(f"scene {name!r} is none of {', '.join(SCENES)}")
    rng = np.random.default_rng([seed, 1, SCENES.index(name)])
    surfaces, true = _LAYOUTS[name](rng, stations)
    times = (
        np.linspace(30.0, 2400.0, stations)
        if name == "sweep"
        else np.sort(rng.uniform(20.0, 2400.0, stations)) + np.arange(stations) * 0.5
    )
    settings = np.full(stations, 100)
    if name in ("rich", "corner", "board", "passage"):
        settings = rng.permutation(np.resize([16, 100, 60, 100, 60, 16, 60, 100], stations))
    air = air_temperature(rng, monotonic=monotonic_air)
    twist = None
    if name == "passage":
        frames = 1
        linear = rng.uniform(-1.0, 1.0, 3) * [0.6, 0.3, 0.4] + [0.0, 0.0, rng.choice([-1.2, 1.2])]
        twist = (linear, rng.uniform(-0.3, 0.3, 3))
    exposures = Exposures(
        uptime=times,
        integration_time=settings,
        ambient=air(times) + rng.normal(0.0, 0.02, stations),
        power=1.0 + GAIN_SIGMA * rng.standard_normal(stations),
        station=np.arange(stations),
        true=true,
        told={s.name: reference_error(rng, true[s.name], s.pose_sigma) for s in surfaces},
        frames=frames,
        air=air,
        twist=twist,
    )
    return Scene(name, surfaces, exposures)


Layout = tuple[list[Surface], dict[str, Poses]]


def _wall(rng: np.random.Generator, count: int, *, near: float, far: float, tilt: float) -> Poses:
    direction, size = rng.uniform(0.0, 2.0 * np.pi, count), tilt * np.sqrt(rng.uniform(0.0, 1.0, count))
    tilts = np.stack([size * np.cos(direction), size * np.sin(direction), np.zeros(count)], axis=1)
    distance = rng.uniform(near, far, count)
    return Poses(np.stack([np.zeros(count), np.zeros(count), distance], axis=1), turned(tilts))


def _rich(rng: np.random.Generator, count: int) -> Layout:
    cell = float(np.round(rng.uniform(0.17, 0.30), 3))
    wall = Surface("wall", 0.8, cell=(cell, cell), tiles=texture(rng))
    plate = Surface("plate", 0.85, size=(0.24, 0.18))
    position = np.stack(
        [rng.uniform(-0.14, 0.14, count), rng.uniform(-0.12, 0.12, count), rng.uniform(0.52, 0.95, count)],
        axis=1,
    )
    position[rng.uniform(size=count) < 0.35] = AWAY
    plates = Poses(position, turned(rng.normal(0.0, 6.0, (count, 3)) * [1.0, 1.0, 0.5]))
    return [wall, plate], {"wall": _wall(rng, count, near=1.0, far=4.2, tilt=38.0), "plate": plates}


def _white(rng: np.random.Generator, count: int) -> Layout:
    wall = Surface("wall", 0.8, tiles=np.array([[0.8]]))
    return [wall], {"wall": _wall(rng, count, near=1.0, far=3.9, tilt=36.0)}


def _tilted(rng: np.random.Generator, count: int) -> Layout:
    wall = Surface("wall", 0.8, tiles=np.array([[0.8]]))
    return [wall], {"wall": _wall(rng, count, near=2.4, far=2.6, tilt=46.0)}


def _sweep(rng: np.random.Generator, count: int) -> Layout:
    cell = float(np.round(rng.uniform(0.17, 0.30), 3))
    wall = Surface("wall", 0.8, cell=(cell, cell), tiles=texture(rng))
    poses = _wall(rng, count, near=1.0, far=2.0, tilt=5.0)
    poses.position[:, 2] = np.linspace(0.7, 4.2, count)
    if rng.uniform() < 0.5:
        poses.position[:, 2] = poses.position[::-1, 2].copy()
    return [wall], {"wall": poses}


def _corner(rng: np.random.Generator, count: int) -> Layout:
    """Two planes that meet at a right angle on an upright line; the camera inside looks about into it."""
    cell = float(np.round(rng.uniform(0.25, 0.45), 3))
    left = Surface("left", 0.8, tiles=np.array([[0.8]]))
    right = Surface("right", 0.5, cell=(cell, cell), tiles=0.2 + 0.7 * texture(rng))
    yaw, pitch, roll = (
        rng.uniform(-22.0, 22.0, count),
        rng.uniform(-10.0, 10.0, count),
        rng.normal(0.0, 3.0, count),
    )
    edge = np.stack(
        [rng.uniform(-0.35, 0.35, count), rng.uniform(-0.15, 0.15, count), rng.uniform(1.3, 3.3, count)],
        axis=1,
    )
    view = Rotation.from_euler("zxy", np.stack([roll, pitch, yaw], axis=1), degrees=True)
    poses = {}
    for surface, turn, side in ((left, -45.0, -1.0), (right, 45.0, 1.0)):
        rotation = (view * Rotation.from_euler("y", turn, degrees=True)).as_matrix()
        # the frame's origin lies half a metre off the edge, where the reference instrument has its marks
        poses[surface.name] = Poses(edge + side * 0.5 * rotation[:, :, 0], rotation)
    return [left, right], poses


def _board(rng: np.random.Generator, count: int) -> Layout:
    """A textured board held by hand in front of a wall."""
    board = Surface("board", 0.8, size=(0.84, 0.63), cell=(0.105, 0.105), tiles=texture(rng, (6, 8)))
    wall = Surface("wall", 0.8, tiles=np.array([[0.8]]))
    path = np.cumsum(rng.normal(0.0, [0.11, 0.09, 0.25], (count, 3)), axis=0)
    fold = np.array([0.25, 0.18, 0.75])
    position = fold * (2.0 / np.pi) * np.arcsin(np.sin(path / fold)) + [0.0, 0.0, 1.55]
    tilts = rng.normal(0.0, [17.0, 17.0, 11.0], (count, 3))
    return [board, wall], {
        "board": Poses(position, turned(tilts)),
        "wall": _wall(rng, count, near=2.5, far=3.1, tilt=12.0),
    }


_LAYOUTS: dict[str, Callable[[np.random.Generator, int], Layout]] = {
    "rich": _rich,
    "whitedist": _white,
    "sweep": _sweep,
    "corner": _corner,
    "board": _board,
    "tilted": _tilted,
    "passage": _white,
}
