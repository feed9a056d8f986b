"""Frames become stations: poses, placements, settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import of_known_exposure, reduce_frames
from rim_camera_ros.select.evidence import folds_of

from ..calibrate.bags import frames
from ..calibrate.helpers import camera, scene


def test_a_pose_stated_again_unchanged_is_the_same_placement(tmp_path: Path) -> None:
    truth = camera(tmp_path)
    taken = list(frames(truth, scene(tmp_path), poses=4, repeats=2, seed=1))
    first, second, third, fourth = (one.truth for one in taken[::2])
    # the second pose is stated a second time, as it was; the first one comes back later
    stated = [first, second, second, first]
    again = [replace(one, truth=stated[k // 2]) for k, one in enumerate(taken)]
    stations = list(reduce_frames(again, truth))
    assert [one.pose for one in stations] == [0, 1, 2, 3]
    assert [one.placed for one in stations] == [0, 1, 1, 2]
    folds = folds_of(Dataset(stations))
    assert folds[0, 1] == folds[0, 2]
    assert len(set(folds.values())) == 3
    assert third != fourth


def test_a_stuck_pixel_is_one_occurrence_of_its_code(tmp_path: Path) -> None:
    """Its code would be frequent, without neighbours, as where a read-out has missing codes."""
    truth = camera(tmp_path)
    taken = list(frames(truth, scene(tmp_path), poses=4, repeats=10, seed=1))
    for one in taken:
        one.distance[7, 9] = 61_234
    codes = np.zeros(65536, np.int64)
    list(reduce_frames(taken, truth, codes=codes))
    others = np.stack([one.distance for one in taken])
    others[:, 7, 9] = 0
    assert codes[61_234] == 1 + (others == 61_234).sum()
    # of noise of many counts hardly a value is that of the frame before
    assert codes.sum() > 0.95 * others.size


def test_frames_whose_settings_were_lost_are_excluded(tmp_path: Path) -> None:
    truth = camera(tmp_path)
    taken = list(frames(truth, scene(tmp_path), poses=3, repeats=4, seed=1))
    without = {0, 1, 6, 11}
    lossy = [
        replace(one, settings=replace(one.settings, integration_time=None)) if k in without else one
        for k, one in enumerate(taken)
    ]
    kept = [one.stamp for one in of_known_exposure(lossy)]
    assert kept == [one.stamp for k, one in enumerate(taken) if k not in without]
    assert list(of_known_exposure(taken)) == taken
    # a camera that never says it: the camera file must, and the frames are all there, in their order
    mute = [replace(one, settings=replace(one.settings, integration_time=None)) for one in taken]
    for number in (3, len(mute)):
        assert list(of_known_exposure(mute[:number])) == mute[:number]
    many = [mute[0]] * 70
    assert len(list(of_known_exposure(many))) == 70


def test_either_image_may_hold_counts(tmp_path: Path) -> None:
    truth = camera(tmp_path)
    taken = list(frames(truth, scene(tmp_path), poses=1, repeats=6, seed=1))
    rng = np.random.default_rng(2)
    light = [(0.6 + 0.3 * rng.random(truth.shape)).astype(np.float32) for _ in taken]
    for one in light:
        one[3, 5] = np.nan
    counts = [replace(one, amplitude=a) for one, a in zip(taken, light, strict=True)]
    lsb = np.float32(truth.sensor.lsb)
    metres = [replace(one, distance=one.distance * lsb) for one in counts]
    whole, real = (next(iter(reduce_frames(kind, truth))) for kind in (counts, metres))
    others = np.stack(light)[:, 7, 9].astype(float)
    assert whole.amplitude[7, 9] == pytest.approx(others.mean(), rel=1e-6)
    assert whole.amplitude_variance[7, 9] == pytest.approx(others.var(ddof=1), rel=1e-5)
    # no amplitude, no measurement
    assert whole.count[3, 5] == real.count[3, 5] == 0
    assert np.isnan(whole.distance[3, 5])
    assert whole.amplitude == pytest.approx(real.amplitude, rel=1e-6)
    assert whole.distance[7, 9] == pytest.approx(real.distance[7, 9], abs=1e-6)
