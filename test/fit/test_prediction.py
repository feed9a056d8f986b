"""Derivatives carried through the optics, and which pixels are compared."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np

from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.signal import Signal
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.light import SpreadLight

from ..calibrate.helpers import camera, record, scene


def test_a_pixel_with_next_to_no_light_is_dark() -> None:
    """A narrow blur lends the neighbours of one lit pixel exp(-0.5 / 0.0725^2) of its light: 5e-42."""
    amplitude = np.zeros((5, 7))
    amplitude[2, 3] = 1000.0
    light = Signal(np.full((5, 7), 1.7), amplitude)
    context: Any = SimpleNamespace(ambiguity=7.49481)
    spread = SpreadLight({"mixed_pixels": light}, context)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before, inverse = spread.through(MixedPixels(0.0725))
    assert np.isfinite(inverse).all()
    assert np.count_nonzero(inverse) == 1
    np.testing.assert_allclose(before[2, 3] * inverse[2, 3], 1.0, rtol=1e-6)


def test_pixels_of_which_noise_hid_the_dark_frames_are_excluded(tmp_path: Path) -> None:
    """Means of the frames that are bright enough are too bright, and a term of the amplitude too small."""
    offset = AmplitudeOffset(MappingProxyType({t: Hyperbola(80.0, 1.5) for t in (16.0, 60.0, 100.0)}))
    truth = camera(tmp_path, offset)
    truth = replace(truth, sensor=replace(truth.sensor, amplitude_threshold=150.0))
    board = scene(tmp_path)
    forward = Forward(record(truth, board, poses=144, wrong=0.0), board, truth)
    forward.estimate_amplitudes()
    # reflectivities that are known to 6 %: the amplitude that terms see is nearly that measured
    forward.amplitude_model = replace(forward.amplitude_model, tau=0.06)
    found = [
        (one.amplitude[one.used], one.residual[one.used], one.sigma[one.used])
        for one in forward.predictions(slopes=False)
    ]
    amplitude, residual, sigma = (np.concatenate(parts) for parts in zip(*found, strict=True))
    darkest = amplitude < amplitude.min() + 15.0
    weight = 1.0 / sigma[darkest] ** 2
    assert abs(np.sum(weight * residual[darkest]) / np.sqrt(np.sum(weight))) < 3.0
