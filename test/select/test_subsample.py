"""A few poses ahead of all: which they are, what they settle, and that they change no answer."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.calibrate import joint
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.gauss_newton import GaussNewton
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.steps import Solved
from rim_camera_ros.fit.views import Views
from rim_camera_ros.select import subsample
from rim_camera_ros.select.compare import Found
from rim_camera_ros.select.search import search
from rim_camera_ros.select.subsample import at_stations, dominated, subsample_of

from ..calibrate.helpers import camera, record, scene

CYCLIC = CyclicError((Harmonic(4, 0.011, 0.7),), (0.0, 0.0))
SPREAD = Scattering((Kernel(0.03, (4.0, 5.0)), Kernel(0.02, (14.0, 11.0))))


def stations(times: list[float], size: int = 100) -> Any:
    """Poses of these integration times, two stations each, of size x size pixels."""
    nothing: Any = None
    return Dataset(
        [
            SimpleNamespace(
                recording=0,
                pose=k,
                placed=k,
                settings=SimpleNamespace(integration_time=time),
                distance=np.ones((size, size)),
            )
            for k, time in enumerate(times)
            for _ in range(2)
        ],
        nothing,
    )


def test_a_few_poses_are_some_of_each_setting_with_all_their_stations() -> None:
    """80 poses of 20,000 pixels: ten hold 200,000, of settings 3 : 1 eight and two (or one more)."""
    data = stations([16.0] * 60 + [100.0] * 20)
    problem = Problem(data, None)  # type: ignore[arg-type]
    numbers = subsample_of(problem, seed=3)
    assert numbers is not None
    poses = [data.stations[k].pose for k in numbers]
    assert all(poses.count(one) == 2 for one in poses)
    chosen = sorted(set(poses))
    assert (sum(k < 60 for k in chosen), sum(k >= 60 for k in chosen)) == (8, 2)
    assert len({np.diff(chosen)[i] for i in range(8)}) > 2  # not every so many of them
    assert subsample_of(problem, seed=3) == numbers


@pytest.mark.parametrize(
    ("poses", "size", "few"),
    [(24, 100, None), (26, 100, 10), (15, 200, None), (16, 200, 8), (500, 100, 10)],
    ids=["pixels below half a million", "above", "half of the poses", "sixteen poses", "many poses"],
)
def test_all_poses_are_fitted_where_they_are_few(poses: int, size: int, few: int | None) -> None:
    problem = Problem(stations([60.0] * poses, size), None)  # type: ignore[arg-type]
    numbers = subsample_of(problem, seed=0)
    assert (numbers if numbers is None else len(numbers)) == (few if few is None else 2 * few)


def test_pixels_count_that_are_predicted_and_not_used() -> None:
    """A small board far away takes as long to predict as a wall."""
    unused = np.zeros((100, 100), bool)
    problem = Problem(stations([60.0] * 40), None, masks=[(unused, unused)] * 80)  # type: ignore[arg-type]
    numbers = subsample_of(problem, seed=0)
    assert numbers is not None
    assert len(numbers) == 20


def test_the_problem_of_some_stations_keeps_their_masks_and_shifts() -> None:
    data, masks, shifts = stations([16.0, 60.0]), [(k, k) for k in range(4)], list("abcd")
    some = at_stations(Problem(data, None, masks=masks, shifts=shifts), [1, 2])  # type: ignore[arg-type]
    assert some.dataset.stations == data.stations[1:3]
    assert (some.masks, some.shifts) == ([(1, 1), (2, 2)], ["b", "c"])


def test_left_behind_is_what_is_worse_in_all_folds_and_by_far() -> None:
    tried = {
        "best": [100.0, 50.0, 70.0],
        "worse by 30.5": [80.0, 45.0, 64.5],
        "worse by 29.5": [80.0, 45.0, 65.5],
        "better in one": [10.0, 51.0, 20.0],
        "hopeless": [-900.0, -800.0, 20.0],
    }
    assert dominated(tried) == {"worse by 30.5", "hopeless"}
    assert dominated(tried, least=500.0) == {"hopeless"}
    assert dominated({}) == set()


@pytest.fixture(scope="module")
def spread(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Any]:
    """A recording with stray light of two halos, and the camera that does not know of them."""
    folder = tmp_path_factory.mktemp("spread")
    board = scene(folder)
    data = record(camera(folder, SPREAD, CYCLIC), board)
    return Problem(data, board), camera(folder, CYCLIC)


def found(spread: tuple[Problem, Any], effects: list[str]) -> tuple[Any, list[str]]:
    problem, stated = spread
    said: list[str] = []
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    result = search(problem, stated, facts, effects=effects, most=1, progress=said.append)
    return result, [one.partition(" (")[0] for one in said if re.match(r"fitting \S+ to ", one)]


@pytest.mark.long
def test_a_few_poses_change_no_answer(spread: tuple[Problem, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The same effect with the same parameters to half of their sigma; rivals need not be fitted."""
    effects = ["scattering", "amplitude_nonlinearity", "radiometry", "incidence_angle"]
    alone, said = found(spread, effects)
    assert not any("few" in one for one in said)
    rivals = [one.removeprefix("fitting ").removesuffix(" to all poses") for one in said]
    assert rivals
    monkeypatch.setattr(subsample, "MANY_PIXELS", 1000)
    monkeypatch.setattr(subsample, "_FEW_PIXELS", 1000)
    few, said = found(spread, effects)
    assert [one.effect for one in few.found] == [one.effect for one in alone.found] == ["scattering"]
    assert said == [*(f"fitting {one} to a few poses" for one in rivals), "fitting scattering to all poses"]
    values, sigma = few.fit.parameters, alone.fit.sigma
    own = [path for path in values if path.startswith("effects.")]
    assert len(own) == 10
    for path in own:
        assert values[path] == pytest.approx(alone.fit.parameters[path], abs=0.5 * sigma[path]), path
    assert few.log_likelihood > alone.log_likelihood - 0.5


@pytest.mark.long
def test_a_search_goes_on_from_what_some_poses_found(spread: tuple[Problem, Any]) -> None:
    """Nothing is fitted anew, and what it found is that of a search of all."""
    problem, stated = spread
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    effects = ["scattering", "amplitude_nonlinearity"]
    alone, _ = found(spread, effects)
    some = at_stations(problem, range(0, len(problem.dataset.stations), 2))
    begin = search(some, stated, facts, effects=effects, most=1)
    said: list[str] = []
    result = search(problem, stated, facts, effects=effects, most=1, begin=begin, progress=said.append)
    assert [one.effect for one in result.found] == ["scattering"]
    assert not any(one.startswith("fitting scattering") for one in said)
    values, sigma = result.fit.parameters, alone.fit.sigma
    for path in (path for path in values if path.startswith("effects.")):
        assert values[path] == pytest.approx(alone.fit.parameters[path], abs=0.5 * sigma[path]), path
    # priors are those of the camera file, not of what the part found
    assert result.problem.origin is stated
    assert result.problem.masks is not None
    assert len(result.problem.masks) == len(problem.dataset.stations)


@pytest.mark.long
def test_what_some_poses_found_leaves_where_all_explain_it_otherwise(
    spread: tuple[Problem, Any], tmp_path: Path
) -> None:
    problem, stated = spread
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    wrong = camera(tmp_path, CYCLIC, DistanceScale(0.0004))
    begin: Any = SimpleNamespace(found=[Found("distance_scale", 60.0, step=3)], camera=wrong, problem=problem)
    result = search(problem, stated, facts, effects=["scattering", "distance_scale"], most=2, begin=begin)
    assert [one.effect for one in result.found] == ["scattering"]
    assert "distance_scale" not in result.camera.effects


def test_what_some_poses_found_leaves_where_it_ends_at_nothing(
    spread: tuple[Problem, Any], tmp_path: Path
) -> None:
    """Its parameter is at a bound: beyond it the data would go, but nothing there is possible."""
    problem, stated = spread
    grown = [
        replace(one, amplitude=one.amplitude * (1 + 2e-5 * one.amplitude.astype(float)))
        for one in problem.dataset.stations
    ]
    # without the curve of a response of another form, which comes with the gain
    problem = replace(problem, gain=False, dataset=replace(problem.dataset, stations=grown))
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    wrong = camera(tmp_path, CYCLIC, AmplitudeNonlinearity(3e-6))
    begin: Any = SimpleNamespace(
        found=[Found("amplitude_nonlinearity", 60.0, step=3)], camera=wrong, problem=problem
    )
    result = search(problem, stated, facts, effects=[], most=1, begin=begin)
    assert result.found == []
    assert result.camera.effects.keys() == stated.effects.keys()


@pytest.mark.long
def test_a_large_calibration_is_searched_by_some_of_its_poses_first(
    spread: tuple[Problem, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, stated = spread
    monkeypatch.setattr(subsample, "MANY_PIXELS", 1000)
    monkeypatch.setattr(joint, "MANY_PIXELS", 1000)
    monkeypatch.setattr(joint, "OF_SURFACES", frozenset())
    monkeypatch.setattr(joint, "OPTICS", {})
    monkeypatch.setattr(joint, "effects_of", lambda camera: ["cyclic_error", "scattering"])
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    said: list[str] = []
    views = Views(stated, problem.scene)
    outcome = joint.by_search(problem, stated, facts, views=views, say=said.append)
    poses = len(problem.dataset.stations)
    assert f"{len(subsample_of(problem, seed=0, hold=1000) or [])} of {poses} stations first" in said
    assert outcome.found == ["scattering"]
    assert len(outcome.solution.fit.forward.dataset.stations) == poses
    assert outcome.part is None
    said.clear()
    part = joint.by_search(problem, stated, facts, views=views, say=said.append, part_is_enough=True)
    assert part.found == ["scattering"]
    assert part.part is not None
    assert len(part.solution.fit.forward.dataset.stations) == poses
    # on all poses nothing else was looked for
    assert said[said.index("all stations") :] == ["all stations", "baseline and 0 candidates"]
    said.clear()
    rest = joint.by_search(problem, stated, facts, views=views, say=said.append, begin=part.part)
    assert (rest.found, rest.part) == (["scattering"], None)
    assert "stations first" not in " ".join(said)


@pytest.mark.long
def test_what_follows_time_or_moves_rays_is_fitted_to_all_poses(
    spread: tuple[Problem, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subsample, "MANY_PIXELS", 1000)
    monkeypatch.setattr(subsample, "_FEW_PIXELS", 1000)
    _, said = found(spread, ["warm_up_drift", "camera_constant"])
    assert said
    assert not any("few" in one for one in said)


@pytest.mark.long
def test_near_the_solution_widths_move_at_once(spread: tuple[Problem, Any], tmp_path: Path) -> None:
    """From widths a third too wide: the same solution, in fewer steps than from a guess."""
    problem, stated = spread
    before = fit(problem, stated)
    start = camera(tmp_path, CYCLIC, Scattering((Kernel(0.02, (5.5, 6.5)), Kernel(0.03, (18.0, 15.0)))))
    ends = {near: fit(problem, start, warm=before, near=near, iterations=20) for near in (False, True)}
    assert ends[True].converged
    assert ends[True].iterations < ends[False].iterations
    sigma = ends[True].sigma
    for path, value in ends[True].parameters.items():
        assert value == pytest.approx(ends[False].parameters[path], abs=0.3 * sigma[path]), path
    weight = ends[True].parameters["effects.scattering.kernels.0.sigma.0"]
    assert weight == pytest.approx(4.0, abs=4 * sigma["effects.scattering.kernels.0.sigma.0"])


def test_a_bend_is_crossed_once_and_a_wrong_way_goes_back_to_its_beginning() -> None:
    """Of a step that should gain 100, 9 worse is followed by another; a second one so is taken back."""
    nothing: Any = None
    eye = np.eye(1)

    def solved(name: str) -> Solved:
        # a step of 10 sigma, forecast 100
        right, far = np.array([10.0]), np.array([np.inf])
        return Solved(nothing, [name], eye, right, (-far, far), 0.0, {}, {}, decrement=100.0)

    def at(objective: float, decrement: float = 100.0) -> Any:
        return SimpleNamespace(objective=objective, decrement=decrement, level=lambda tolerance: 0.5)

    work = GaussNewton.__new__(GaussNewton)
    gone: list[tuple[str, float]] = []
    work.__dict__.update(_warm=True, _near=True, _iterations=12, _objective=1000.0, _return=None)
    work.__dict__.update(_tolerance=0.05)
    work.__dict__.update(_tried=0, _damping=0.0, _solved=solved("before the bend"), _exhausted=False)
    work.__dict__.update(
        _go=lambda one: gone.append((one.labels[0], one.damping)), _find_errors=lambda _: None
    )
    beyond = at(1009.0)
    assert work._solved is not None
    assert work._solved.forecast == pytest.approx(100.0)
    assert work.went_too_far(at(1011.0), 3)
    # nearer to the solution of the equations by half of what was to be gained
    assert work.went_too_far(at(1011.0, 51.0), 3)
    assert not work.went_too_far(at(1011.0, 49.0), 3)
    assert work.went_too_far(beyond, 12)  # no other step would follow
    assert not work.went_too_far(beyond, 3)
    work.accept(beyond)
    work.__dict__.update(_solved=solved("beyond the bend"))
    assert work.went_too_far(beyond, 4)
    work.shorten(final=False)
    assert gone == [("before the bend", 0.01)]
    # once more: the second step is the good one, and the next may cross a bend again
    work.__dict__.update(_tried=0, _solved=solved("before the bend"))
    work.accept(beyond)
    better = at(900.0)
    assert not work.went_too_far(better, 5)
    work.accept(better)
    assert not work.went_too_far(at(905.0), 6)


def test_steps_are_shortened_until_one_goes_down() -> None:
    """An objective that bends fifty times as much as the equations say falls for steps below 0.4 sigma only.

    -20 x + 50 x^2 in place of -20 x + x^2, whose step is 10: with a hundred times the diagonal it is 0.099.
    """
    nothing: Any = None
    right, far = np.array([10.0]), np.array([np.inf])
    begun = Solved(nothing, ["x"], np.eye(1), right, (-far, far), 0.0, {}, {}, decrement=100.0)
    work = GaussNewton.__new__(GaussNewton)
    places = [float(begun.step[0])]
    work.__dict__.update(_warm=True, _near=False, _iterations=12, _objective=0.0, _return=None)
    work.__dict__.update(_tolerance=0.05)
    work.__dict__.update(_tried=0, _damping=0.0, _solved=begun, _exhausted=False)
    work.__dict__.update(_go=lambda one: places.append(float(one.step[0])), _find_errors=lambda _: None)

    def here() -> Any:
        objective = -20 * places[-1] + 50 * places[-1] ** 2
        return SimpleNamespace(objective=objective, decrement=100.0, level=lambda tolerance: 0.5)

    count = 1
    while work.went_too_far(here(), count):
        work.shorten(final=False)
        count += 1
    assert places == pytest.approx([10.0, 10 / 1.01, 10 / 1.1, 5.0, 10 / 11, 10 / 101])
    assert here().objective == pytest.approx(-1.49, abs=0.01)
    assert not work._exhausted
    assert work._damping == 100.0
