"""Is it the recording of this scene? Poses, their placements and stations, and scenes that cannot be it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.cli import main
from rim_camera_ros.diagnose import accuracy as measured
from rim_camera_ros.diagnose import setup
from rim_camera_ros.diagnose.accuracy import Accuracy, accuracy
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.diagnose.setup import PoseCheck, check_poses, check_setup, few_of
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.evidence import Scores, folds_of
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.moved_poses import moved_poses

from ..calibrate.helpers import camera, record, scene, with_wrong_pose
from .helpers import CAMERA, run, scene_text


def test_the_poses_of_a_placement_that_was_recorded_wrongly_are_those_to_blame(tmp_path: Path) -> None:
    """16 placements, recorded three times each: poses 15, 16 and 17 share the error of the sixth."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = with_wrong_pose(record(truth, board, poses=16, seed=3), 5, 0.06)
    again = [
        replace(one, pose=3 * k + j, placement=k, time=3.0 * k + j)
        for k, one in enumerate(data.stations)
        for j in range(3)
    ]
    data = replace(data, stations=again)
    fitted = fit(Problem(data, board), truth)
    assert check_setup(fitted).bad == ()
    scores = Scores(fitted.equations, range(len(fitted.parameters)))
    moved = moved_poses(scores, least_gain=20.0, most=few_of(data).most)
    assert [pose.placement for pose in moved] == [(0, 5)]
    assert (data.poses, data.placements, few_of(data).most) == (48, 16, 2)
    found = check_setup(fitted, moved=moved)
    assert found.bad == ((0, 15), (0, 16), (0, 17))
    said = str(found.reason)
    assert said.startswith(
        "3 of 48 poses do not agree with the rest (15, 16, 17); pose 15 at 15.0 s: 'board'"
    )
    assert "mm nearer along its normal" in said
    assert said.endswith("--without-poses 15,16,17 excludes them")


@pytest.mark.parametrize("bent", [0, 1])
def test_every_station_of_a_pose_counts(tmp_path: Path, bent: int) -> None:
    """A long pose is cut into stations: whichever of them does not agree, the pose does not."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=12, seed=4)
    halves = [replace(one, pose=k // 2) for k, one in enumerate([s for s in data.stations for _ in range(2)])]
    # quarters up and down, which no error of a pose is
    bend = 0.02 * np.sign(np.arange(36) - 17.5)[:, None] * np.sign(np.arange(44) - 21.5)
    halves[8 + bent] = replace(halves[8 + bent], distance=halves[8 + bent].distance + bend)
    fitted = fit(Problem(replace(data, stations=halves), board), truth)
    worst = max(check_poses(fitted), key=lambda one: one.chi_square)
    assert worst.key == (0, 4)
    assert worst.chi_square > 4 * np.median([one.chi_square for one in check_poses(fitted)])


@pytest.mark.parametrize(("pixels", "bad"), [(6, ()), (120, ((0, 5),))])
def test_a_handful_of_wild_pixels_is_no_other_pose(tmp_path: Path, pixels: int, bad: tuple[Any, ...]) -> None:
    """As those that some frames of a station see beyond the ambiguity range."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=12, seed=9)
    one = data.stations[5]
    distance = one.distance.copy()
    distance.ravel()[np.random.default_rng(1).choice(distance.size, pixels, replace=False)] += 1.4
    stations = [*data.stations[:5], replace(one, distance=distance), *data.stations[6:]]
    # offsets of pixels would take their share, and bend the other poses
    problem = Problem(replace(data, stations=stations), board, pattern=False)
    assert check_setup(fit(problem, truth)).bad == bad


@pytest.mark.parametrize(("count", "found"), [(2, 0), (3, 0), (4, 1), (5, 1), (40, 1)])
def test_a_pose_stands_out_from_the_others(count: int, found: int) -> None:
    """By four fifths of the others, itself not among them; of three none is the one that is wrong."""
    poses = [PoseCheck((0, k), 1.0, 0.0, float(k)) for k in range(count - 1)]
    poses.append(PoseCheck((0, count - 1), 1e4, 0.1, 9.0))
    assert len(setup._few(poses, 1.0)) == found
    stations: Any = [SimpleNamespace(recording=0, placed=k) for k in range(count)]
    assert few_of(Dataset(stations, [], [], 0)).most == max(int(0.15 * count), found)


def test_poses_without_a_pixel_stop_no_fit_whichever_they_are(tmp_path: Path) -> None:
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=10, seed=6)
    folds = folds_of(data)
    for fold in (0, 1):
        dark = [
            replace(one, count=np.zeros_like(one.count)) if folds[one.recording, one.pose] == fold else one
            for one in data.stations
        ]
        fitted = fit(Problem(replace(data, stations=dark), board), truth, fold_of=folds)
        assert fitted.rows > 1000


@pytest.mark.long
def test_few_poses_are_said_to_be_few(tmp_path: Path) -> None:
    truth, board = camera(tmp_path), scene(tmp_path)
    for poses, notes in ((2, 1), (5, 1), (6, 0)):
        result = diagnose(record(truth, board, poses=poses, seed=7), board, truth)
        said = [one for one in result.notes if one.startswith(f"only {poses} poses: ")]
        assert len(said) == notes


@pytest.mark.long
def test_few_poses_of_which_nothing_is_missing_are_consistent(tmp_path: Path) -> None:
    """A threshold is a quantile of nulls: of ten recordings one may exceed it by chance (seed 7 does)."""
    truth, board = camera(tmp_path), scene(tmp_path)
    said = [diagnose(record(truth, board, poses=5, seed=seed), board, truth).verdict for seed in range(7, 17)]
    assert said.count("consistent") >= 9


def test_a_dataset_without_poses_counts_its_own_frames(tmp_path: Path) -> None:
    data = record(camera(tmp_path), scene(tmp_path), poses=6, frames=4, seed=8)
    left = data.without({(0, 2), (0, 5)})
    assert (left.poses, left.frames, data.frames) == (4, 16, 24)


def test_the_gain_of_what_was_withdrawn_is_none() -> None:
    nothing: Any = None

    class Start:
        class fit:
            camera = "start"

            class forward:
                masks = "masks"

        @staticmethod
        def recalled(problem: Problem, folds: Any) -> Any:
            return start

    start: Any = Start
    board: Any = "board"
    found: Any = ["mixed_pixels"]
    problem = Problem(nothing, board, reflectance=True, geometry=("cx",), masks=nothing)
    result = Result(nothing, found, [start, nothing, nothing], 900.0, 100.0, problem, {}, [nothing], 1)
    left = result.withdrawn()
    assert left.gained == 0.0
    assert (left.found, left.explorations, left.refused, left.camera) == ([], [start], [], "start")
    assert (left.problem.masks, left.problem.reflectance, left.problem.geometry) == ("masks", False, ())


def test_accuracy_knows_the_light_that_all_pixels_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its fits are of the problem that the search solved, with its light and its prior of the pattern.

    Both know predicted amplitudes as well as its end does.
    """
    truth, board = camera(tmp_path), scene(tmp_path)
    problem = Problem(record(truth, board, poses=8, seed=9), board, stray_light=40.0, pattern_prior=0.02)
    fitted = fit(problem, truth)
    fitted.forward.amplitude_model = replace(fitted.forward.amplitude_model, tau=0.0123)
    step: Any = Exploration.__new__(Exploration)
    step.fit = fitted
    result = Result(truth, [], [step], 0.0, 0.0, problem, folds_of(problem.dataset))
    monkeypatch.setattr(Result, "fit", property(lambda _: fitted))
    given: list[Problem] = []
    monkeypatch.setattr(
        measured, "fit", lambda one, *rest, **more: (given.append(one), fit(one, *rest, **more))[1]
    )
    model = replace(truth, optics=replace(truth.optics, fx=50.5))
    accuracy(truth, model, result)
    assert [(one.stray_light, one.pattern_prior, one.robust) for one in given] == [(40.0, 0.02, False)] * 2
    assert [one.amplitude_error for one in given] == [0.0123] * 2


def test_a_gross_mismatch_that_a_model_makes_worse_is_no_physics() -> None:
    gross = Accuracy(1.5, 2.0, 0.01, 6955.0, 29_415.0, True)
    assert gross.hopeless
    assert not replace(gross, rms_after=1.4).hopeless
    assert not replace(gross, chi2_before=20.0).hopeless
    assert not replace(gross, held_out=False).hopeless


def test_a_surface_that_moved_is_not_still(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """18 distances from 0.9 to 4.3 m, and a scene file that states one of them."""
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "moving.yaml").write_text(scene_text())
    still = scene_text().split("schedule:")[0].replace("pose: truth", "pose: {position: [0, 0, 2.0]}")
    (tmp_path / "still.yaml").write_text(still)
    bag = tmp_path / "bag"
    run("simulate", tmp_path / "moving.yaml", camera=tmp_path / "camera.yaml", out=bag)
    for command, out in (("diagnose", "out"), ("calibrate", "new.yaml")):
        given = [str(bag), "--camera", str(tmp_path / "camera.yaml"), "--scene", str(tmp_path / "still.yaml")]
        assert main([command, *given, "--out", str(tmp_path / out), "--quiet"]) == 2
        message = capsys.readouterr().err
        assert "bag: /ground_truth/wall/pose: the scene states one pose of 'wall'" in message
        assert "differ by up to 3.4 m" in message
        assert "write pose: truth" in message
        assert message.count("\n") == 1


def test_a_recording_is_no_simulation_of_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [
        "diagnose",
        str(tmp_path),
        "--camera",
        "sr3000",
        "--scene",
        "board",
        "--out",
        str(tmp_path / "o"),
    ]
    assert main([*given, "--against", str(tmp_path)]) == 2
    assert "--against: is the recording itself" in capsys.readouterr().err


@pytest.mark.long
def test_no_solution_is_no_page_of_warnings(tmp_path: Path) -> None:
    """A board that stands still by the scene file while it moved, without a warning of scipy."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=10, seed=10)
    wrong = Pose((0.0, 0.0, 1.5))
    data.stations = [replace(one, truth={"board": wrong}) for one in data.stations]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = diagnose(data, board, truth)
    assert result.verdict == "inconsistent_setup"
    assert result.missing == []
    assert result.camera == truth
