"""Recordings of different scenes in one calibration, and the internal reference that a cold start tells."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.recordings import JoinedScene, joined
from rim_camera_ros.calibrate.run import Calibration, Request, calibrate
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.reference_path import ReferencePath
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.frame import Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Surface

from .bags import frames, write
from .helpers import camera, record, scene

TRUE = (CyclicError((Harmonic(4, 0.013, 0.9),)), WarmUpDrift((Exponential(-0.04, 240.0),)))
WALL = Scene((Surface("wall", "plane", ScenePose((0.0, 0.0, 1.21)), reflectivity=0.7),))


def cold_start(path: Path, truth: Camera, *, seed: int) -> Path:
    """Record the wall from power-on: four frames every 20 s for half an hour."""
    simulation = Simulation(truth, WALL, seed=seed)
    taken = []
    for number in range(90):
        settings = Settings(integration_time=60.0, modulation_frequency=20e6, uptime=20.0 * number)
        for k in range(4):
            stamp = 10**9 + number * 20 * 10**9 + k * 40_000_000
            shot = Exposure(
                stamp=stamp, settings=settings, poses=WALL.fixed_poses(), station=0, pose_stamp=10**9
            )
            taken.append(replace(simulation.frame(shot), device="test 7"))
    return write(path, taken)


def calibrated(folder: Path, truth: Camera, start: Camera, *names: str) -> Calibration:
    board = scene(folder)
    bag = write(folder / "board", frames(truth, board, seed=5))
    cold = cold_start(folder / "cold", truth, seed=6)
    request = Request((bag, cold), start, (board, WALL), effects=names or None)
    return calibrate(request, integral=False)


@pytest.mark.long
def test_a_board_tells_the_cyclic_error_and_a_wall_the_drift(tmp_path: Path) -> None:
    truth = camera(tmp_path, *TRUE)
    start = with_effects(truth, {"cyclic_error": CyclicError((Harmonic(4, 0.01, 0.7),))})
    found = calibrated(tmp_path, truth, start)
    assert found.found == ["warm_up_drift"]
    numbers, true = camera_numbers(found.camera), camera_numbers(truth)
    for path in ("cyclic_error.harmonics.0.amplitude", "cyclic_error.harmonics.0.phase"):
        name = f"effects.{path}"
        assert numbers[name] == pytest.approx(true[name], abs=4 * found.sigma[name]), name
    # more than one exponential may be fitted: the drift is what counts
    drift = [_drift(one.effects["warm_up_drift"], 0.0, 1500.0) for one in (found.camera, truth)]
    assert drift[0] == pytest.approx(drift[1], abs=0.001)
    assert found.chi_square == pytest.approx(1.0, abs=0.1)
    assert [one.poses for one in found.sources] == [20, 1]


def _drift(effect: object, first: float, last: float) -> float:
    assert isinstance(effect, WarmUpDrift)
    return sum(
        one.amplitude * (np.exp(-first / one.time_constant) - np.exp(-last / one.time_constant))
        for one in effect.terms
    )


@pytest.mark.long
@pytest.mark.parametrize("pixels", [None, (40, 1, 42, 3)])
def test_the_scale_of_the_reference(tmp_path: Path, pixels: tuple[int, int, int, int] | None) -> None:
    path = ReferencePath(nominal=0.852, scale=0.81, pixels=pixels)
    truth = camera(tmp_path, *TRUE, path)
    stated = {} if pixels is None else {"reference_path": replace(path, nominal=0.84, scale=1.0)}
    start = with_effects(truth, {"cyclic_error": TRUE[0], "warm_up_drift": TRUE[1], **stated})
    found = calibrated(tmp_path, truth, start)
    fitted = found.camera.effects["reference_path"]
    assert isinstance(fitted, ReferencePath)
    assert fitted.pixels == pixels
    sigma = {name: found.sigma[f"effects.reference_path.{name}"] for name in ("nominal", "scale")}
    assert 0 < sigma["scale"] < 0.02
    assert 0 < sigma["nominal"] < 0.001
    assert fitted.scale == pytest.approx(0.81, abs=4 * sigma["scale"])
    # level of drift and offset of all pixels are one: nominal is that of the fitted drift
    assert fitted.nominal == pytest.approx(0.852, abs=4 * sigma["nominal"] + 0.002)
    (status,) = (one for one in found.statuses if one.effect == "reference_path")
    assert status.status == "fitted"
    words = "fitted; not in the file before: " if pixels is None else "fitted: "
    assert status.text.startswith(words + "the scene drifts 0.8")


@pytest.mark.long
def test_a_wall_alone_does_for_the_reference(tmp_path: Path) -> None:
    path = ReferencePath(nominal=0.852, scale=0.81)
    truth = camera(tmp_path, *TRUE, path)
    bag = cold_start(tmp_path / "cold", truth, seed=6)
    plain = with_effects(truth, {one.name: one for one in TRUE})
    found = calibrate(Request((bag,), plain, WALL, effects=("reference_path",)), integral=False)
    fitted = found.camera.effects["reference_path"]
    assert isinstance(fitted, ReferencePath)
    assert fitted.scale == pytest.approx(0.81, abs=4 * found.sigma["effects.reference_path.scale"])
    assert found.camera.effects["warm_up_drift"] == TRUE[1]


@pytest.mark.long
def test_a_reference_that_does_not_move_is_said(tmp_path: Path) -> None:
    path = ReferencePath(nominal=0.852, scale=0.81)
    truth = camera(tmp_path, TRUE[0], path)
    start = with_effects(truth, {"cyclic_error": TRUE[0], "reference_path": replace(path, scale=1.3)})
    found = calibrated(tmp_path, truth, start, "cyclic_error", "reference_path")
    assert found.camera.effects["reference_path"] == start.effects["reference_path"]
    (status,) = (one for one in found.statuses if one.effect == "reference_path")
    assert (status.status, status.text.partition(":")[0]) == ("kept", "as in the file")
    assert re.search(r"the reference moves by [0-9.]+ mm RMS, hardly more than its noise", status.text)


def test_joined_scenes(tmp_path: Path) -> None:
    board = scene(tmp_path)
    data = record(camera(tmp_path), board, poses=3, frames=1)
    stations = [replace(one, truth={}) for one in data.stations]
    other = Scene((replace(WALL.surfaces[0], name="board"), replace(WALL.surfaces[0], name="floor")))
    scene_, (first, second) = joined([board, other], [data, Dataset(stations)])
    assert isinstance(scene_, JoinedScene)
    assert [one.name for one in scene_.surfaces] == ["board", "board (2)", "floor"]
    assert scene_.poses_for(first.stations[0].truth).keys() == {"board"}
    assert scene_.poses_for(second.stations[0].truth).keys() == {"board (2)", "floor"}
    again, _ = joined([board, other, Scene(other.surfaces)], [data, Dataset(stations), Dataset(stations)])
    assert [one.name for one in again.surfaces] == ["board", "board (2)", "floor"]
    assert joined([board, board], [data, data]) == (board, [data, data])
    moving = replace(other, camera_motion=CameraMotion(linear=(0.1, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"the scenes state different motions of the camera"):
        joined([board, moving], [data, Dataset(stations)])
    pose = ScenePose((0.0, 0.0, 1.2), free=("z",))
    free = Scene((replace(WALL.surfaces[0], pose=pose),))
    with pytest.raises(InputError, match=r"the pose of 'wall' is to be estimated, which takes one scene"):
        joined([board, free], [data, Dataset(stations)])


def test_as_many_scenes_as_recordings(tmp_path: Path) -> None:
    truth = camera(tmp_path, *TRUE)
    board = scene(tmp_path)
    bags = [write(tmp_path / f"bag{k}", frames(truth, board, poses=2, repeats=1, seed=k)) for k in range(3)]
    with pytest.raises(InputError, match=r"2 scenes for 3 recordings \(give one scene for all") as caught:
        calibrate(Request(tuple(bags), truth, (board, WALL)))
    assert caught.value.place == "--scene"
