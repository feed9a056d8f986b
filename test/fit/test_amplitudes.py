"""Powers of the poses and how well amplitudes are predicted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.fit.forward import Forward

from ..calibrate.helpers import camera, record, scene


def test_amplitudes_beyond_what_a_response_can_reach_tell_no_power(tmp_path: Path) -> None:
    """P = A / (1 + c A) stays below 1 / c: of a pixel that published more no light is known."""
    board = scene(tmp_path)
    data = record(camera(tmp_path), board, poses=4, frames=2, seed=2)
    # in each pose some pixels are above
    highest = min(float(one.amplitude.max()) for one in data.stations)
    forward = Forward(data, board, camera(tmp_path, AmplitudeNonlinearity(compression=1.05 / highest)))
    model = forward.estimate_amplitudes()
    assert len(model.gains) == 4
    assert np.all(np.isfinite(list(model.gains.values())))
    assert np.isfinite(model.tau)
    # without a response all are known: powers as simulated, to the 1 % that they vary
    straight = Forward(data, board, camera(tmp_path)).estimate_amplitudes()
    assert list(straight.gains.values()) == pytest.approx([1.0] * 4, abs=0.04)
