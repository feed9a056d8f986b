"""What follows from a finished adjustment: cameras moved by steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.solution import moved_by
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern

from .helpers import camera


def test_a_change_is_made_as_far_as_it_leads_to_a_possible_camera(tmp_path: Path) -> None:
    start = camera(tmp_path, EmissionPattern((-1.2, 0.0)), DistanceScale(0.001))
    whole = moved_by(
        start, {"effects.emission_pattern.falloff.0": 0.3, "effects.distance_scale.scale": 0.002}
    )
    assert whole.effects["emission_pattern"].falloff[0] == pytest.approx(-0.9)  # type: ignore[attr-defined]
    assert whole.effects["distance_scale"].scale == pytest.approx(0.003)  # type: ignore[attr-defined]
    # at 0.33 rad^2 in the corner the light would be gone: all parameters move by the same share
    part = moved_by(
        start, {"effects.emission_pattern.falloff.0": -8.0, "effects.distance_scale.scale": 0.004}
    )
    falloff = part.effects["emission_pattern"].falloff[0]  # type: ignore[attr-defined]
    scale = part.effects["distance_scale"].scale  # type: ignore[attr-defined]
    assert -9.2 < falloff < -1.2
    assert (falloff + 1.2) / -8.0 == pytest.approx((scale - 0.001) / 0.004)
    power = part.effects["emission_pattern"].power(part)  # type: ignore[attr-defined]
    assert 0.0 < np.min(power) < 0.5
    assert moved_by(start, {"scene.board.x": 1.0}) == start
