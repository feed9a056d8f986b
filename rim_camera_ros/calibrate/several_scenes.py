"""Recordings of different scenes in one adjustment: all surfaces in one, each recording with its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose
from rim_camera_ros.scene import TRUTH, Scene, ScenePose, Surface


class JoinedScene(Scene):
    """The surfaces of several scenes. A surface without a known pose is not there."""

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
            replace(one, truth={names[k]: pose for k, pose in scene.poses_for(one.truth).items()})
            for one in dataset.stations
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
    """Give recordings that hold no pose, one for each station of their scene's schedule, the poses of it.

    The recordings are those of the stations in their order. Returns what is to be said of it.
    """
    scene = scenes[0]
    needed = scene.needs_truth
    recorded = {name for dataset in datasets for one in dataset.stations for name in one.truth}
    if any(one != scene for one in scenes) or not takes_schedule(scene, recorded, len(datasets)):
        return []
    poses: dict[str, Pose] = {}
    for dataset, station in zip(datasets, scene.schedule, strict=True):
        poses = poses | {name: one.pose for name, one in station.poses.items() if name in needed}
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
    free = [one.name for one in scene.surfaces if isinstance(one.pose, ScenePose) and one.pose.free]
    if free:
        raise InputError(
            f"the pose of '{free[0]}' is to be estimated, which takes one scene for all recordings",
            place="free",
            remedy="calibrate that recording alone, or state the pose",
        )
