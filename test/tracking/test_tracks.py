"""Kalman filter against closed forms and scipy's Riccati solver; assignment against what is known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are
from scipy.stats import chi2

from rim_camera_ros.tracking.moving import Detection, detection
from rim_camera_ros.tracking.tracks import (
    Tracker,
    TrackSettings,
    predict,
    process_noise,
    transition,
    update,
)

RADIUS = 0.15


def seen(x: float, y: float, *, area: float = 0.5) -> Detection:
    """Return the detection of somebody whose body's axis is at (x, y)."""
    place = np.array([x, y])
    cell = place - math.pi / 4 * RADIUS * place / np.linalg.norm(place)
    cells = cell + np.array([[0.0, -0.1], [0.0, 0.1]])
    made = detection(cells, np.array([area / 2, area / 2]), top=1.7, body_radius=RADIUS)
    return Detection(place, made.area, made.top, made.cells, made.cell_areas)


# --- filter -------------------------------------------------------------------------------------


def test_process_noise_is_the_integral_of_white_acceleration() -> None:
    """Van Loan's matrix exponential gives the covariance of the continuous model."""
    density, step = 0.3, 0.7
    drift = np.zeros((4, 4))
    drift[0, 2] = drift[1, 3] = 1.0
    spread = np.diag([0.0, 0.0, density, density])
    exponential = expm(np.block([[-drift, spread], [np.zeros((4, 4)), drift.T]]) * step)
    motion = exponential[4:, 4:].T
    assert transition(step) == pytest.approx(motion)
    assert process_noise(step, density) == pytest.approx(motion @ exponential[:4, 4:])


def test_two_positions_of_somebody_of_whom_nothing_is_known() -> None:
    """Velocity (z2 - z1) / dt with variance 2 R / dt^2 + q dt / 3, position z2 with R, covariance R / dt."""
    step, density, variance = 0.2, 0.4, 0.01
    first, second = np.array([1.0, -2.0]), np.array([1.3, -1.9])
    state, covariance = np.zeros(4), np.diag([1e8, 1e8, 1e8, 1e8])
    state, covariance = update(state, covariance, first, variance=variance)
    state, covariance = predict(state, covariance, step=step, density=density)
    state, covariance = update(state, covariance, second, variance=variance)
    assert state == pytest.approx([*second, *(second - first) / step], rel=1e-5)
    assert np.diag(covariance)[:2] == pytest.approx(variance, rel=1e-5)
    assert np.diag(covariance)[2:] == pytest.approx(2 * variance / step**2 + density * step / 3, rel=1e-5)
    assert covariance[0, 2] == pytest.approx(variance / step, rel=1e-5)
    assert covariance[0, 1] == covariance[0, 3] == 0


def test_the_covariance_settles_at_the_solution_of_the_riccati_equation() -> None:
    step, density, variance = 0.1, 0.2, 0.06**2
    observed = np.eye(2, 4)
    expected = solve_discrete_are(
        transition(step).T, observed.T, process_noise(step, density), variance * np.eye(2)
    )
    state, covariance = np.zeros(4), np.eye(4)
    for _ in range(400):
        state, covariance = update(state, covariance, np.zeros(2), variance=variance)
        state, covariance = predict(state, covariance, step=step, density=density)
    assert covariance == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_innovations_have_the_predicted_spread() -> None:
    """Normalised innovations of the model's own motion are chi-squared with two degrees of freedom."""
    rng = np.random.default_rng(5)
    step, density, variance = 0.1, 0.2, 0.05**2
    root = np.linalg.cholesky(process_noise(step, density))
    distances = []
    for _ in range(100):
        truth = np.array([3.0, -1.0, 0.4, 1.1])
        state, covariance = truth.copy(), np.zeros((4, 4))
        for _ in range(60):
            truth = transition(step) @ truth + root @ rng.standard_normal(4)
            state, covariance = predict(state, covariance, step=step, density=density)
            position = truth[:2] + math.sqrt(variance) * rng.standard_normal(2)
            spread = covariance[:2, :2] + variance * np.eye(2)
            distances.append((position - state[:2]) @ np.linalg.solve(spread, position - state[:2]))
            state, covariance = update(state, covariance, position, variance=variance)
    assert np.mean(distances) == pytest.approx(2.0, abs=5 * 2 / math.sqrt(6000))
    for gate in (0.5, 0.99):
        share = np.mean(np.array(distances) <= chi2.ppf(gate, 2))
        assert share == pytest.approx(gate, abs=5 * math.sqrt(gate * (1 - gate) / 6000))


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(
        st.tuples(st.floats(0.0, 3.0), st.booleans(), st.floats(1e-4, 1.0)), min_size=1, max_size=30
    )
)
def test_covariances_stay_symmetric_and_positive(steps: list[tuple[float, bool, float]]) -> None:
    state, covariance = np.zeros(4), np.diag([0.01, 0.01, 1.0, 1.0])
    for step, measured, sigma in steps:
        state, covariance = predict(state, covariance, step=step, density=0.2)
        if measured:
            before = np.trace(covariance[:2, :2])
            state, covariance = update(state, covariance, np.array([1.0, -1.0]), variance=sigma**2)
            assert np.trace(covariance[:2, :2]) <= before + 1e-12  # to see is to know more
        assert covariance == pytest.approx(covariance.T, abs=1e-9)
        assert np.linalg.eigvalsh(covariance).min() > 0


# --- identities ---------------------------------------------------------------------------------


def walk(
    tracker: Tracker, ways: dict[str, NDArray[np.float64]], hidden: dict[str, range] | None = None
) -> list[dict[int, NDArray[np.float64]]]:
    """Feed positions (T, 2) at 10 Hz, without those that are hidden; return positions by identity."""
    result = []
    for i in range(len(next(iter(ways.values())))):
        found = [seen(*way[i]) for name, way in ways.items() if i not in (hidden or {}).get(name, range(0))]
        people = tracker.take(found, time=i / 10)
        result.append({one.identity: one.position.copy() for one in people})
    return result


def line(start: tuple[float, float], velocity: tuple[float, float], frames: int) -> NDArray[np.float64]:
    return np.array(start) + np.arange(frames)[:, None] / 10 * np.array(velocity)


def test_a_person_is_shown_from_the_third_detection_on() -> None:
    shown = walk(Tracker(TrackSettings(confirm_after=3)), {"one": line((3, -1), (0.2, 1.0), 5)})
    assert [list(one) for one in shown] == [[], [], [1], [1], [1]]


def test_a_single_false_alarm_is_nobody() -> None:
    tracker = Tracker()
    for i in range(10):
        assert tracker.take([seen(3.0, 1.0)] if i % 2 else [], time=i / 10) == []


@pytest.mark.parametrize(("seconds", "identities"), [(1.0, {1}), (1.9, {1}), (2.6, {1, 2})])
def test_a_hidden_person_is_predicted_for_two_seconds(seconds: float, identities: set[int]) -> None:
    way = line((3.0, -2.5), (0.1, 0.8), 60)
    hidden = range(15, 15 + round(10 * seconds))
    shown = walk(Tracker(TrackSettings(coast=2.0)), {"one": way}, {"one": hidden})
    assert set().union(*shown) == identities
    if identities == {1}:
        # no noise, no acceleration: what is predicted while nothing is seen is where he is
        assert shown[hidden.stop - 1][1] == pytest.approx(way[hidden.stop - 1], abs=0.1)


def test_who_pass_each_other_hidden_go_on_and_do_not_turn_back() -> None:
    """By the nearest last position they would exchange identities: only velocities tell them apart."""
    ways = {"one": line((3.4, -2.0), (0.0, 1.0), 40), "other": line((3.7, 2.0), (0.0, -1.0), 40)}
    hidden = {"one": range(17, 24), "other": range(17, 24)}
    before, after = 16, 24
    nearest = np.argmin([np.linalg.norm(ways["one"][before] - way[after]) for way in ways.values()])
    assert nearest == 1
    shown = walk(Tracker(), ways, hidden)
    assert all(set(one) <= {1, 2} for one in shown)
    assert shown[-1][1] == pytest.approx(ways["one"][-1], abs=0.02)
    assert shown[-1][2] == pytest.approx(ways["other"][-1], abs=0.02)


def test_the_whole_assignment_is_the_likeliest_not_the_first() -> None:
    """A detection nearest to both goes where the sum is least: greedy choice would lose one person."""
    tracker = Tracker(TrackSettings(measurement_sigma=0.1))
    for i in range(12):
        tracker.take([seen(3.0, 0.0), seen(3.0, 0.5)], time=i / 10)
    people = tracker.take([seen(3.0, 0.26), seen(3.0, 0.62)], time=1.2)
    assert [one.hidden for one in people] == [False, False]
    assert people[0].position[1] < 0.26
    assert 0.5 < people[1].position[1] < 0.62


def test_what_lies_outside_of_the_gate_is_somebody_else() -> None:
    tracker = Tracker()
    for i in range(10):
        tracker.take([seen(3.0, 0.0)], time=i / 10)
    for i in range(10, 14):
        people = tracker.take([seen(3.0, 1.5)], time=i / 10)
    assert [(one.identity, one.hidden) for one in people] == [(1, True), (2, False)]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3)))[1:])
def test_the_order_of_detections_does_not_matter(order: tuple[int, ...]) -> None:
    def run(arrange: tuple[int, ...]) -> list[tuple[float, ...]]:
        tracker = Tracker()
        for i in range(20):
            found = [
                seen(3.0, -1.0 + 0.08 * i),
                seen(3.6, 1.2 - 0.1 * i),
                seen(4.5, 0.02 * i),
            ]
            people = tracker.take([found[k] for k in arrange], time=i / 10)
        return sorted(tuple(one.state.round(9)) for one in people)

    assert run(order) == run((0, 1, 2))


def test_who_is_half_hidden_is_believed_less() -> None:
    def moved(area: float) -> float:
        tracker = Tracker()
        for i in range(20):
            tracker.take([seen(3.0, 0.0, area=0.5)], time=i / 10)
        (one,) = tracker.take([seen(3.0, 0.1, area=area)], time=2.0)
        return float(one.position[1])

    whole, half = moved(0.5), moved(0.25)
    assert 0.02 < whole < 0.1
    assert half < whole / 2


def test_identities_are_not_used_again() -> None:
    tracker = Tracker()
    for i in range(5):
        tracker.take([seen(3.0, 0.0)], time=i / 10)
    tracker.forget()
    assert tracker.people == []
    for i in range(5, 10):
        people = tracker.take([seen(3.0, 0.0)], time=i / 10)
    assert [one.identity for one in people] == [2]
    assert [round(entry[0], 1) for entry in people[0].trail] == [0.5, 0.6, 0.7, 0.8, 0.9]
