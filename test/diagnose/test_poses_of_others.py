"""Poses of surfaces that a scene does not have, or has at rest, change nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.frame import Pose
from rim_camera_ros.scene import load_scene
from rim_camera_ros.select.evidence import folds_of

from .helpers import CAMERA, CYCLIC, run, scene_text

FLOOR = (
    "- {name: floor, type: plane, "
    "pose: {position: [0.0, 1.1, 3.0], orientation: [0.7071, 0.0, 0.0, 0.7071]}}\n"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "camera.yaml").write_text(CAMERA + CYCLIC)
    (tmp_path / "scene.yaml").write_text(scene_text())
    (tmp_path / "floor.yaml").write_text(scene_text().replace("schedule:\n", FLOOR + "schedule:\n"))
    run("simulate", tmp_path / "scene.yaml", camera=tmp_path / "camera.yaml", out=tmp_path / "bag", seed=3)
    return tmp_path


def rewritten(folder: Path, name: str, *, head: bool = False, poses: bool = True) -> Path:
    """Write the recording again: with the pose of a head that moves, or without any."""
    with Recording(folder / "bag") as given, RecordingWriter(folder / name) as writer:
        for number, frame in enumerate(given.frames()):
            truth, stamps = dict(frame.truth), dict(frame.pose_stamps)
            if head:
                truth["head"] = Pose((0.1, 0.01 * number, 1.5), (0.0, 0.0, 0.0, 1.0))
                stamps["head"] = frame.stamp
            if not poses:
                truth, stamps = {}, {}
            writer.write_raw(replace(frame, truth=truth, pose_stamps=stamps))
    return folder / name


def test_a_surface_that_the_scene_lacks_makes_no_poses(folder: Path) -> None:
    camera, scene = load_camera(folder / "camera.yaml"), load_scene(folder / "scene.yaml")
    bag = rewritten(folder, "head", head=True)
    parts = [reduce_recording(path, camera, scene=scene) for path in (folder / "bag", bag)]
    assert len(reduce_recording(bag, camera).stations) > len(parts[0].stations) == 18
    own, other = ([(one.pose, one.placed, one.frames) for one in part.stations] for part in parts)
    assert own == other
    assert folds_of(parts[0]) == folds_of(parts[1])


def test_a_simulation_like_it_has_the_stations_of_the_recording(folder: Path) -> None:
    bag = rewritten(folder, "head", head=True)
    names = {"camera": folder / "camera.yaml", "poses": bag}
    run("simulate", folder / "scene.yaml", out=folder / "again", **names)
    with Recording(folder / "again") as again:
        assert len({tuple(frame.pose_stamps.items()) for frame in again.frames()}) == 18


@pytest.mark.slow
def test_what_is_at_rest_in_the_scene_needs_no_pose_in_the_recording(folder: Path) -> None:
    """Its simulation has one all the same, and is still a simulation of that recording."""
    names = {"camera": folder / "camera.yaml"}
    run("simulate", folder / "floor.yaml", out=folder / "again", poses=folder / "bag", **names)
    names |= {"scene": folder / "floor.yaml", "against": folder / "again"}
    run("diagnose", folder / "bag", out=folder / "out", **names)
    assert (folder / "out" / "report.json").exists()


def test_a_scene_at_rest_is_one_pose_without_any_in_the_recording(folder: Path) -> None:
    text = scene_text().replace("pose: truth", "pose: {position: [0.0, 0.0, 2.0]}")
    (folder / "rest.yaml").write_text(text[: text.index("schedule:")])
    bag = rewritten(folder, "none", poses=False)
    run("simulate", folder / "rest.yaml", camera=folder / "camera.yaml", out=folder / "again", poses=bag)
    camera, scene = load_camera(folder / "camera.yaml"), load_scene(folder / "rest.yaml")
    parts = [reduce_recording(path, camera, scene=scene) for path in (bag, folder / "again")]
    assert parts[0].poses == parts[1].poses == 1
    assert len(parts[0].stations) == len(parts[1].stations)
