"""Steps of an adjustment: shortened where they would go too far, the other parameters following."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.bounds import Bounds, least_within, longest_steps, sigmas_beyond
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.steps import Solved, by_linear, stepped, within_bounds
from rim_camera_ros.frame import Pose

from ..calibrate.helpers import camera, record, scene
from .watched import points

MATRIX = np.array([[4.0, 3.9e3, 0.1], [3.9e3, 4.0e6, 2.0], [0.1, 2.0, 9.0]])
RIGHT = np.array([1.0, 2.0e3, -3.0])


def within(most: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Limits down and up."""
    return -np.array(most), np.array(most)


def solved(most: list[float], damping: float = 0.0) -> Solved:
    nothing: Any = None
    labels = ["weight", "sigma", "offset"]
    return Solved(nothing, labels, MATRIX, RIGHT, within(most), 0.0, {}, {}, damping)


def test_a_step_solves_the_equations() -> None:
    step = solved([np.inf] * 3).step
    assert step == pytest.approx(np.linalg.solve(MATRIX, RIGHT))
    changes = solved([np.inf] * 3).changes
    assert list(changes) == ["weight", "sigma", "offset"]
    assert list(changes.values()) == pytest.approx(step)


def test_the_others_follow_a_parameter_that_may_not_go_as_far() -> None:
    """The least of the quadratic on the bound: sigma would go by 0.0051."""
    free = np.linalg.solve(MATRIX, RIGHT)
    assert free[1] == pytest.approx(0.00505, rel=0.01)
    step = solved([np.inf, 0.001, np.inf]).step
    assert step[1] == 0.001
    others = [0, 2]
    right = RIGHT[others] - MATRIX[others, 1] * 0.001
    assert step[others] == pytest.approx(np.linalg.solve(MATRIX[np.ix_(others, others)], right))

    # which is elsewhere than the free step cut off, and better
    def objective(x: np.ndarray) -> float:
        return float(0.5 * x @ MATRIX @ x - RIGHT @ x)

    cut = np.array([free[0], 0.001, free[2]])
    assert objective(step) < objective(cut) - 1.0
    assert solved([np.inf, 0.01, np.inf]).step == pytest.approx(free)
    assert np.array_equal(solved([0.1, 0.0001, 0.2]).step, [0.1, 0.0001, -0.2])


@pytest.mark.parametrize("correlation", [0.5, 0.9, 0.99])
def test_of_two_that_go_too_far_the_farther_is_held_and_the_other_follows(correlation: float) -> None:
    """Both at once would go uphill: +147 at 0.99, where sigmas of 8 and 1 px are hardly distinguishable."""
    matrix = 100 * np.array([[1.0, correlation], [correlation, 1.0]])
    right = matrix @ np.array([3.0, -3.0])
    nothing: Any = None
    step = Solved(nothing, ["a", "b"], matrix, right, within([2.0, 0.25]), 0.0, {}, {}).step
    assert step[1] == -0.25
    assert step[0] == pytest.approx(min(3.0 - correlation * 2.75, 2.0))
    assert 0.5 * step @ matrix @ step - right @ step < 0


@pytest.mark.parametrize("damping", [1e-3, 0.03, 1.0])
def test_damping_adds_a_share_of_the_diagonal(damping: float) -> None:
    step = solved([np.inf] * 3, damping).step
    assert step == pytest.approx(np.linalg.solve(MATRIX + damping * np.diag(np.diag(MATRIX)), RIGHT))
    assert not np.any(replace(solved([np.inf] * 3, damping), damping=np.inf).step)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_linear_nuisances_are_always_where_they_fit_best(damping: float) -> None:
    """Of a quadratic with its nuisance at its least for every x the step is that of the Schur complement."""
    nothing: Any = None
    labels = ["weight", "common_pose.board.offset", "offset"]
    one = Solved(nothing, labels, MATRIX, RIGHT, within([np.inf] * 3), 0.0, {}, {}, damping)
    own, nuisance = [0, 2], 1
    schur = MATRIX[np.ix_(own, own)] - np.outer(MATRIX[own, nuisance], MATRIX[nuisance, own]) / 4.0e6
    right = RIGHT[own] - MATRIX[own, nuisance] * RIGHT[nuisance] / 4.0e6
    expected = np.linalg.solve(schur + damping * np.diag([4.0, 9.0]), right)
    assert one.step[own] == pytest.approx(expected)
    assert list(one.changes) == ["weight", "offset"]
    # what the nuisance lowers by itself is there before any step
    assert by_linear(MATRIX, RIGHT, labels) == pytest.approx(2.0e3**2 / 4.0e6)
    assert one.forecast == pytest.approx(2 * right @ expected - expected @ schur @ expected)
    assert by_linear(MATRIX, RIGHT, ["weight", "sigma", "offset"]) == 0.0


def test_shapes_go_by_a_quarter_of_where_they_are() -> None:
    labels = ["effects.scattering.kernels.0.sigma.0", "effects.scattering.kernels.0.weight"]
    numbers = {labels[0]: 8.0, labels[1]: 0.02}
    assert list(longest_steps(labels, {labels[0]: 4.0}, numbers, (72, 88))) == [3.0, np.inf]


def test_phases_over_the_array_go_by_a_radian() -> None:
    labels = [f"effects.cyclic_error.gradient.{i}" for i in (0, 1)]
    numbers = dict.fromkeys(labels, 0.0)
    assert list(longest_steps(labels, {labels[0]: 0.3}, numbers, (72, 88))) == [1 / 88, 1 / 72]


@pytest.mark.parametrize("size", [0.013, -0.013])
@pytest.mark.parametrize(("along", "turn"), [(0.004, 0.2), (-0.02, 0.3), (-0.013, 2.0), (0.001, -9.0)])
def test_a_sinusoid_goes_where_its_phasor_does(
    tmp_path: Path, size: float, along: float, turn: float
) -> None:
    """In the plane of cosine and sine a step of the linear equations is a straight line."""
    start = camera(tmp_path, CyclicError((Harmonic(4, size, 2.9), Harmonic(8, 0.002, -1.1))))
    amplitude, phase = (f"effects.cyclic_error.harmonics.0.{one}" for one in ("amplitude", "phase"))
    numbers = camera_numbers(start)
    moved, offsets = stepped(
        start,
        {phase: -0.25},
        {amplitude: along * size / 0.013, phase: turn},
        Bounds({}, {}, start.shape),
        numbers,
    )
    reached = camera_numbers(moved)
    first = size * np.exp(1j * (2.9 - 0.25))
    step = (along * size / 0.013 + 1j * size * turn) * np.exp(1j * (2.9 - 0.25))
    assert reached[amplitude] * np.exp(1j * reached[phase]) == pytest.approx(first + step, abs=1e-12)
    assert np.sign(reached[amplitude]) == np.sign(size)
    assert abs(reached[phase] - 2.9) <= np.pi
    assert offsets[phase] == pytest.approx(reached[phase] - 2.9)
    assert {path for path in reached if reached[path] != numbers[path]} == {amplitude, phase}


@pytest.mark.parametrize(
    ("size", "phase", "gradient"),
    [(0.001, -0.97, (0.0, 0.0)), (0.0003, 3.4, (0.01, -0.01)), (0.00001, -0.97, (0.004, 0.0))],
)
def test_a_small_sinusoid_of_another_phase_finds_its_own(
    tmp_path: Path, size: float, phase: float, gradient: tuple[float, float]
) -> None:
    """Of 1 mm 90 degrees away, steps of the phase by itself ended at -12 mm and 41 rad."""
    board = scene(tmp_path)
    truth = CyclicError((Harmonic(4, 0.012, 0.6),), (0.002, -0.003))
    problem = Problem(record(camera(tmp_path, truth), board, poses=18, seed=5), board)
    found = fit(problem, camera(tmp_path, CyclicError((Harmonic(4, size, phase),), gradient)))
    assert found.converged
    first = {"harmonics.0.amplitude": 0.012, "harmonics.0.phase": 0.6}
    for path, value in {**first, "gradient.0": 0.002, "gradient.1": -0.003}.items():
        own = f"effects.cyclic_error.{path}"
        assert found.parameters[own] == pytest.approx(value, abs=4 * found.sigma[own]), path


def test_a_fit_ends_where_damped_steps_gain_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but strongly damped steps go thirty times too far: what these promise is never gained."""
    truth, board = camera(tmp_path, DistanceScale(0.02)), scene(tmp_path)
    problem = Problem(record(truth, board, poses=8, seed=4), board)
    warm = fit(problem, camera(tmp_path), iterations=3)
    honest = Solved.__dict__["step"].func

    def overshooting(self: Solved) -> np.ndarray:
        return np.asarray(honest(self) * (30.0 if self.damping < 0.5 else 1.0))

    monkeypatch.setattr(Solved, "step", property(overshooting))
    start = camera(tmp_path, DistanceScale(0.0))
    found = fit(problem, start, warm=warm, iterations=30, tolerance=0.15)
    path = "effects.distance_scale.scale"
    assert found.converged
    assert found.iterations < 20
    assert found.parameters[path] == pytest.approx(0.02, abs=4 * found.sigma[path])


def test_a_halo_is_no_wider_than_the_array(tmp_path: Path) -> None:
    """Of one of 150 px on 44 x 36 only its light within the array is identifiable, not how wide it is."""
    assert Scattering.reach("kernels.0.sigma.0", 30.0, (36, 44)) == (6.0, 44.0)
    assert Scattering.reach("kernels.0.sigma.0", 4.0, (36, 44)) == pytest.approx((0.8, 20.0))
    assert Scattering.reach("kernels.0.sigma.0", 60.0, (36, 44)) == (12.0, 60.0)
    board = scene(tmp_path)
    wide = camera(tmp_path, Scattering((Kernel(0.3, (150.0, 120.0)),)))
    problem = Problem(record(wide, board, poses=12, seed=9), board)
    found = fit(problem, camera(tmp_path, Scattering((Kernel(0.05, (30.0, 30.0)),))))
    assert found.converged
    assert found.parameters["effects.scattering.kernels.0.sigma.0"] == 44.0
    assert found.chi_square / found.reduced.expected == pytest.approx(0.75, abs=0.02)


def test_a_step_that_goes_too_far_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Undamped steps are made to go thirty times too far; with no iteration left there is no step at all."""
    truth, board = camera(tmp_path, DistanceScale(0.02)), scene(tmp_path)
    problem = Problem(record(truth, board, poses=8, seed=4), board)
    warm = fit(problem, camera(tmp_path), iterations=3)
    start = camera(tmp_path, DistanceScale(0.0))
    honest = Solved.__dict__["step"].func

    def overshooting(self: Solved) -> np.ndarray:
        return np.asarray(honest(self) * (30.0 if self.damping == 0 else 1.0))

    monkeypatch.setattr(Solved, "step", property(overshooting))
    path = "effects.distance_scale.scale"
    found = fit(problem, start, warm=warm, iterations=12)
    assert found.parameters[path] == pytest.approx(0.02, abs=4 * found.sigma[path])
    short = fit(problem, start, warm=warm, iterations=1)
    assert short.parameters[path] == 0.0
    assert not short.converged
    assert short.notes == ["not converged after 2 iterations: effects.distance_scale.scale still moves"]


def test_objectives_fall_by_what_steps_forecast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also given errors that all poses share, which every step moves."""
    truth, board = camera(tmp_path, CyclicError((Harmonic(4, 0.012, 0.6),), (0.0, 0.0))), scene(tmp_path)
    surface = replace(board.surfaces[0], pose_sigma=(0.003, 0.002), pose_common=0.5)
    board = replace(board, surfaces=(surface,))
    data = record(truth, board, poses=10, seed=6)
    moved = [
        replace(one, truth={name: _farther(pose, 0.004) for name, pose in one.truth.items()})
        for one in data.stations
    ]
    problem = Problem(replace(data, stations=moved), board, pattern=False, robust=False)
    seen = points(monkeypatch)
    start = camera(tmp_path, CyclicError((Harmonic(4, 0.002, 0.2),), (0.0, 0.0)))
    warm = fit(problem, start, iterations=3)
    seen.clear()
    found = fit(problem, start, warm=warm, iterations=12)
    assert found.converged
    assert found.nuisances["common_pose.board.offset"] < -0.002
    objectives, forecasts = np.array([(one.objective, one.decrement) for one in seen]).T
    assert len(seen) > 2
    assert -np.diff(objectives) == pytest.approx(forecasts[:-1], rel=0.1)


def _farther(pose: Pose, shift: float) -> Pose:
    x, y, z = pose.position
    return replace(pose, position=(x, y, z + shift))


def test_objectives_of_a_cold_fit_are_of_the_same_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Amplitudes are 2 % of what they are in other tests: which pixels are used changes from step to step."""
    truth, board = camera(tmp_path, AmplitudeNonlinearity(2e-5)), scene(tmp_path)
    darker = replace(truth, radiometry=replace(truth.radiometry, gain=0.02 * truth.radiometry.gain))
    data = record(darker, board, poses=10, frames=2, seed=8)
    start = replace(darker, radiometry=replace(darker.radiometry, gain=1.08 * darker.radiometry.gain))
    seen = points(monkeypatch)
    found = fit(Problem(data, board), start, tolerance=0.001)
    assert found.converged
    assert len(seen) > 4
    assert len({one.reduced.rows for one in seen[:4]}) > 1
    assert {one.reduced.rows for one in seen[3:]} == {found.rows}


@pytest.mark.parametrize("begun", [0.25, 0.34])
def test_shapes_move_where_strengths_alone_gain_nothing(tmp_path: Path, begun: float) -> None:
    """A blur has no strength: while its width is held there is nothing to gain, which is no end of a fit."""
    truth, board = camera(tmp_path, MixedPixels(0.6)), scene(tmp_path)
    problem = Problem(record(truth, board, poses=12, seed=9), board)
    warm = fit(problem, camera(tmp_path), iterations=4)
    found = fit(problem, camera(tmp_path, MixedPixels(begun)), warm=warm, iterations=12)
    path = "effects.mixed_pixels.blur"
    assert found.converged
    assert found.parameters[path] == pytest.approx(0.6, abs=4 * found.sigma[path])


def test_no_step_leaves_linear_nuisances_where_they_fit_best() -> None:
    """The second of two parameters is one; of the first, which has no step, it does not depend."""
    nothing: Any = None
    labels = ["effects.distance_scale.scale", "common_pose.board.offset"]
    matrix, right = np.array([[4.0, 1.0], [1.0, 2.0]]), np.array([3.0, 5.0])
    none = Solved(nothing, labels, matrix, right, within([inf, inf]), 0.0, {}, {}, inf)
    assert none.step == pytest.approx([0.0, 2.5])
    assert none.forecast == pytest.approx(0.0)
    assert none.changes == {labels[0]: 0.0}


def test_a_parameter_that_the_data_would_take_beyond_what_is_possible_is_said(tmp_path: Path) -> None:
    """Published amplitudes that grow faster than the light: no compression does that, and 0 is the least."""
    board = scene(tmp_path)
    stated = camera(tmp_path, AmplitudeNonlinearity(2e-6))
    data = record(stated, board, poses=12, frames=2, seed=4)
    grown = replace(
        data,
        stations=[
            replace(one, amplitude=one.amplitude * (1 + 4e-5 * one.amplitude.astype(float)))
            for one in data.stations
        ],
    )
    names = ("amplitude_nonlinearity",)
    possible = fit(Problem(data, board, effects=names), stated)
    assert possible.at_bounds == {}
    # chi-square is compared by the same noise
    fitted = fit(Problem(grown, board, effects=names, amplitude_error=0.04), stated)
    label = "effects.amplitude_nonlinearity.compression"
    assert fitted.parameters[label] == 0.0
    assert [list(fitted.parameters)[i] for i in fitted.at_bounds] == [label]
    assert any(one.startswith(f"{label} is at the end of what is possible") for one in fitted.notes)
    (sigmas,) = fitted.at_bounds.values()
    assert sigmas > 20
    # all else is where it is without the effect
    assert fitted.converged
    linear = fit(Problem(grown, board, effects=(), amplitude_error=0.04), camera(tmp_path))
    assert fitted.chi_square == pytest.approx(linear.chi_square, rel=1e-3)
    assert fitted.parameters["radiometry.gain"] == pytest.approx(
        linear.parameters["radiometry.gain"], rel=1e-3
    )


def test_sigmas_beyond_a_bound_are_those_of_what_freeing_one_parameter_gains() -> None:
    """Of two that are nearly the same, both at 0: chi-square falls by 1 with either of them free, or both."""
    matrix = np.array([[1.0, 0.999, 0.11], [0.999, 1.0, 0.1], [0.11, 0.1, 2.0]])
    right = np.array([-1.0, -1.0, 0.4])
    step, held = least_within(matrix, right, np.array([0.0, 0.0, -inf]), np.full(3, inf))
    assert held.tolist() == [True, True, False]
    found = sigmas_beyond(matrix, right, step, held)

    def lowered(free: list[int]) -> float:
        part = matrix[np.ix_(free, free)]
        return float(right[free] @ np.linalg.solve(part, right[free]))

    for i in (0, 1):
        assert found[i] ** 2 == pytest.approx(lowered([2, i]) - lowered([2]))
    assert max(found.values()) < 1.2


@pytest.mark.parametrize("begun", [0.07, -0.21, 0.313])
def test_a_bound_is_reached_whatever_rounding_says(tmp_path: Path, begun: float) -> None:
    label = "effects.distance_scale.scale"
    start = camera(tmp_path, DistanceScale(begun))
    numbers, bounds = camera_numbers(start), Bounds.of(start)
    moved, offsets = stepped(start, {}, {label: -3.0}, bounds, numbers)
    within_bounds(offsets, moved, numbers)
    at = camera(tmp_path, DistanceScale(begun + offsets[label]))
    assert bounds.open_sides([label], at)[0].tolist() == [0.0]


def test_nothing_is_stepped_where_nothing_is_free() -> None:
    step, held = least_within(np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))
    assert (step.size, held.size) == (0, 0)


def test_noise_alone_takes_no_parameter_far_beyond_its_bound(tmp_path: Path) -> None:
    """Of a true compression of 0 the data of half of all seeds are for less."""
    board, stated = scene(tmp_path), camera(tmp_path, AmplitudeNonlinearity(0.0))
    stayed = []
    for seed in range(4):
        data = record(camera(tmp_path), board, poses=10, frames=2, seed=seed)
        fitted = fit(Problem(data, board, effects=("amplitude_nonlinearity",)), stated)
        stayed += fitted.at_bounds.values()
        assert not any("the end of what is possible" in one for one in fitted.notes)
    assert 1 <= len(stayed) <= 3
    assert max(stayed) < 3.0


def test_a_parameter_at_a_bound_may_go_one_way(tmp_path: Path) -> None:
    at_zero = camera(tmp_path, AmplitudeNonlinearity(0.0), DistanceScale(-0.5))
    labels = ["effects.amplitude_nonlinearity.compression", "radiometry.gain", "effects.distance_scale.scale"]
    bounds = Bounds.of(at_zero)
    down, up = bounds.open_sides(labels, at_zero)
    assert (down.tolist(), up.tolist()) == ([0, -inf, 0], [inf] * 3)
    inside = camera(tmp_path, AmplitudeNonlinearity(1e-12), DistanceScale(0.5))
    assert [one.tolist() for one in Bounds.of(inside).open_sides(labels, inside)] == [
        [-inf] * 3,
        [inf, inf, 0],
    ]


@pytest.mark.parametrize(
    ("sides", "held"), [((-0.8, 1.1, -0.2), [0]), ((-1.7, -2.3, -4.0), [0, 2]), ((0.8, 0.15, 0.2), [])]
)
def test_the_others_follow_a_parameter_that_stays_at_its_bound(
    tmp_path: Path, sides: tuple[float, ...], held: list[int]
) -> None:
    """The best of all sets of parameters that stay, those with none below 0."""
    at_zero = camera(tmp_path, AmplitudeNonlinearity(0.0), DistanceScale(-0.5))
    labels = ["effects.amplitude_nonlinearity.compression", "radiometry.gain", "effects.distance_scale.scale"]
    root = np.array([[2.0, 1.1, -0.7], [0.0, 1.5, 0.9], [0.0, 0.0, 0.8]])
    matrix, right = root.T @ root, root.T @ np.array(sides)
    tried = []
    for stay in ([], [0], [2], [0, 2]):
        own = [i for i in range(3) if i not in stay]
        x = np.zeros(3)
        x[own] = np.linalg.solve(matrix[np.ix_(own, own)], right[own])
        if x[0] >= 0 and x[2] >= 0:
            tried.append((float(0.5 * x @ matrix @ x - right @ x), stay, x))
    _, stay, expected = min(tried, key=lambda one: one[0])
    bounds = Bounds.of(at_zero)
    step, at = least_within(matrix, right, *bounds.open_sides(labels, at_zero))
    assert stay == held
    assert step == pytest.approx(expected, abs=1e-9)
    assert np.flatnonzero(at).tolist() == held
    limits = bounds.step_limits(labels, {}, camera_numbers(at_zero), at_zero.shape)
    assert (limits[0][0], limits[0][2]) == (0.0, 0.0)
    nothing: Any = None
    limited = Solved(nothing, labels, matrix, right, limits, 0.0, {}, {}).step
    assert limited == pytest.approx(expected, abs=1e-9)
