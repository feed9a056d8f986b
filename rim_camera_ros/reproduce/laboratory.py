"""The laboratory: simulates a set-up and keeps the measurements of the pixels of interest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import NANOSECONDS, Pose, RawFrame
from rim_camera_ros.pipeline.reference import SimulatedReference
from rim_camera_ros.pipeline.simulate import Exposure, Simulation, measured_residual
from rim_camera_ros.rotations import quaternion
from rim_camera_ros.scene import Scene, ScenePose, Station, Surface, load_scene

Array = NDArray[np.float64]
#: Rows and columns of the array that are used.
Region = tuple[slice, slice]
#: Function that is called with a description of the present work.
Progress = Callable[[str], None]
T = TypeVar("T")

#: Integration times of the thesis (sec. 3.3.2), in the register's unit.
SETTINGS = (16, 60, 100)
#: The pixel that the thesis observes with the SR-3000, row/column (sec. 3.3.8).
OBSERVED = (71, 87)
#: The same for the SR-2: column 80, row 62.
OBSERVED_SR2 = (62, 80)
WHITE = 0.85
#: Reflectivity of targets whose amplitudes the thesis does not print: times the gain of the camera files
#: it makes amplitude and incidence effects cancel to a tenth, as sec. 3.3.6 reports of a white plate.
TARGET = 0.88
#: Uptime in s at which a camera is warm: the SR-2 needs 20 min, the SR-3000 6 min (sec. 3.3.8).
WARM = {"sr2": 1200.0, "sr3000": 360.0}


@dataclass(frozen=True)
class Measured:
    """Measurements of the pixels of a region at one station, n frames.

    ``distance`` (n, h, w) [m], in the ambiguity range nearest the nominal one, and ``amplitude`` (n, h, w)
    [counts]; NaN where there is no measurement or the pixel saturates. ``nominal`` (h, w) [m] is the
    distance by the reference instrument along the pixel's ray, ``incidence`` (h, w) [rad]. ``uptime`` [s],
    ``ambient`` [degC] and ``reference`` [m] (n,): settings of the frames, NaN where they have none.
    """

    station: int
    setting: float
    poses: Mapping[str, Pose]
    distance: Array
    amplitude: Array
    nominal: Array
    incidence: Array
    uptime: Array
    ambient: Array
    reference: Array

    @property
    def error(self) -> Array:
        """Measured minus nominal distance (n, h, w) in m."""
        result: Array = self.distance - self.nominal
        return result

    @property
    def mean_error(self) -> float:
        """Mean over frames and pixels of measured minus nominal, in m; NaN where there is none."""
        return mean(self.error)

    @property
    def mean_amplitude(self) -> float:
        """Mean amplitude over frames and pixels in counts."""
        return mean(self.amplitude)

    @property
    def sigma(self) -> float:
        """Standard deviation of a single measurement over the frames in m, pooled over the pixels."""
        valid = np.isfinite(self.distance)
        number = valid.sum(axis=0)
        freedom = int(np.sum(np.maximum(number - 1, 0)))
        if freedom == 0:
            return float("nan")
        values = np.where(valid, self.distance, 0.0)
        spread = np.where(valid, values - values.sum(axis=0) / np.maximum(number, 1), 0.0)
        return float(np.sqrt(np.sum(spread**2) / freedom))

    @property
    def count(self) -> int:
        """Number of valid measurements."""
        return int(np.isfinite(self.distance).sum())


def mean(values: Array) -> float:
    """Return the mean of the finite values, NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def around(pixel: tuple[int, int], reach: int | tuple[int, int]) -> Region:
    """Return the region within ``reach`` (rows, columns) of a pixel given as row, column."""
    rows, columns = (reach, reach) if isinstance(reach, int) else reach
    return (
        slice(pixel[0] - rows, pixel[0] + rows + 1),
        slice(pixel[1] - columns, pixel[1] + columns + 1),
    )


@dataclass
class Laboratory:
    """Simulates set-ups with the shipped cameras; results that several experiments use are cached.

    ``progress`` is called with a description of the present work.
    """

    progress: Progress = lambda words: None
    _kept: dict[str, Any] = field(default_factory=dict)

    def camera(self, name: str) -> Camera:
        """Return a shipped camera by name, without `motion`, as nothing moves during an exposure here.

        Without it the simulation keeps the light of a station from frame to frame.
        """

        def load() -> Camera:
            camera = load_camera(find_camera(name))
            resting = {key: effect for key, effect in camera.effects.items() if key != "motion"}
            return with_effects(replace(camera, covariance=None), resting)

        return self.once(f"camera {name}", load)

    def scene(self, name: str) -> Scene:
        """Return a shipped experiment by name."""
        return self.once(f"scene {name}", lambda: load_scene(find_scene(f"{name}_experiment")))

    def once(self, key: str, make: Callable[[], T]) -> T:
        """Return the cached result of ``make``, which is only called the first time."""
        if key not in self._kept:
            self._kept[key] = make()
        result: T = self._kept[key]
        return result

    def frames(self, simulation: Simulation, words: str) -> Iterator[tuple[Exposure, RawFrame]]:
        """Yield the exposures and frames of a simulation's schedule."""
        timeline = Timeline(simulation.scene, simulation.camera, start=NANOSECONDS)
        for done, exposure in enumerate(timeline):
            if done % 100 == 0:
                self.progress(f"{words}: frame {done} of {timeline.length}")
            yield exposure, simulation.frame(exposure)

    def record(
        self,
        camera: Camera,
        scene: Scene,
        region: Region,
        *,
        seed: int,
        words: str,
        reference: SimulatedReference | None = None,
    ) -> list[Measured]:
        """Simulate a scene's schedule and return the measurements of the region, station by station."""
        simulation = Simulation(camera, scene, seed=seed, reference=reference or SimulatedReference())
        stations = groupby(self.frames(simulation, words), key=lambda pair: pair[0].station)
        return [measured(simulation, list(pairs), region) for _, pairs in stations]


def measured(simulation: Simulation, pairs: Sequence[tuple[Exposure, RawFrame]], region: Region) -> Measured:
    """Return the measurements of a region at one station, from exposures with their frames."""
    camera, first = simulation.camera, pairs[0][0]
    geometry = simulation.geometry(first.poses)
    nominal = geometry.distance[region]
    counts = np.stack([frame.distance[region] for _, frame in pairs]).astype(float)
    amplitude = np.stack([frame.amplitude[region] for _, frame in pairs]).astype(float)
    valid = (counts > 0) & (amplitude < camera.sensor.saturation)
    with np.errstate(invalid="ignore"):
        error = measured_residual(counts * camera.sensor.lsb, nominal, camera)

    def setting(name: str) -> Array:
        values = [getattr(frame.settings, name) for _, frame in pairs]
        return np.array([np.nan if one is None else one for one in values], float)

    return Measured(
        station=first.station,
        setting=camera.integration_time(first.settings),
        poses=first.poses,
        distance=np.where(valid, nominal + error, np.nan),
        amplitude=np.where(valid, amplitude, np.nan),
        nominal=nominal,
        incidence=geometry.incidence[region],
        uptime=setting("uptime"),
        ambient=setting("ambient_temperature"),
        reference=setting("reference_distance"),
    )


# --- scenes ----------------------------------------------------------------------------------------


def facing(z: float, *, x: float = 0.0, y: float = 0.0) -> ScenePose:
    """Return the pose of a surface that faces the camera at x, y, z in m."""
    return ScenePose((x, y, z))


def across(ray: Array, distance: float) -> ScenePose:
    """Return the pose of a surface across a unit ray (3,), its centre on the ray at a distance in m."""
    side = np.cross([0.0, 1.0, 0.0], ray)
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(ray, side), ray], axis=1)
    x, y, z = (float(one) for one in distance * ray)
    return ScenePose((x, y, z), quaternion(rotation))


def plate(reflectivity: float = WHITE, *, size: tuple[float, float] | None = (1.0, 1.0)) -> Surface:
    """Return a plate whose poses are in the schedule; without ``size`` [m] an endless wall."""
    kind: Any = "plane" if size is None else "rectangle"
    return Surface("plate", kind, "truth", size=size, reflectivity=reflectivity)


def stations(
    surface: Surface,
    placed: Sequence[tuple[float, ScenePose]],
    *,
    frames: int,
    uptime: float,
    rate: float = 10.0,
) -> Scene:
    """Return a scene with one surface at one pose after the other, each with its own setting.

    ``uptime`` [s] is that of the first frame; the room has 20 degC.
    """
    lasting = frames / rate
    schedule = tuple(
        Station(
            frames=frames,
            rate=rate,
            integration_time=float(setting),
            uptime=uptime + i * (lasting + 1.0),
            ambient=20.0,
            poses={surface.name: pose},
        )
        for i, (setting, pose) in enumerate(placed)
    )
    return Scene((surface,), schedule=schedule)


def with_frames(scene: Scene, frames: int) -> Scene:
    """Return the scene with so many frames at each station."""
    return replace(scene, schedule=tuple(replace(station, frames=frames) for station in scene.schedule))
