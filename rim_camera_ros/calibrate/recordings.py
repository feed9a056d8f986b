"""Recordings to stations, here or on the workers of a Dask cluster; several scenes as one; progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.scene import TRUTH, Scene, ScenePose, Surface
from rim_camera_ros.select.trials import Workers

#: Reports progress: the task, how much of it is done, of how much (None: unknown).
Progress = Callable[[str, int | None, int | None], None]
#: Reduces the recordings to stations, in their order.
Reducer = Callable[[Sequence[Path], Camera, Topics | None, Sequence[Scene]], Sequence[Dataset]]


class Cancelled(RimError):
    """The work was cancelled; nothing was written."""


class Watch:
    """Reports progress and ends the work where it is cancelled."""

    def __init__(self, progress: Progress | None, cancelled: Callable[[], bool] | None) -> None:
        self._progress = progress
        self._cancelled = cancelled

    def tick(self) -> None:
        """Raise `Cancelled` where the work is to end."""
        if self._cancelled is not None and self._cancelled():
            raise Cancelled("cancelled; nothing was written")

    def say(self, text: str) -> None:
        """Report the task that begins now. Raises `Cancelled`."""
        self.tick()
        if self._progress is not None:
            self._progress(text, None, None)

    def ticking(self, text: str) -> Callable[[], None]:
        """Report the task that begins now, and return the function that its loop must call."""
        self.say(text)
        return self.tick

    def reducer(self, total: int) -> Reducer:
        """Return the reduction in this process, one recording after the other."""
        done = [0]

        def watched(frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
            for frame in frames:
                self.tick()
                yield frame
                done[0] += 1
                if self._progress is not None:
                    self._progress("reading frames", done[0], total)

        def reduce_all(
            paths: Sequence[Path], camera: Camera, topics: Topics | None, scenes: Sequence[Scene]
        ) -> list[Dataset]:
            return [
                reduce_recording(path, camera, topics=topics, scene=scene, progress=watched)
                for path, scene in zip(paths, scenes, strict=True)
            ]

        return reduce_all


#: Times that a task is given to another worker when one is lost.
_RETRIES = 3
_CONNECT_SECONDS = 10


@contextmanager
def on_workers(scheduler: str | None) -> Iterator[Workers]:
    """Yield a function that maps a function over items on a cluster, with results in the order of the items.

    Without a ``scheduler`` the calls are made in this process, one after the other. Raises `InputError` where
    dask.distributed is not installed or the scheduler does not answer; the map raises what the function
    raises, and `RimError` where the cluster fails.
    """
    if scheduler is None:
        yield map
        return
    try:
        import distributed
    except ImportError:
        raise InputError(
            "--scheduler needs dask.distributed", remedy="pip install 'rim_camera_ros[cluster]'"
        ) from None
    try:
        cluster: Any = distributed
        client = cluster.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no scheduler answers: {type(error).__name__}",
            place=f"--scheduler {scheduler}",
            remedy="start one with dask-scheduler and give its address, tcp://HOST:8786",
        ) from None

    def call(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        futures = [client.submit(function, item, retries=_RETRIES, pure=False) for item in items]
        for future in futures:
            try:
                yield future.result()
            except RimError:
                raise
            except Exception as error:
                raise RimError(
                    f"the cluster failed: {type(error).__name__}: {error}",
                    remedy="workers need this package and the same paths",
                ) from None

    with client:
        yield call


def reduce_on_cluster(
    paths: Sequence[Path],
    camera: Camera,
    scenes: Sequence[Scene],
    *,
    topics: Topics | None = None,
    scheduler: str,
) -> list[Dataset]:
    """Return the stations of each recording, reduced on a cluster whose workers see the same files.

    Raises what `on_workers` and the reduction raise.
    """
    works = [
        partial(reduce_recording, path.absolute(), camera, topics=topics, recording=number, scene=scene)
        for number, (path, scene) in enumerate(zip(paths, scenes, strict=True))
    ]
    with on_workers(scheduler) as workers:
        parts = list(workers(_done, works))
    for part, path in zip(parts, paths, strict=True):
        part.files = [str(path)]
    return parts


def _done(work: Callable[[], Dataset]) -> Dataset:
    return work()


class JoinedScene(Scene):
    """The surfaces of several scenes. A surface without a known pose is absent."""

    def poses_for(self, truth: Mapping[str, Pose]) -> dict[str, Pose]:
        """Return the poses of those surfaces that the recording sees."""
        return {name: truth[name] for name in self.needs_truth if name in truth}


def joined(scenes: Sequence[Scene], datasets: Sequence[Dataset]) -> tuple[Scene, list[Dataset]]:
    """Return one scene for recordings of one scene each, and the recordings with poses of its surfaces.

    A surface that several scenes describe alike is one; a name that means another surface in another scene
    gets the scene's number: ``wall (2)``. Raises `InputError` where scenes differ in the camera's motion, or
    one estimates a pose (``free``).
    """
    first = scenes[0]
    if all(one == first for one in scenes):
        return first, list(datasets)
    surfaces: dict[str, Surface] = {}
    placed = []
    for scene, dataset in zip(scenes, datasets, strict=True):
        _require_joinable(scene, first)
        names = {}
        for surface in scene.surfaces:
            there = replace(surface, pose=TRUTH)
            name = surface.name
            if name in surfaces and surfaces[name] != there:
                name = f"{name} ({list(scenes).index(scene) + 1})"
                there = replace(there, name=name)
            surfaces[name] = there
            names[surface.name] = name
        stations = [
            replace(station, truth={names[k]: pose for k, pose in scene.poses_for(station.truth).items()})
            for station in dataset.stations
        ]
        placed.append(replace(dataset, stations=stations))
    light = max(one.stray_light for one in scenes)
    joint = JoinedScene(tuple(surfaces.values()), camera_motion=first.camera_motion, stray_light=light)
    return joint, placed


def takes_schedule(scene: Scene, recorded: Set[str], recordings: int) -> bool:
    """Return whether so many recordings, with poses of ``recorded`` surfaces, take those of the schedule."""
    needed = set(scene.needs_truth)
    return bool(needed) and not needed & recorded and len(scene.schedule) == recordings


def placed_by_schedule(datasets: Sequence[Dataset], scenes: Sequence[Scene]) -> list[str]:
    """Give recordings without poses, one for each station of their scene's schedule, the poses of that.

    The recordings must be in the order of the stations. Returns notes on this.
    """
    scene = scenes[0]
    needed = scene.needs_truth
    recorded = {name for dataset in datasets for one in dataset.stations for name in one.truth}
    if any(one != scene for one in scenes) or not takes_schedule(scene, recorded, len(datasets)):
        return []
    poses: dict[str, Pose] = {}
    for dataset, station in zip(datasets, scene.schedule, strict=True):
        poses = poses | {name: pose.pose for name, pose in station.poses.items() if name in needed}
        dataset.stations = [replace(one, truth=poses) for one in dataset.stations]
    return [
        f"the recordings hold no pose: that of {' and '.join(needed)} is taken from the scene file's "
        "schedule, a station for each recording, and is free within pose_sigma"
    ]


def _require_joinable(scene: Scene, first: Scene) -> None:
    if scene.camera_motion != first.camera_motion:
        raise InputError(
            "the scenes state different motions of the camera",
            place="camera_motion",
            remedy="calibrate motion from recordings of one scene",
        )
    free = [
        surface.name
        for surface in scene.surfaces
        if isinstance(surface.pose, ScenePose) and surface.pose.free
    ]
    if free:
        raise InputError(
            f"the pose of '{free[0]}' is to be estimated, which takes one scene for all recordings",
            place="free",
            remedy="calibrate that recording alone, or state the pose",
        )
