"""An emitter beside the lens, of which only the second order shows: the fixed pattern takes up the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene

PLACE = (0.11, -0.04, 0.0)


def test_an_emitter_is_found_where_its_linearisation_at_the_lens_is_blind(tmp_path: Path) -> None:
    """Amplitudes tell nothing of it (reflectivities unknown); |e|^2 / 4 d is 5.7 mm at 0.6 m."""
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(camera(tmp_path, EmitterOffset(PLACE)), board, poses=30)
    unknown = replace(
        board, surfaces=tuple(replace(one, reflectivity="unknown", texture=None) for one in board.surfaces)
    )
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    result = search(Problem(data, unknown), stated, facts, effects=["emitter_offset", "distance_scale"])
    first = result.explorations[0]
    gains = {
        one.variant: (float(gain), float(need))
        for one, gain, need in zip(first.candidates, first.gains, first.thresholds, strict=False)
        if one.effect == "emitter_offset"
    }
    at_lens = gains.pop("")
    assert at_lens[0] < at_lens[1]
    assert max(gain - need for gain, need in gains.values()) > 0
    assert [one.effect for one in result.found] == ["emitter_offset"]
    fitted = result.camera.effects["emitter_offset"]
    assert isinstance(fitted, EmitterOffset)
    assert abs(np.hypot(*fitted.position[:2]) - np.hypot(*PLACE[:2])) < 0.02
