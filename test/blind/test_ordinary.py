"""Imperfections are put into a recording as large as they are said to be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene

from ..calibrate.helpers import camera, scene
from .ordinary import IMPERFECTIONS, View, views


def seen(tmp_path: Path) -> list[View]:
    """Three frames of a board of 1.2 x 0.9 m at two poses, the first one frontal at 1.5 m."""
    model = with_effects(camera(tmp_path), {"amplitude_offset": AmplitudeOffset({1.0: Hyperbola(4.0, 0.0)})})
    surface = replace(scene(tmp_path).surfaces[0], type="rectangle", size=(1.2, 0.9))
    board = Scene((surface,))
    simulation = Simulation(model, board, seed=3)
    settings = Settings(integration_time=60.0, modulation_frequency=20e6)
    frames: list[RawFrame] = []
    for number, pose in enumerate([Pose((0.0, 0.0, 1.5)), Pose((0.0, 0.0, 1.5)), Pose((0.1, 0.0, 1.7))]):
        exposure = Exposure(
            stamp=number + 1, settings=settings, poses={"board": pose}, station=0, pose_stamp=1
        )
        frames.append(replace(simulation.frame(exposure), truth={"board": pose}))
    return views(frames, surface, model)


def test_poses_and_coordinates(tmp_path: Path) -> None:
    first, second, third = seen(tmp_path)
    assert [view.pose for view in (first, second, third)] == [0, 0, 1]
    # 1.2 m at 1.5 m and 50 px focal length are 40 px, 0.9 m are 30 px
    assert first.on.sum() == pytest.approx(40 * 30, rel=0.1)
    assert np.ptp(first.x[17, first.on[17]]) == pytest.approx(2 * 39 / 40, abs=0.03)


def test_sizes(tmp_path: Path) -> None:
    view, _, other = seen(tmp_path)
    count = view.camera.sensor.lsb

    def change(name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return (IMPERFECTIONS[name](view).distance.astype(float) - view.frame.distance) * count

    bow = change("a board that bows by 5 mm")
    middle, corner = view.on & (np.hypot(view.x, view.y) < 0.2), view.on & (view.x**2 + view.y**2 > 1.8)
    assert np.median(bow[middle]) == pytest.approx(0.005, abs=0.0003)
    assert np.median(np.abs(bow[corner])) < 0.001
    assert not bow[~view.on].any()
    hand = change("a hand over 8 % of the board") < -0.05
    assert hand.sum() == pytest.approx(0.08 * view.on.sum(), rel=0.35)
    stuck = [IMPERFECTIONS["0.2 % of the pixels stuck"](one).distance for one in (view, other)]
    same = (stuck[0] == stuck[1]) & (stuck[0] != view.frame.distance)
    assert 1 <= same.sum() <= 8
    dust = IMPERFECTIONS["dust that takes 15 % of the light"](view)
    ratio = dust.amplitude / np.maximum(view.frame.amplitude, 1)
    ratio[~view.on] = 1.0
    assert ratio.min() == pytest.approx(0.85, abs=0.02)
    # a term of 4 m counts over 15 % less light
    darkest = np.unravel_index(np.argmin(ratio), ratio.shape)
    bright = float(view.frame.amplitude[darkest])
    moved = (dust.distance.astype(float) - view.frame.distance)[darkest] * count
    noise = view.camera.noise.sigma_distance(np.array([0.85 * bright]))[0]
    assert moved == pytest.approx(4.0 / (0.85 * bright) - 4.0 / bright, abs=4 * noise)
    power = IMPERFECTIONS["power that differs by 3 % from pose to pose"]
    gains = [np.median(power(one).amplitude[one.on] / one.frame.amplitude[one.on]) for one in (view, other)]
    assert gains[0] != gains[1]
    assert np.abs(np.log(gains)).max() < 0.12


def test_sizes_of_what_is_before_the_scene(tmp_path: Path) -> None:
    view, same_pose, _ = seen(tmp_path)
    count = view.camera.sensor.lsb

    def changed(name: str, one: View) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return (IMPERFECTIONS[name](one).distance.astype(float) - one.frame.distance) * count

    cable = changed("a cable of 2.5 px before the board", view) < -0.1
    # at 40 px by 30 px, 2.5 px of every row of the board
    assert cable.sum() == pytest.approx(2.5 * 30, rel=0.3)
    assert (cable == (changed("a cable of 2.5 px before the board", same_pose) < -0.1)).all()
    label = IMPERFECTIONS["a label on the board, of half the light"](view).amplitude
    assert (label[view.on] < 0.6 * view.frame.amplitude[view.on]).sum() == pytest.approx(
        0.15 * 0.12 * 40 * 30, rel=0.3
    )
    box = changed("furniture before the wall in all poses", view) < -0.3
    assert not (box & view.on).any()


def test_what_drivers_do(tmp_path: Path) -> None:
    view, other, _ = seen(tmp_path)
    count = view.camera.sensor.lsb
    frame = view.frame
    metres = IMPERFECTIONS["distances in whole millimetres"](view).distance * count
    assert np.abs(metres * 1e3 - np.round(metres * 1e3)).max() <= 0.5 * count * 1e3 + 1e-9
    assert np.abs(metres - frame.distance * count).max() <= 0.0005 + count
    steps = np.unique(IMPERFECTIONS["amplitudes of 8 bits"](view).amplitude)
    assert np.diff(steps).min() >= 11
    lost = IMPERFECTIONS["1 % of the pixels of each frame drop out"](view)
    assert (lost.distance == 0)[view.on].mean() == pytest.approx(0.01, abs=0.008)
    assert (lost.amplitude[lost.distance == 0] == 0).all()
    filtered = IMPERFECTIONS["a median of 3 x 3 distances in the driver"]
    inside = (np.abs(view.x) < 0.9) & (np.abs(view.y) < 0.9)
    noise, smooth = (
        np.std((second.distance.astype(float) - first.distance)[inside])
        for first, second in ((frame, other.frame), (filtered(view), filtered(other)))
    )
    assert smooth < 0.7 * noise


def test_surfaces_that_are_displaced_take_their_light_along(tmp_path: Path) -> None:
    view, *_ = seen(tmp_path)
    sixth = replace(view, pose=6)
    frame = IMPERFECTIONS["the board of one pose 10 mm nearer"](sixth)
    change = (frame.distance.astype(float) - view.frame.distance)[view.on] * view.camera.sensor.lsb
    assert np.median(change) == pytest.approx(-0.01, abs=0.001)
    # 1 / d^2 at 1.5 m
    light = frame.amplitude[view.on].astype(float) / view.frame.amplitude[view.on]
    assert np.median(light) == pytest.approx(1 + 2 * 0.01 / 1.5, abs=0.003)
    assert (IMPERFECTIONS["the board of one pose 10 mm nearer"](view).distance == view.frame.distance).all()
    late = IMPERFECTIONS["the board of two poses moves by 4 mm"]
    assert (late(replace(view, pose=4, in_pose=1)).distance == view.frame.distance).all()
    moved = late(replace(view, pose=4, in_pose=2)).distance.astype(float) - view.frame.distance
    assert np.median(moved[view.on]) * view.camera.sensor.lsb == pytest.approx(0.004, abs=0.001)
