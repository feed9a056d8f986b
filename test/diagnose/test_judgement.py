"""What is left after naming: forms that are not quite true, noise of light that is not understood, kin."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.diagnose import setup
from rim_camera_ros.diagnose.accuracy import Accuracy
from rim_camera_ros.diagnose.described import is_unknown
from rim_camera_ros.diagnose.naming import notes_of_refused, with_unknown
from rim_camera_ros.diagnose.noise_verdict import (
    only_background,
    only_noise,
    only_rectified_noise,
    with_variance,
)
from rim_camera_ros.diagnose.result import Missing, Ranked
from rim_camera_ros.diagnose.setup import PoseCheck
from rim_camera_ros.diagnose.variance import Variance, VarianceBin
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.noise import Noise
from rim_camera_ros.select.compare import NOT_IN_ALL_POSES, NOT_IN_QUIET_PIXELS, Found, Refused
from rim_camera_ros.select.moved_poses import MovedPose

from ..calibrate.helpers import camera

HYPERBOLA = AmplitudeOffset(hyperbola={16.0: Hyperbola(a=11.0, b=2.0)})


def variance(ratio: float) -> Variance:
    bins = (VarianceBin(100.0, ratio, 0.001), VarianceBin(900.0, 1.0, 0.001))
    return Variance(ratio, 0.001, bins, Noise(floor=0.004, amplitude=30.0), None, np.inf, 0.001, True)


@pytest.mark.parametrize(
    ("verdict", "ratio", "named"),
    [
        ("consistent", 0.95, []),  # within what a stated noise is known to
        ("consistent", 0.93, ["noise"]),
        ("missing_physics", 0.93, ["noise"]),
        ("unknown_physics", 0.93, []),  # the light that the noise goes with is not known that well
        ("unknown_physics", 1.15, []),
        ("unknown_physics", 1.3, ["noise"]),
    ],
)
def test_noise_with_unknown_physics_must_be_far_off(
    tmp_path: Path, verdict: str, ratio: float, named: list[str]
) -> None:
    unknown = Missing("unknown", 1.0, {}, {}, "", covariates=("row",))
    before = [unknown] if verdict == "unknown_physics" else []
    said, missing, _ = with_variance(verdict, before, camera(tmp_path), variance(ratio), [], False)
    assert [one.effect for one in missing if one is not unknown] == named
    assert said == (verdict if not named or verdict == "unknown_physics" else "missing_physics")


def test_distance_terms_have_covariates_of_their_own() -> None:
    assert HYPERBOLA.own_covariates() == {"amplitude", "settings"}
    assert IncidenceAngle(polynomial={16.0: (0.0, 0.0, 1e-5, 2e-4)}).own_covariates() == {
        "incidence",
        "settings",
    }
    lagging = AmbientTemperature(coefficient=0.002, reference=20.0, time_constant=600.0)
    assert lagging.own_covariates() == {"ambient_temperature", "temperature", "settings"}
    assert Scattering((Kernel(0.01, (3.0, 4.0)),)).own_covariates() == frozenset()


@pytest.mark.parametrize(
    ("gains", "found", "unknown"),
    [
        ({"distance": 320.0, "amplitude": 210.0}, ["amplitude_offset"], False),  # nearly all in its own
        ({"distance": 320.0, "amplitude": 100.0}, ["amplitude_offset"], True),
        ({"distance": 320.0, "amplitude": 210.0}, [], True),
        ({"distance": 140.0, "amplitude": 5.0}, ["amplitude_offset"], False),  # below 15 % of 1,000 nats
    ],
)
def test_a_form_that_is_not_quite_true_is_no_unknown_physics(
    tmp_path: Path, gains: dict[str, float], found: list[str], unknown: bool
) -> None:
    names = list(gains)
    final: Any = SimpleNamespace(
        fit=SimpleNamespace(camera=camera(tmp_path, HYPERBOLA)),
        candidates=[SimpleNamespace(variant=name) for name in ["amplitude", *names]],
        joint=lambda k: [900.0, *gains.values()][k],  # a candidate of the vocabulary stands first
        named=1,
    )
    result: Any = SimpleNamespace(found=[Found(name, 1000.0) for name in found])
    rest: Any = SimpleNamespace(on_top=gains["distance"], threshold=20.0, fine=None)
    assert is_unknown(rest, 1000.0, final, result) is unknown
    fine: Any = SimpleNamespace(on_top=gains["distance"], threshold=20.0, fine=object())
    assert is_unknown(fine, 1000.0, final, result) is (gains["distance"] > 150.0)


@pytest.mark.parametrize(
    ("before", "acted_on", "where", "physics", "reason"),
    [
        # nothing acts there
        (30.0, 0.0, 0.7, ["motion"], "1 of 20 poses do not agree with the rest (7)"),
        (400.0, 0.0, 0.0, ["motion"], None),  # what was found explains most of it
        (30.0, 60.0, 0.0, ["motion"], None),  # its form leaves that much
        (30.0, 2.0, 0.9, ["motion"], None),  # ... and only where it acts
        (30.0, 40.0, 0.0, ["motion"], "1 of 20 poses do not agree with the rest (7)"),
        (400.0, 60.0, 0.9, [], "1 of 20 poses do not agree with the rest (7)"),
    ],
)
def test_a_pose_on_which_named_physics_acts_is_no_bad_setup(
    monkeypatch: pytest.MonkeyPatch,
    before: float,
    acted_on: float,
    where: float,
    physics: list[str],
    reason: str | None,
) -> None:
    def checks(chi_square: float) -> list[PoseCheck]:
        bad = PoseCheck((0, 7), chi_square, 0.0, 7.0, acted_on, where)
        return [bad if k == 7 else PoseCheck((0, k), 1.0, 0.0, float(k)) for k in range(20)]

    start: Any = "before"
    after: Any = SimpleNamespace(forward=SimpleNamespace(dataset=SimpleNamespace(stations=[])))
    monkeypatch.setattr(
        setup, "check_poses", lambda fitted, physics=(): checks(before if fitted == start else 150.0)
    )
    monkeypatch.setattr(setup, "_gross", lambda fitted, found: None)
    found = setup.check_setup(after, physics=physics, before=start)
    assert (found.reason or "").startswith(reason or "")
    assert (found.reason is None) == (reason is None)
    assert found.chi_square == pytest.approx((19 + 150) / 20)


@pytest.mark.parametrize(
    ("acted_on", "size", "bad"),
    [
        (0.0, 0.3, ((0, 7), (0, 9))),
        (40.0, 0.3, ((0, 9),)),  # half of 0.09 x 40 x 500 is 900 nats
        (40.0, 0.01, ((0, 7), (0, 9))),  # as the form is known to 1 %, which leaves 1 nat
        (4000.0, 0.3, ((0, 9),)),  # it does not act in the other one
    ],
)
def test_a_pose_in_which_the_form_of_physics_may_do_as_much_stands_where_it_is_said(
    monkeypatch: pytest.MonkeyPatch, acted_on: float, size: float, bad: tuple[Any, ...]
) -> None:
    poses = [PoseCheck((0, k), 1.0, 0.0, float(k), acted_on if k == 7 else 0.0, 0.0, 500) for k in range(20)]
    monkeypatch.setattr(setup, "check_poses", lambda fitted, physics=(): poses)
    monkeypatch.setattr(setup, "_gross", lambda fitted, found: None)
    # placements have numbers of their own
    stations = [SimpleNamespace(recording=0, pose=k, placed=100 + k, time=9.0) for k in range(20)]
    after: Any = SimpleNamespace(forward=SimpleNamespace(dataset=SimpleNamespace(stations=stations)))
    moved = [MovedPose((0, 100 + k), "board", 300.0, (("offset", 0.02),), 20.0) for k in (7, 9)]
    found = setup.check_setup(after, physics=["motion"], moved=moved, form_size=size)
    assert found.bad == bad


@pytest.mark.parametrize(
    ("ratio", "background", "gain", "rest", "by_light", "only"),
    [
        (1.25, 1900.0, 86.0, 50.0, 40.0, True),  # of 12,500 nats that the noise costs
        (1.25, 1900.0, 240.0, 50.0, 40.0, False),
        (1.25, 1900.0, 9200.0, 8500.0, 10_200.0, True),  # a function of the light says more
        (1.25, 1900.0, 9200.0, 8500.0, 9100.0, True),  # a scale of distance is nearly one itself
        (1.25, 1900.0, 9200.0, 8500.0, 7300.0, False),
        (1.25, 0.0, 86.0, 50.0, 400.0, False),  # its form over the amplitude is not that of such light
        (1.0, 1900.0, 86.0, 50.0, 400.0, False),
    ],
)
def test_what_comes_with_unmodulated_light_is_its_own_shift(
    tmp_path: Path, ratio: float, background: float, gain: float, rest: float, by_light: float, only: bool
) -> None:
    first = SimpleNamespace(
        scores=SimpleNamespace(chi_square=lambda: (1.0, 100_000)),
        candidates=[SimpleNamespace(variant=name) for name in ("", "time", "amplitude", "distance")],
        gains=np.array([gain, 2e4, by_light, 10.0]),
        named=1,
    )
    result: Any = SimpleNamespace(
        found=[Found("distance_scale", gain)],
        explorations=[first],
        gained=gain,
    )
    left: Any = SimpleNamespace(on_top=rest)
    seen = replace(variance(ratio), background=background)
    assert only_background(result, left, seen, camera(tmp_path)) is only
    assert not only_background(SimpleNamespace(found=[]), left, seen, camera(tmp_path))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("on_top", "ratio", "only"), [(130.0, 1.09, True), (130.0, 1.0, False), (1300.0, 1.09, False)]
)
def test_what_is_nothing_compared_with_the_noise_is_no_unknown_physics(
    on_top: float, ratio: float, only: bool
) -> None:
    scores = SimpleNamespace(chi_square=lambda: (1.0, 460_000))
    result: Any = SimpleNamespace(explorations=[SimpleNamespace(scores=scores)])
    rest: Any = SimpleNamespace(on_top=on_top)
    assert only_noise(result, rest, variance(ratio)) is only


@pytest.mark.parametrize(
    ("names", "gained", "ratio", "only"),
    [
        (["amplitude_nonlinearity"], 860.0, 1.8, True),  # 184,000 nats are what the noise costs
        (["amplitude_nonlinearity"], 4000.0, 1.8, False),
        (["amplitude_nonlinearity"], 860.0, 0.8, False),  # less noise lifts no amplitude
        (["amplitude_nonlinearity", "scattering"], 860.0, 1.8, False),
        (["scattering"], 860.0, 1.8, False),
    ],
)
def test_noise_lifts_dark_amplitudes(names: list[str], gained: float, ratio: float, only: bool) -> None:
    scores = SimpleNamespace(chi_square=lambda: (1.0, 460_000))
    result: Any = SimpleNamespace(
        explorations=[SimpleNamespace(scores=scores)],
        found=[Found(name, gained / len(names)) for name in names],
        gained=gained,
    )
    assert only_rectified_noise(result, variance(ratio)) is only


@pytest.mark.parametrize(
    ("rms", "chi2", "held_out", "note"),
    [
        ((0.02, 0.0201), (1.03, 1.36), True, "rose from 1.03 to 1.36"),
        ((0.02, 0.0201), (0.88, 1.04), True, None),  # as it should be
        ((0.02, 0.023), (1.03, 1.36), True, "do not use camera.yaml"),
        ((0.02, 0.023), (1.03, 1.36), False, None),
        ((0.02, 0.019), (1.5, 1.1), True, None),
        ((0.02, 0.019), (1.5, 1.14), True, "is still 1.14: .* which intervals do not allow for"),
        ((0.02, 0.02), (1.5, 1.5), True, None),  # nothing was found
    ],
)
def test_what_got_worse_is_said(
    rms: tuple[float, float], chi2: tuple[float, float], held_out: bool, note: str | None
) -> None:
    found = Accuracy(*rms, 0.018, *chi2, held_out)
    notes = found.notes()
    assert found.got_worse == any("rose" in one or "do not use" in one for one in notes)
    assert len(notes) == (note is not None)
    assert all(note is not None and re.search(note, one) for one in notes)


@pytest.mark.parametrize(
    ("chi2", "held_out", "share"),
    [
        ((3.0, 1.5), True, 0.75),
        ((16.8, 7.1), True, 9.7 / 15.8),
        ((1.44, 1.06), True, 1.0),  # what is left is within what nulls leave
        ((2.0, 2.6), True, 0.0),
        ((3.0, 1.5), False, 1.0),  # nothing is held out
    ],
)
def test_names_are_as_certain_as_they_explain_what_does_not_fit(
    chi2: tuple[float, float], held_out: bool, share: float
) -> None:
    assert Accuracy(0.02, 0.019, 0.018, *chi2, held_out).explained == pytest.approx(share)


def test_what_names_explain_is_of_all_errors() -> None:
    """Given errors that neighbours share, which take up most of an effect, it would be 17 %."""
    found = Accuracy(0.012, 0.011, 0.008, 1.32, 1.27, True, all_before=3.0, all_after=1.66)
    assert found.explained == pytest.approx(1.34 / 2.0)
    assert re.search("or something else is missing", found.notes()[0])
    alone = replace(found, all_after=1.02)
    assert alone.explained == pytest.approx(1.98 / 2.0)
    assert re.fullmatch(
        r"chi-square per value of held-out poses is still 1\.27: the form of what was found is not quite the "
        r"true one, which intervals do not allow for; changed a little, it leaves 1\.02",
        alone.notes()[0],
    )


def test_a_note_for_each_reason_tells_what_was_not_added() -> None:
    refused = [
        Refused("emitter_offset", 2381.4, 54.0, NOT_IN_ALL_POSES),
        Refused("scattering", 97.0, 16.0, NOT_IN_QUIET_PIXELS),
        Refused("radiometry", 60.0, 8.0, NOT_IN_ALL_POSES),
    ]
    result: Any = SimpleNamespace(refused=refused)
    assert notes_of_refused(result) == [
        f"not added, {NOT_IN_ALL_POSES}: emitter_offset (2,381 nats, its threshold 54), radiometry (60 nats, "
        "its threshold 8)",
        f"not added, {NOT_IN_QUIET_PIXELS}: scattering (97 nats, its threshold 16)",
    ]


def test_unknown_physics_has_its_place_in_the_ranking() -> None:
    """A softmax over the effects, what is unknown and nothing: of 9, 7 and 6 nats and 0."""
    ranking = [Ranked("height_effect", 0.9, 7.0, 0.5, 3.0), Ranked("other", 0.1, 6.0)]
    found = with_unknown(ranking, 9.0)
    total = np.exp(9) + np.exp(7) + np.exp(6) + 1
    assert [one.effect for one in found] == ["unknown", "height_effect", "other"]
    assert [one.probability for one in found] == pytest.approx([np.exp(g) / total for g in (9, 7, 6)])
    assert (found[1].identifiability, found[1].expected_gain) == (0.5, 3.0)
