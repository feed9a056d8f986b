"""Derivatives carried through the optics."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np

from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.signal import Signal
from rim_camera_ros.fit.prediction import Prediction


def test_a_pixel_with_next_to_no_light_is_dark() -> None:
    """A narrow blur lends the neighbours of one lit pixel exp(-0.5 / 0.0725^2) of its light: 5e-42."""
    amplitude = np.zeros((5, 7))
    amplitude[2, 3] = 1000.0
    light = Signal(np.full((5, 7), 1.7), amplitude)
    context = SimpleNamespace(ambiguity=7.49481)
    one: Any = SimpleNamespace(_images={}, before={"mixed_pixels": light}, context=context)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before, inverse = Prediction._through(one, MixedPixels(0.0725))
    assert np.isfinite(inverse).all()
    assert np.count_nonzero(inverse) == 1
    np.testing.assert_allclose(before[2, 3] * inverse[2, 3], 1.0, rtol=1e-6)
