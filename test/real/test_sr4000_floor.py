"""The measure of an SR4000's frames, on a floor made up here and on the recording where it is at hand."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.run import Request, calibrate
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.scene import load_scene

from ..calibrate.floor import floor_camera, write_floor
from .sr4000_floor import frames_of, judged, table, write_half

_GIVEN = os.environ.get("RIM_SR4000", "")


def test_what_was_put_in_is_measured(tmp_path: Path) -> None:
    pattern = 0.004 * np.random.default_rng(3).standard_normal((72, 88)).astype(np.float32)
    camera = floor_camera(
        tmp_path,
        AmplitudeOffset({1.0: Hyperbola(-13.0, 20.0)}),
        FixedPatternOffset(ArrayFile("pattern.npy", pattern)),
        scale=2,
    )
    write_floor(tmp_path / "recording", camera, tmp_path, poses=24)
    found = judged(load_camera(tmp_path / "camera.yaml"), frames_of(None, tmp_path))
    # less a mean of 7 x 7 pixels; what amplitudes bend is smooth
    assert found.rough == pytest.approx(0.004 * np.sqrt(48 / 49), rel=0.1)
    # a A / (A - b)^2 at the amplitude there
    ratio = {limits: value for limits, value in found.slopes.items() if limits[0] >= 1.6}
    assert len(ratio) == 3
    for (low, high), value in ratio.items():
        light = np.concatenate([one.amplitude[one.amplitude > 0] for one in frames_of("even", tmp_path)])
        assert 13.0 / light.max() < value < 13.0 * 1.2 / np.quantile(light, 0.02), (low, high)
    right = judged(camera, frames_of("odd", tmp_path))
    assert right.rough < 0.0008
    assert abs(right.worst_bin) < 0.001
    assert all(abs(value) < 0.003 for value in right.slopes.values())
    assert "by distance [m]" in table(right)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not _GIVEN, reason="RIM_SR4000 names no folder with the recording of the SR4000's floor")
def test_a_calibration_improves_frames_that_it_did_not_see(tmp_path: Path) -> None:
    folder = Path(_GIVEN)
    write_half("even", tmp_path / "even", folder)
    before = load_camera(folder / "camera.yaml")
    scene = load_scene(folder / "scene.yaml")
    # two kinds of tiles, of which nothing is known
    unknown = tuple(replace(one, reflectivity="unknown") for one in scene.surfaces)
    request = Request(
        (tmp_path / "even",), before, replace(scene, surfaces=unknown), effects=("amplitude_offset",)
    )
    result = calibrate(request, integral=False)
    assert result.solution.fit.converged
    assert result.refused == []
    raw, corrected = (judged(one, frames_of("odd", folder)) for one in (before, result.camera))
    at = (2.0, 2.4)
    assert raw.slopes[at] == pytest.approx(0.010, abs=0.002)
    assert abs(corrected.slopes[at]) < 0.004
    assert corrected.pattern < 0.8 * raw.pattern
    assert corrected.rms < raw.rms
