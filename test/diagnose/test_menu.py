"""Identifiability of a candidate, and which experiment would tell rivals apart."""

from __future__ import annotations

import numpy as np
import pytest

from rim_camera_ros.calibrate.plan import shipped_experiments
from rim_camera_ros.diagnose.menu import Proposal, _gain, recommended
from rim_camera_ros.diagnose.naming import next_recording
from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.normal_equations import NormalEquations
from rim_camera_ros.select.evidence import Scores

NARROW = np.diag([1e-12])
WIDE = np.diag([1e12])


def scores_of(design: np.ndarray, observed: np.ndarray) -> Scores:
    """Normal equations of plain regression: unit weights, no pattern, no errors of poses."""
    everything = np.column_stack([design, observed])
    gram = everything.T @ everything
    fold = Fold([], gram, np.zeros((1, gram.shape[0])), np.zeros(1), rows=len(observed))
    regressors = [Regressor(f"p{i}", "any", 1e6) for i in range(design.shape[1])]
    return Scores(NormalEquations(regressors, [fold]), [0])


@pytest.mark.parametrize("likeness", [0.0, 0.6, 0.99])
def test_identifiability_is_what_the_base_cannot_take_on(likeness: float) -> None:
    rng = np.random.default_rng(5)
    base, other = np.linalg.qr(rng.normal(size=(400, 2)))[0].T
    candidate = likeness * base + np.sqrt(1 - likeness**2) * other
    scores = scores_of(np.column_stack([base, 7.0 * candidate]), 3.0 * base + 28.0 * candidate)
    share, gain = scores.identifiability([1])
    assert share == pytest.approx(1 - likeness**2, rel=1e-6)
    assert gain == pytest.approx(0.5 * 28.0**2 * (1 - likeness**2), rel=1e-6)


def test_a_candidate_without_a_signal_has_no_identifiability() -> None:
    rng = np.random.default_rng(6)
    scores = scores_of(np.column_stack([rng.normal(size=50), np.zeros(50)]), rng.normal(size=50))
    assert scores.identifiability([1]) == (0.0, 0.0)


def test_rivals_speak_against_themselves_where_they_do_not_show() -> None:
    left = np.diag([4.0, 9.0])  # squared signals of a unit of each, in an experiment that parts them
    spans = [[0], [1]]
    # the other must have the strength 0.5 that the first recording needs: it would be seen, and is not
    fixed = [(np.array([2.0]), NARROW), (np.array([0.5]), NARROW)]
    assert _gain(left, spans, fixed, 0, 1) == pytest.approx(0.5 * (4 * 2.0**2 + 9 * 0.5**2))
    # it may be anything: only what the true one shows counts
    free = [(np.array([2.0]), WIDE), (np.array([0.5]), WIDE)]
    assert _gain(left, spans, free, 0, 1) == pytest.approx(0.5 * 4 * 2.0**2)
    assert _gain(left, spans, free, 1, 0) == pytest.approx(0.5 * 9 * 0.5**2)


def test_rivals_that_look_alike_are_not_distinguished() -> None:
    left = np.array([[4.0, 6.0], [6.0, 9.0]])  # the second is the first, times 1.5
    same = [(np.array([1.5]), NARROW), (np.array([1.0]), NARROW)]
    assert _gain(left, [[0], [1]], same, 0, 1) == pytest.approx(0.0, abs=1e-9)


def test_the_shortest_experiment_that_settles_it_is_recommended() -> None:
    proposals = [Proposal("long", 90.0, 800.0), Proposal("short", 7.0, 120.0), Proposal("shorter", 2.0, 20.0)]
    assert recommended(proposals, threshold=10.0) == proposals[1]
    assert recommended(proposals, threshold=500.0) == proposals[0]
    assert recommended([Proposal("blind", 1.0, 0.2)], threshold=10.0) is None
    assert recommended([], threshold=10.0) is None


def test_what_to_record_next_in_words() -> None:
    ties = [["cyclic_error", "distance_scale"], ["background_light", "noise"]]
    text = next_recording(
        ties, {("cyclic_error", "distance_scale"): Proposal("track_line_experiment", 25.1, 61.4)}
    )
    assert text is not None
    assert text.startswith(
        "track_line_experiment (25 min) is expected to distinguish cyclic error and distance scale by 61 nats"
    )
    assert "for background_light: " in text
    assert "none of the shipped experiments" in str(
        next_recording(ties[:1], {("cyclic_error", "distance_scale"): None})
    )
    assert next_recording([], {}) is None


def test_the_menu_are_the_shipped_experiments() -> None:
    assert {
        "track_line_experiment",
        "board_by_hand_experiment",
        "climate_cell_experiment",
    } <= shipped_experiments().keys()
