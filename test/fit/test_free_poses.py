"""Poses that a scene leaves free: estimated with the model, in every fit of a search and of a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.accuracy import accuracy
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, load_scene
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.search import search
from test.calibrate.helpers import camera

SCENE = """
format: rim_scene/1
surfaces:
- {name: board, type: rectangle, size: [0.8, 0.7], pose: truth, reflectivity: 0.6}
- name: wall
  type: plane
  reflectivity: 0.5
  pose: {position: [0.0, 0.0, 4.0], orientation: [0.0, 0.0, 0.0, 1.0], free: [z, pitch]}
"""

#: How far the file's wall is from where it stands [m], and about the x axis [rad].
AWAY, TURNED = 0.04, 0.01


def scenes(tmp_path: Path) -> tuple[Scene, Scene]:
    """The scene as it is, and as its file says."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    true = load_scene(tmp_path / "scene.yaml")
    board, wall = true.surfaces
    turned = (np.sin(TURNED / 2), 0.0, 0.0, np.cos(TURNED / 2))
    pose = ScenePose((0.0, 0.0, 4.0 + AWAY), orientation=turned, free=("z", "pitch"))
    return true, replace(true, surfaces=(board, replace(wall, pose=pose)))


def recorded(true: Camera, scene: Scene) -> Dataset:
    rng = np.random.default_rng(3)
    simulation = Simulation(true, scene, seed=1)
    settings = Settings(integration_time=60.0, modulation_frequency=20e6)
    frames = []
    for station in range(12):
        x, y = rng.normal(0, 0.2, 2)
        pose = Pose((float(x), float(y), 1.2 + 0.15 * station), (0.0, 0.0, 0.0, 1.0))
        stamp = station * 10_000_000_000 + 1
        for k in range(3):
            exposure = Exposure(
                stamp=stamp + k * 40_000_000,
                settings=settings,
                poses={**scene.fixed_poses(), "board": pose},
                station=station,
                pose_stamp=stamp,
            )
            frames.append(replace(simulation.frame(exposure), truth={"board": pose}))
    return Dataset(list(reduce_frames(frames, true)), frames=len(frames))


def test_a_warm_fit_begins_where_the_free_pose_was(tmp_path: Path) -> None:
    true, stated = scenes(tmp_path)
    data = recorded(camera(tmp_path), true)
    problem = Problem(data, stated, effects=())
    cold = fit(problem, camera(tmp_path), fold_of=folds_of(data))
    assert cold.parameters["scene.wall.z"] == pytest.approx(-AWAY, abs=0.001)
    assert cold.parameters["scene.wall.pitch"] == pytest.approx(-TURNED, abs=0.001)
    same = replace(problem, masks=cold.forward.pixels_used())
    for iterations in (0, 12):
        warm = fit(same, cold.camera, views=cold.forward.views, warm=cold, iterations=iterations)
        for name in ("scene.wall.z", "scene.wall.pitch"):
            assert warm.parameters[name] == pytest.approx(cold.parameters[name], abs=1e-5)
        assert warm.chi_square / warm.reduced.expected == pytest.approx(11 / 12, abs=0.05)


@pytest.mark.long
@pytest.mark.parametrize("effect", [None, CyclicError(harmonics=(Harmonic(4, 0.006, 0.7),))])
def test_a_search_finds_the_same_wherever_the_file_puts_the_wall(
    tmp_path: Path, effect: Effect | None
) -> None:
    true, stated = scenes(tmp_path)
    known = camera(tmp_path)
    data = recorded(known if effect is None else camera(tmp_path, effect), true)
    facts = Facts.of(data, moves=False, surfaces=2, camera=known)
    found, held_out = [], []
    for scene in (true, stated):
        result = search(
            Problem(data, scene), known, facts, effects=["cyclic_error", "distance_scale"], most=2
        )
        found.append({one.effect: one.gain for one in result.found})
        held_out.append(accuracy(known, result.fit.camera, result))
        wall = result.fit.scene.surfaces[1].pose
        assert isinstance(wall, ScenePose)
        assert wall.position[2] == pytest.approx(4.0, abs=0.001)
    assert list(found[0]) == ([] if effect is None else ["cyclic_error"])
    assert found[1] == pytest.approx(found[0], rel=0.02)
    assert held_out[1].rms_before == pytest.approx(held_out[0].rms_before, rel=0.01)
    assert held_out[1].rms_after == pytest.approx(held_out[0].rms_after, rel=0.01)
    assert held_out[1].chi2_after == pytest.approx(held_out[0].chi2_after, rel=0.02)
    assert held_out[1].rms_after == pytest.approx(held_out[1].noise_floor, rel=0.03)
