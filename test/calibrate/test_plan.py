"""The plan: what an experiment cannot tell is not claimed, what it tells by design is."""

from __future__ import annotations

import json

import pytest

from rim_camera_ros.calibrate.plan import NARROWED, plan, table
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.scene import load_scene

NAMES = ("board_by_hand_experiment", "cold_start_experiment", "white_wall_experiment")


def test_the_board_and_a_cold_start_go_together() -> None:
    """A board at many distances and angles tells all but drifts, a cold start tells the warm-up."""
    camera = load_camera(find_camera("sr3000"))
    result = plan(camera, {name: load_scene(find_scene(name)) for name in NAMES})
    board, cold, wall = (result.alone[name] for name in NAMES)
    assert board["incidence_angle"] >= NARROWED > wall["incidence_angle"]
    assert cold["warm_up_drift"] >= NARROWED > board["warm_up_drift"]
    assert board["cyclic_error"] > cold["cyclic_error"]
    assert {"board_by_hand_experiment", "cold_start_experiment"} <= set(result.chosen)
    assert "ambient_temperature" in result.open
    assert "shortest plan: board_by_hand_experiment + cold_start_experiment" in table(result)


@pytest.mark.slow
def test_the_command_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--camera", "sr3000", "--json", "--quiet"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "cold_start_experiment" in result["chosen"]


def test_effects_stated_for_pixels_of_the_full_grid_do_not_end_a_plan() -> None:
    scenes = {"integration_times_experiment": load_scene(find_scene("integration_times_experiment"))}
    found = plan(load_camera(find_camera("sr3000_every_effect")), scenes)
    assert found.chosen == ("integration_times_experiment",)
    assert "integration_time_offset" in found.determined
