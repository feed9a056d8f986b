"""What a fit by the files of another set-up leaves, and when that decides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.diagnose.compare_setups import compare_setups
from rim_camera_ros.diagnose.hypotheses import Files, Hypothesis, best_setup, leaving_nothing
from rim_camera_ros.diagnose.under_setup import left_by_chance
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.frame import Pose

from ..calibrate.helpers import camera, record, scene

GIVEN = cast(Files, ("recording", "scene", "camera"))
TURNED = Hypothesis("turned_180", "board", 100.0, 9.0, share=0.3, change=lambda *_: GIVEN)


def other_sign(pose: Pose) -> Pose:
    """The pose with the opposite second component of its rotation vector, by scipy."""
    vector = Rotation.from_quat(pose.orientation).as_rotvec() * (1.0, -1.0, 1.0)
    x, y, z, w = Rotation.from_rotvec(vector).as_quat()
    return Pose(pose.position, (float(x), float(y), float(z), float(w)))


@pytest.mark.parametrize(("left", "share", "wins"), [(8.0, 100 / 108, True), (20.0, 0.833, False)])
def test_a_setup_wins_where_it_explains_all_but_what_chance_leaves(
    left: float, share: float, wins: bool
) -> None:
    others = [replace(TURNED, hypothesis="mirrored", gain=60.0), Hypothesis("as_given", "", 0.0, 0.0)]
    found = leaving_nothing([TURNED, *others], GIVEN, lambda files: left)
    assert found[1:] == others
    assert found[0].share == pytest.approx(share, rel=1e-3)
    assert (best_setup(found) is not None) is wins


def test_a_setup_under_which_something_is_missing_is_held_against_physics() -> None:
    assert leaving_nothing([TURNED], GIVEN, lambda files: None) == [TURNED]


@pytest.mark.parametrize(
    "leader",
    [
        replace(TURNED, fitted=True),
        replace(TURNED, gain=15.0),
        replace(TURNED, standard_error=60.0),
        replace(TURNED, share=0.95),
    ],
)
def test_what_does_not_lead_or_has_won_is_not_fitted(leader: Hypothesis) -> None:
    def never(files: Files) -> float | None:
        raise AssertionError

    assert leaving_nothing([leader], GIVEN, never) == [leader]


def test_what_the_true_files_leave(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    data = record(given, board, poses=12, seed=3)
    left = left_by_chance((data, board, given), seed=0, threads=1)
    assert left is not None
    # one parameter of so many candidates must gain 4.5 nats, curves of several more (docs/decision.md)
    assert 4.5 <= left < 40.0


def test_files_that_lack_physics_leave_more(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    cyclic = CyclicError(harmonics=(Harmonic(4, 0.012, 0.7),))
    data = record(with_effects(given, {cyclic.name: cyclic}), board, poses=12, seed=3)
    assert left_by_chance((data, board, given), seed=0, threads=1) is None


def test_the_sign_of_a_component_of_the_rotation_vector(tmp_path: Path) -> None:
    """Of boards that are rolled it is another pose than that whose normal is mirrored."""
    given, board = camera(tmp_path), scene(tmp_path)
    data = record(given, board, poses=12, seed=3, roll=40.0)
    wrong = [
        replace(one, truth={name: other_sign(pose) for name, pose in one.truth.items()})
        for one in data.stations
    ]
    best = best_setup(compare_setups(replace(data, stations=wrong), board, given))
    assert best is not None
    assert (best.hypothesis, best.surface) == ("pose", "board")
    assert best.change is not None
    mended, _, _ = best.change(replace(data, stations=wrong), board, given)
    for one, true in zip(mended.stations, data.stations, strict=True):
        found, there = (Rotation.from_quat(x.truth["board"].orientation) for x in (one, true))
        assert (found.inv() * there).magnitude() == pytest.approx(0.0, abs=1e-9)
