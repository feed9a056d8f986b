"""A wall and a tape measure: recordings without poses, each at the distance that the schedule states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.files import find_scene
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import load_scene
from test.calibrate import helpers
from test.helpers_cli import run

FALLOFF = (-0.9, 0.3)


def recorded(folder: Path) -> list[Path]:
    """Recordings at the marks, which the tape missed by 3 mm, of a wall that is not quite perpendicular."""
    truth = helpers.camera(folder, EmissionPattern(FALLOFF))
    scene = load_scene(find_scene("wall_and_tape"))
    rng = np.random.default_rng(5)
    bags = []
    for number, station in enumerate(scene.schedule):
        distance = station.poses["wall"].position[2] + rng.normal(0, 0.003)
        about_x, about_y = rng.normal(0, 0.02, 2) / 2
        pose = Pose((0.0, 0.0, distance), quaternion(rotation_matrix((about_x, about_y, 0.0, 1.0))))
        simulation = Simulation(truth, scene, seed=number)
        bags.append(folder / f"wall_{number + 1}")
        with RecordingWriter(bags[-1]) as writer:
            for k in range(6):
                settings = Settings(integration_time=60.0, modulation_frequency=20e6, uptime=1200.0 + number)
                exposure = Exposure(1 + 40_000_000 * k, settings, {"wall": pose}, 0, 1)
                writer.write_raw(replace(simulation.frame(exposure), truth={}, pose_stamps={}))
    return bags


@pytest.mark.slow
def test_a_tape_suffices_for_the_lobe(tmp_path: Path, capsys: Any) -> None:
    bags = recorded(tmp_path)
    options = (
        "--scene",
        "wall_and_tape",
        "--camera",
        tmp_path / "camera.yaml",
        "--effects",
        "emission_pattern",
    )
    status, _, notes = run(capsys, "calibrate", *bags, *options, "--out", tmp_path / "mine.yaml")
    assert status == 0, notes
    assert "that of wall is taken from the scene file's schedule" in notes
    mine = load_camera(tmp_path / "mine.yaml")
    found = mine.effects["emission_pattern"]
    assert isinstance(found, EmissionPattern)
    assert mine.covariance is not None
    paths = list(mine.covariance.parameters)
    at = [paths.index(f"effects.emission_pattern.falloff.{k}") for k in (0, 1)]
    covariance = np.asarray(mine.covariance.matrix.values)[np.ix_(at, at)]
    error = np.array(found.falloff) - FALLOFF
    # chi-square of two numbers: beyond 13.8 once in a thousand
    assert error @ np.linalg.solve(covariance, error) < 13.8
    # a quarter of what is not known without a recording
    assert np.sqrt(covariance[0, 0]) < 0.5


def test_another_number_of_recordings_than_marks_is_refused(tmp_path: Path, capsys: Any) -> None:
    bags = recorded(tmp_path)[:4]
    options = (
        "--scene",
        "wall_and_tape",
        "--camera",
        tmp_path / "camera.yaml",
        "--out",
        tmp_path / "mine.yaml",
    )
    status, _, error = run(capsys, "calibrate", *bags, *options)
    assert (status, len(error.splitlines())) == (2, 1)
    assert "or give one recording for each station of its schedule" in error
