"""Poses that are off from what was recorded, and those that only look so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from rim_camera_ros.calibrate.checks import with_plausible_poses
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola

from .helpers import camera, record, scene


@pytest.mark.parametrize("wrong", [0.0, 0.9])
def test_an_error_that_grows_as_the_light_goes_is_no_wrong_pose(tmp_path: Path, wrong: float) -> None:
    # at 4.5 m this camera measures up to a metre too much: one by the amplitude
    rows = MappingProxyType(
        {16.0: Hyperbola(30.0, 0.0), 60.0: Hyperbola(90.0, 0.0), 100.0: Hyperbola(120.0, 0.0)}
    )
    truth = camera(tmp_path, AmplitudeOffset(rows))
    board = scene(tmp_path)
    data = record(truth, board, poses=36, frames=1, seed=4)
    stated = data.stations[7].truth["board"]
    x, y, z = stated.position
    moved = replace(stated, position=(x, y, z + wrong))
    data.stations[7] = replace(data.stations[7], truth={"board": moved})
    plain = replace(truth, effects={})
    kept = with_plausible_poses(data, board, plain, lambda: None)
    if not wrong:
        assert kept is data
        return
    assert len(kept.stations) == 35
    assert kept.notes[-1].startswith(
        "simulated: excluded 1 of 36 poses that are off from what was recorded: "
    )
    assert "'board' in pose 7 at 385.0 s by -" in kept.notes[-1]
