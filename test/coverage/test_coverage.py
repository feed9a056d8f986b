"""What stations determine so far, what to record next, and whether they were at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.calibrate.plan import NARROWED, blocks_of, narrowing, plan
from rim_camera_ros.coverage.evaluate import Coverage, Evaluator
from rim_camera_ros.coverage.picture import HEIGHT, WIDTH, coverage_picture
from rim_camera_ros.coverage.proposals import proposals
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.diagnose.variance import movement_of
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, accumulate, reduce_folds
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.frame import Pose
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose
from rim_camera_ros.scene import Station as Scheduled
from test.calibrate import helpers
from test.coverage.recordings import CYCLIC, SETTINGS, at, recorded


def stations(tmp_path: Path, *distances: float) -> list[Station]:
    return list(reduce_frames(recorded(tmp_path, at(*distances)), helpers.camera(tmp_path)))


def evaluated(tmp_path: Path, found: Sequence[Station], scene: Scene | None = None) -> Coverage:
    evaluator = Evaluator(scene or helpers.scene(tmp_path), helpers.camera(tmp_path, CYCLIC))
    for one in found:
        assert evaluator.add(one)
    return evaluator.evaluate()


def test_factors_are_those_of_a_plan(tmp_path: Path) -> None:
    """A plan expects the light that the recorded stations then have."""
    camera = helpers.camera(tmp_path, CYCLIC)
    poses = [
        ScenePose((0.07, -0.04, z), (0.0, s, 0.0, (1 - s * s) ** 0.5))
        for z, s in ((0.7, 0.0), (1.9, 0.2), (3.1, 0.1))
    ]
    schedule = tuple(Scheduled(frames=4, integration_time=60.0, poses={"board": one}) for one in poses)
    scene = replace(helpers.scene(tmp_path), schedule=schedule)
    simulation = Simulation(camera, scene, seed=3)
    evaluator = Evaluator(scene, camera)
    for station in reduce_frames(map(simulation.frame, Timeline(scene, camera)), camera):
        evaluator.add(station)
    found = evaluator.evaluate().factors
    planned = plan(camera, {"board_experiment": scene}).alone["board_experiment"]
    for name in ("cyclic_error", "amplitude_offset", "emitter_offset", "scattering", "incidence_angle"):
        assert found[name] == pytest.approx(planned[name], rel=0.15), name


def test_more_stations_tell_more(tmp_path: Path) -> None:
    """One distance does not determine a sinusoid over the distance, five in half a period of it do."""
    found = stations(tmp_path, 0.8, 1.2, 1.6, 2.0, 2.4)
    before: dict[str, float] = {}
    for number in (1, 3, 5):
        now = evaluated(tmp_path, found[:number])
        assert now.stations == number
        assert all(now.factors[name] >= 0.999 * one for name, one in before.items())
        assert ("cyclic_error" in now.determined) == (number == 5), now.factors
        before = {name: one for name, one in now.factors.items() if name != "amplitude_nonlinearity"}


@pytest.mark.parametrize("size", [None, (0.6, 0.5)], ids=["plane", "rectangle"])
def test_what_is_to_be_recorded_next_brings_what_it_says(
    tmp_path: Path, size: tuple[float, float] | None
) -> None:
    """Also of a board that takes up a third of the image: other pixels see it where it is recorded next."""
    camera, scene = helpers.camera(tmp_path, CYCLIC), helpers.scene(tmp_path)
    if size is not None:
        scene = replace(scene, surfaces=(replace(scene.surfaces[0], type="rectangle", size=size),))
    found = list(reduce_frames(recorded(tmp_path, at(1.1), scene=scene), camera))
    now = evaluated(tmp_path, found, scene)
    assert (now.seen == 0).mean() > 0.5 or size is None
    assert now.next is not None
    assert now.lines()[-1].startswith(f"  next: {now.next.words} (")
    chosen = next(one for one in proposals(scene, camera, found[0]) if one.words == now.next.words)
    pose = chosen.truth["board"]
    more = list(reduce_frames(recorded(tmp_path, [*at(1.1), pose], scene=scene), camera))
    after = evaluated(tmp_path, more, scene)
    for name, (before, promised) in now.next.raised.items():
        if name == "amplitude_offset":  # the pole of its form follows from the light that there was
            continue
        assert now.factors[name] == before < NARROWED
        assert after.factors[name] == pytest.approx(promised, rel=0.3), name


def uniform(scene: Scene, reflectivity: float, **changes: Any) -> Scene:
    """The scene with a board of one reflectivity."""
    board = replace(scene.surfaces[0], texture=None, reflectivity=reflectivity, **changes)
    return replace(scene, surfaces=(board,))


def test_another_grey_level_is_what_a_wall_of_one_lacks(tmp_path: Path) -> None:
    """Nothing moves: what follows the amplitude shows on a target that reflects otherwise, as promised."""
    term = AmplitudeOffset(hyperbola={60.0: Hyperbola(a=12.0, b=20.0)})
    camera = helpers.camera(tmp_path, term)
    wall = uniform(helpers.scene(tmp_path), 0.8, pose=ScenePose((0.0, 0.0, 1.5)))

    def station(scene: Scene, stamp: int) -> Station:
        simulation = Simulation(camera, scene, seed=7)
        given = [Exposure(stamp + k * 40_000_000, SETTINGS, scene.fixed_poses(), 0, stamp) for k in range(4)]
        (found,) = reduce_frames(map(simulation.frame, given), camera)
        return found

    first = station(wall, 1_000_000_000)
    evaluator = Evaluator(wall, camera)
    assert evaluator.add(first)
    now = evaluator.evaluate()
    assert now.next is not None
    assert now.next.words == "a grey target of reflectivity 0.5 in the place of board"
    assert now.next.raised.keys() == {"amplitude_offset", "amplitude_nonlinearity"}
    before, promised = now.next.raised["amplitude_offset"]
    assert before < 1.1
    assert promised > NARROWED

    # together with the target, by the equations of both scenes; 1 % of the power, 10 % of its reflectivity
    blocks = blocks_of(camera, Dataset([first]))
    every = np.ones(camera.shape, bool).ravel()

    def equations(recorded: Station, scene: Scene, gain_sigma: float) -> NormalEquations:
        stated = replace(camera, radiometry=replace(camera.radiometry, gain_sigma=gain_sigma))
        return accumulate(Forward(Dataset([recorded]), scene, stated), blocks, seen=every)

    target = uniform(wall, 0.5)
    second = replace(station(target, 21_000_000_000), recording=1)
    known, added = equations(first, wall, 0.01), equations(second, target, math.hypot(0.01, 0.1))
    together = reduce_folds([*known.folds, *added.folds], priors_of(known.regressors), known.pixels)
    factors = narrowing(known.regressors, together.gram)
    for name, (_, said) in now.next.raised.items():
        assert factors[name] == pytest.approx(said, rel=0.1), name


def test_a_board_of_one_grey_level_is_to_be_followed_by_another(tmp_path: Path) -> None:
    """Once it was seen near, far and tilted, what its amplitude does is still that of its distance."""
    turn, tilt = math.sin(math.radians(20.0)), math.cos(math.radians(20.0))
    poses = [
        *at(1.1),
        Pose((0.0, 0.0, 0.69), (turn, 0.0, 0.0, tilt)),
        Pose((0.0, 0.0, 1.1), (0.0, turn, 0.0, tilt)),
    ]
    board = uniform(helpers.scene(tmp_path), 0.8, type="rectangle", size=(0.6, 0.5))
    found = reduce_frames(recorded(tmp_path, poses, scene=board), helpers.camera(tmp_path))
    now = evaluated(tmp_path, list(found), board)
    assert now.next is not None
    assert now.next.words == "a grey target of reflectivity 0.2 at 0.69 m"
    before, promised = now.next.raised["amplitude_offset"]
    assert before < NARROWED < promised


def test_grey_levels_that_a_board_has_are_not_offered(tmp_path: Path) -> None:
    """Nor those that differ from them by less than twice the sigma of both, 10 % each."""
    camera, board = helpers.camera(tmp_path), helpers.scene(tmp_path)
    last = stations(tmp_path, 1.3)[0]

    def levels(scene: Scene) -> set[str]:
        offered = proposals(scene, camera, last)
        return {proposal.words.split()[5] for proposal in offered if proposal.scene is not None}

    assert levels(board) == set()
    assert levels(uniform(board, 0.8)) == {"0.2", "0.5"}
    assert levels(uniform(board, 0.42)) == {"0.2", "0.8"}
    assert levels(uniform(board, 0.42, reflectivity_sigma=0.0)) == {"0.2", "0.5", "0.8"}


def test_what_no_pose_tells_is_said(tmp_path: Path) -> None:
    """Rows for two settings in the camera file: the other one is offered; uptime is not stated."""
    camera = helpers.camera(tmp_path)
    rows = helpers.camera(tmp_path).effects  # none
    assert rows == {}
    offered = proposals(helpers.scene(tmp_path), camera, stations(tmp_path, 1.3)[0])
    assert {one.words.partition(" at ")[0] for one in offered} == {"board"}
    warm = replace(stations(tmp_path, 1.3)[0], settings=replace(SETTINGS, uptime=4000.0))
    words = [one.words for one in proposals(helpers.scene(tmp_path), camera, warm)]
    assert "the present pose after 30 min more of running" in words
    assert "the present pose within 10 s of switching the camera on, cold" in words


def test_a_station_without_a_pose_counts_for_nothing(tmp_path: Path) -> None:
    evaluator = Evaluator(helpers.scene(tmp_path), helpers.camera(tmp_path))
    assert not evaluator.add(replace(stations(tmp_path, 1.3)[0], truth={}))


@pytest.mark.parametrize(("drift", "rests"), [(0.0, True), (0.004, False)])
def test_rest(tmp_path: Path, drift: float, rests: bool) -> None:
    """4 mrad from frame to frame are 10 to 20 mm at the rim of the array, over eight frames."""
    frames = recorded(tmp_path, at(1.5), frames=8, drift=drift)
    (station,) = reduce_frames(frames, helpers.camera(tmp_path))
    moved = movement_of(station)
    if rests:
        assert moved is None
    else:
        assert moved is not None
        assert 0.003 < moved < 0.1


def test_the_picture(tmp_path: Path) -> None:
    coverage = evaluated(tmp_path, stations(tmp_path, 0.9, 1.4))
    assert coverage.seen.max() == 2
    assert coverage.readings.sum() == coverage.seen.sum()
    # 0.9 m in the middle to 1.4 m / cos(30 deg) at the rim, of 7.49 m in 24 classes
    distances = np.flatnonzero(coverage.readings.sum(axis=1))
    assert (distances.min(), distances.max()) == (2, 5)
    plain = coverage_picture(coverage, ambiguity=7.49)
    moved = coverage_picture(replace(coverage, moved=0.012), ambiguity=7.49)
    assert plain.shape == (HEIGHT, WIDTH, 3)
    assert (plain != moved).any()
    assert "NOT at rest: 12 mm" in replace(coverage, moved=0.012).lines()[0]
