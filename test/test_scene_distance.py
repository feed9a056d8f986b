"""Surfaces keep a distance from the optical centre, which is that of their nearest point."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import pytest

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Surface, load_scene

SCENE = """
format: rim_scene/1
surfaces:
- {name: a, type: plane, pose: {position: [0, 0, 0.001]}}
"""


def test_distances_of_surfaces() -> None:
    """Of the nearest point: triangles of 3, 4, 5 and 5, 12, 13 beside an edge."""
    turned = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))  # by 90 deg about y
    pose = Pose((0.0, 0.0, 5.0), (0.0, 0.0, 0.0, 1.0))
    assert Surface("a", "plane", "truth").distance(pose) == pytest.approx(5.0)
    assert Surface("a", "plane", "truth").distance(Pose((4.0, 0.0, 3.0), turned)) == pytest.approx(4.0)
    beside = Pose((1.0 + 3.0, 2.0 + 4.0, 12.0), (0.0, 0.0, 0.0, 1.0))
    assert Surface("a", "rectangle", "truth", size=(2.0, 4.0)).distance(beside) == pytest.approx(13.0)
    assert Surface("a", "rectangle", "truth", size=(9.0, 13.0)).distance(beside) == pytest.approx(12.0)
    edge_on = Pose((0.0, 0.0, 2.0), turned)
    assert Surface("a", "disc", "truth", radius=0.5).distance(edge_on) == pytest.approx(1.5)
    assert Surface("a", "sphere", "truth", radius=2.0).distance(pose) == pytest.approx(3.0)
    assert Surface("a", "sphere", "truth", radius=7.0).distance(pose) == pytest.approx(2.0)


def test_the_nearest_surface_simulates_without_a_warning(tmp_path: Path) -> None:
    """It saturates, by 500 * 16 * 0.8 / 0.001^2 counts."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    near, camera = load_scene(tmp_path / "scene.yaml"), load_camera(find_camera("sr3000"))
    exposure = Exposure(10**9, Settings(integration_time=16.0, uptime=3600.0), near.fixed_poses())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = Simulation(camera, near, seed=1).frame(exposure)
    assert (frame.amplitude == camera.sensor.saturation).all()
