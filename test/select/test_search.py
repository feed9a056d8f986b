"""The search's judgement: what is another physics' mark, what an effect became, what a trial may change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera_file import lean_camera, with_effects
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern, squared_angle
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.motion import Motion
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem, keeps_amplitude_error
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.fit.views import NEAR
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.scene import Scene
from rim_camera_ros.select import best_trial
from rim_camera_ros.select.best_trial import Trials
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.compare import (
    NOT_IN_ALL_POSES,
    NOT_IN_TIME,
    ONCE_FITTED,
    SAME_PHYSICS,
    Found,
    Refused,
    Trial,
    as_good,
    curve_of_forms,
    discrepancy,
    entry_gain,
    paired_error,
    refused,
    smooth_says_more,
    what_it_became,
)
from rim_camera_ros.select.effect_sizes import contribution, effect_size
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.forward_search import Search
from rim_camera_ros.select.search import search
from rim_camera_ros.select.trials import without_effect

from ..calibrate.helpers import camera, record, scene

CYCLIC = CyclicError((Harmonic(4, 0.011, 0.7),), (0.0, 0.0))


def exploration(smooth: tuple[float, int] | None, pair: tuple[float, tuple[int, int]] | None) -> Any:
    return SimpleNamespace(
        best_further=lambda: smooth,
        best_pair=lambda: pair,
        gains=np.array([40.0, 20.0, 5.0, 100.0]),
        thresholds=np.array([8.0, 9.0, 10.0, 11.0]),
        named=3,
    )


@pytest.mark.parametrize(
    ("smooth", "pair", "another"),
    [
        ((100.0, 3), (60.0, (0, 1)), True),
        ((100.0, 3), (70.0, (0, 1)), False),  # two effects explain nearly as much
        ((59.0, 3), None, False),  # so does one
        ((61.0, 3), None, True),
        (None, None, False),
    ],
)
def test_a_smooth_function_that_says_far_more_is_the_mark_of_another_physics(
    smooth: tuple[float, int] | None, pair: tuple[float, tuple[int, int]] | None, another: bool
) -> None:
    assert smooth_says_more(exploration(smooth, pair)) is another


def test_a_smooth_function_below_its_threshold_says_nothing() -> None:
    step = exploration((15.0, 3), None)
    step.gains = np.array([1.0, 0.5, 0.2, 15.0])
    assert not smooth_says_more(step)


@pytest.mark.parametrize(
    ("kernels", "ghost", "became"),
    [
        ((Kernel(0.002, (0.65, 0.7)),), None, (7,)),
        ((Kernel(0.002, (1.9, 1.3)),), None, (7,)),
        ((Kernel(0.002, (0.65, 2.3)),), None, None),
        ((Kernel(0.002, (0.65, 0.7)), Kernel(0.001, (24.0, 31.0))), None, None),
        ((Kernel(0.002, (0.65, 0.7)), Kernel(1e-6, (24.0, 31.0))), None, (7,)),
        ((Kernel(0.002, (0.65, 0.7)),), Ghost(0.01, (20.0, -3.0)), None),
    ],
)
def test_stray_light_within_its_pixel_is_two_surfaces_in_a_pixel(
    tmp_path: Path, kernels: tuple[Kernel, ...], ghost: Ghost | None, became: tuple[int, ...] | None
) -> None:
    fitted = camera(tmp_path, Scattering(kernels, ghost))
    alone: Any = SimpleNamespace(fit=SimpleNamespace(camera=fitted))
    effects = {4: "scattering", 7: "mixed_pixels"}
    step: Any = SimpleNamespace(
        best=lambda: {"scattering": 4, "mixed_pixels": 7},
        candidates={k: SimpleNamespace(effect=name) for k, name in effects.items()},
    )
    assert what_it_became(alone, (4,), step, fitted) == became


def test_halos_without_light_are_dropped(tmp_path: Path) -> None:
    halo, idle = Kernel(0.01, (5.0, 6.0)), Kernel(0.0, (33.0, 34.0))
    stated = camera(tmp_path, CYCLIC, Scattering((idle, halo, idle)))
    lean = lean_camera(stated)
    assert lean.effects == {"scattering": Scattering((halo,)), "cyclic_error": CYCLIC}
    assert lean_camera(lean) is lean
    assert lean_camera(camera(tmp_path, CYCLIC)).effects == {"cyclic_error": CYCLIC}
    ghost = Ghost(0.004, (7.0, -3.0))
    assert Scattering((idle,), ghost).lean() == Scattering((), ghost)
    assert Scattering((idle, idle)).lean() == Scattering((idle,))


def test_stray_light_of_one_halo_is_found_as_such(tmp_path: Path) -> None:
    """Candidates are pairs of halos: the second gets no light to speak of."""
    board, true = scene(tmp_path), Scattering((Kernel(0.03, (5.0, 6.0)),))
    stated = camera(tmp_path, CYCLIC)
    problem = Problem(record(camera(tmp_path, true, CYCLIC), board, poses=9, seed=2), board)
    facts = Facts.of(problem.dataset, moves=False, surfaces=1, camera=stated)
    effect = search(problem, stated, facts, effects=["scattering"], most=1).camera.effects["scattering"]
    assert isinstance(effect, Scattering)
    kernel, *others = effect.kernels
    assert kernel.weight == pytest.approx(0.03, rel=0.06)
    assert kernel.sigma == pytest.approx((5.0, 6.0), rel=0.12)
    assert sum(one.weight for one in others) < 0.001


def test_effects_that_would_gain_and_were_not_added_are_reported_with_the_reason() -> None:
    names = ["emitter_offset", "scattering", "warm_up_drift", "distance_scale"]
    step: Any = SimpleNamespace(
        best=lambda: {name: k for k, name in enumerate(names)},
        gains=np.array([400.0, 30.0, 5.0, 60.0]),
        thresholds=np.array([9.0, 8.0, 8.0, 8.0]),
    )
    failed = {"emitter_offset": NOT_IN_ALL_POSES, "scattering": ONCE_FITTED, "warm_up_drift": NOT_IN_TIME}
    # noise is not mentioned, nor what could still be added
    assert refused(step, failed) == [
        Refused("emitter_offset", 400.0, 9.0, NOT_IN_ALL_POSES),
        Refused("scattering", 30.0, 8.0, ONCE_FITTED),
    ]
    assert refused(step, {}) == []


def test_the_standard_error_of_a_gain_is_paired_over_folds_of_poses() -> None:
    """Differences 10, 30, 20, 0, 40: with a standard deviation of sqrt(250), summed over five folds."""
    before = [100.0, 900.0, -400.0, 0.0, 7.0]
    after = [110.0, 930.0, -380.0, 0.0, 47.0]
    assert paired_error(after, before) == pytest.approx(np.sqrt(5 * 250.0))
    assert paired_error(after, [one - 3.0 for one in after]) == pytest.approx(0.0)
    assert paired_error([5.0], [1.0]) == 0.0


def test_what_a_gain_must_exceed_where_poses_differ() -> None:
    """Folds that all gain speak for an effect, however much they differ; one that loses does not."""
    nothing = [0.0] * 5
    uneven = [4.0, 10.0, 6.0, 49.0, 10.0]
    assert 2 * paired_error(uneven, nothing) > sum(uneven)
    assert entry_gain(uneven, nothing, 16.0) == 16.0
    one_loses = [-4.0, *uneven[1:]]
    assert entry_gain(one_loses, nothing, 16.0) == pytest.approx(2 * paired_error(one_loses, nothing))
    # of four folds all gain by chance once in sixteen times
    assert entry_gain(uneven[:4], nothing[:4], 16.0) == pytest.approx(
        2 * np.sqrt(4 * np.var(uneven[:4], ddof=1))
    )
    assert entry_gain([1.0] * 5, nothing, 16.0) == 16.0
    assert entry_gain([5.0], [1.0], 9.0) == 9.0


def curves(gains: dict[str, float], named: list[float]) -> Any:
    """An exploration of a cyclic error found: what candidates and smooth functions would gain."""
    variants = [*(["named"] * len(named)), *gains]
    every = np.array([*named, *gains.values()])
    return SimpleNamespace(
        fit=SimpleNamespace(camera=SimpleNamespace(effects={"cyclic_error": CYCLIC})),
        candidates=[
            SimpleNamespace(variant=one, effect="named" if one == "named" else "unknown") for one in variants
        ],
        named=len(named),
        gains=every,
        thresholds=np.full(len(variants), 8.0),
        joint=lambda k: float(every[k]),
    )


@pytest.mark.parametrize(
    ("gains", "named", "expected"),
    [
        ({"incidence": 900.0, "distance": 60.0}, [50.0, 20.0], 3),  # incidence is none of its covariates
        ({"distance": 60.0}, [61.0], None),  # the simpler explanation
        ({"distance": 7.0}, [3.0], None),  # within chance
        ({"incidence": 900.0}, [50.0], None),
        ({"distance": 60.0}, [], 0),
    ],
)
def test_a_curve_enters_where_it_says_more_than_candidates(
    gains: dict[str, float], named: list[float], expected: int | None
) -> None:
    step = curves(gains, named)
    assert discrepancy(step, [Found("cyclic_error", 500.0)], set()) == expected
    assert discrepancy(step, [], set()) is None


def test_the_best_curve_is_that_of_an_own_covariate() -> None:
    step = curves({"incidence": 900.0, "distance": 60.0}, [50.0])
    assert curve_of_forms(step, [Found("cyclic_error", 500.0)]) == (60.0, 2)
    assert curve_of_forms(step, [Found("scattering", 500.0)]) is None


def test_other_effects_are_judged_at_the_same_noise(tmp_path: Path) -> None:
    """How well amplitudes are predicted is estimated anew only where parameters alone differ."""
    plain = camera(tmp_path)
    assert keeps_amplitude_error(plain, camera(tmp_path, CYCLIC, DistanceScale(0.01)))
    assert keeps_amplitude_error(plain, camera(tmp_path, CYCLIC, Scattering((Kernel(0.1, (9.0, 9.0)),))))
    assert not keeps_amplitude_error(plain, plain)
    one, other = camera(tmp_path, DistanceScale(0.01)), camera(tmp_path, DistanceScale(0.02))
    assert not keeps_amplitude_error(one, other)


def frames_of(light: np.ndarray, jitter: np.ndarray, common: np.ndarray, seed: int) -> list[RawFrame]:
    """Frames of one light, with noise of 3 counts, in proportion to ``jitter`` and with ``common`` light."""
    rng = np.random.default_rng(seed)
    result = []
    for k in range(len(jitter)):
        noise = rng.normal(0, 3.0, (2, *light.shape))
        image = light * jitter[k] + common[k] + noise[0] + 1j * noise[1]
        phase = np.mod(np.angle(image), 2 * np.pi) / (2 * np.pi)
        result.append(
            RawFrame(
                stamp=1 + k * 40_000_000,
                distance=np.round(phase * 65536).astype(np.uint16),
                amplitude=np.round(np.abs(image)).astype(np.uint16),
                settings=Settings(integration_time=16.0, modulation_frequency=20e6, uptime=60.0 + k),
                truth={"board": Pose((0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))},
            )
        )
    return result


def test_what_is_in_proportion_to_the_light_is_no_second_camera(tmp_path: Path) -> None:
    stated = camera(tmp_path)
    stated = replace(stated, noise=replace(stated.noise, floor=0.0, amplitude=3.0))
    rng = np.random.default_rng(8)
    light = rng.uniform(200, 2000, stated.shape) * np.exp(0.8j + 0.3j * rng.random(stated.shape))
    ones, dark = np.ones(12), np.zeros(12, complex)
    power = 1 + 0.02 * rng.normal(size=12) + 0.01j * rng.normal(size=12)
    second = 4.0 * np.exp(2j * np.pi * rng.random(12))

    def common(jitter: np.ndarray, added: np.ndarray) -> float:
        station = next(iter(reduce_frames(frames_of(light, jitter, added, 3), stated)))
        assert station.common is not None
        return float(station.common)

    assert common(ones, dark) < 2.5
    assert common(power, dark) < 2.5
    assert common(ones, second) > 100
    assert common(power, second) > 10  # the power's noise is larger than the second camera's light


def test_mixed_pixels_count_by_their_amplitudes_where_one_surface_keeps_the_distance(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, MixedPixels(blur=0.33)), scene(tmp_path)
    forward = Forward(record(truth, board, poses=6, frames=1, seed=5), board, truth)
    forward.margins = NEAR
    fitted: Any = SimpleNamespace(forward=forward)
    moved = np.concatenate(
        [np.abs(contribution(one, "mixed_pixels", truth)[one.used]) for one in forward.predictions()]
    )
    assert np.sqrt(np.mean(np.sort(moved)[-len(moved) // 20 :] ** 2)) < 0.0025
    assert effect_size(fitted, ["mixed_pixels"], truth) > 0.004


def trial(effects: list[str], by_fold: list[float], *, stated: float = 0.0) -> Trial:
    nothing: Any = None
    scores = SimpleNamespace(log_likelihoods=lambda: by_fold)
    fitted: Any = SimpleNamespace(scores=scores)
    return Trial(effects, nothing, fitted, sum(by_fold) + stated)


def test_effects_as_good_as_the_best_are_those_of_which_poses_do_not_agree() -> None:
    """Better by 15 of a standard error of sqrt(5 * 250) = 35, or by 100 everywhere."""
    best = trial(["incidence_angle"], [100.0, 100.0, 100.0, 100.0, 100.0])
    unsure = trial(["distance_scale"], [117.0, 77.0, 97.0, 107.0, 87.0])
    worse = trial(["lens_distortion"], [97.0, 57.0, 77.0, 87.0, 67.0])
    alone = {one.effects[0]: one for one in (best, unsure, worse)}
    assert as_good(alone, best) == ["distance_scale"]
    assert as_good(alone, trial(["incidence_angle", "cyclic_error"], [100.0] * 5)) == []
    # one that strains what the files state of errors that poses share is not as good
    strained = trial(["distance_scale"], [117.0, 77.0, 97.0, 107.0, 87.0], stated=-80.0)
    assert as_good({**alone, "distance_scale": strained}, best) == []


@pytest.mark.parametrize(("became", "close"), [(None, ["scattering"]), ((1,), [])])
def test_what_became_another_effect_is_no_rival_of_it(
    monkeypatch: pytest.MonkeyPatch, became: tuple[int, ...] | None, close: list[str]
) -> None:
    """Stray light that was fitted within its own pixel is two surfaces in a pixel, not as good as they."""
    names = ["scattering", "mixed_pixels"]
    step: Any = SimpleNamespace(scores=SimpleNamespace(log_likelihood=lambda: 0.0))
    nothing: Any = None
    by_fold = [[10.0, 40.0, 20.0, 25.0], [25.0, 25.0, 25.0, 25.0]]
    monkeypatch.setattr(best_trial, "near_rivals", lambda *_: [(1,)])
    monkeypatch.setattr(
        best_trial, "what_it_became", lambda _, choice, *__: became if choice == (0,) else None
    )
    monkeypatch.setattr(
        Trials,
        "fitted",
        lambda _, choices, **__: {one: trial([names[one[0]]], by_fold[one[0]]) for one in choices},
    )
    monkeypatch.setattr(best_trial, "subsample_of", lambda *_, **__: None)
    best, others = Trials(nothing, nothing, step, {}).best((0,), 0)
    assert (best.effects, others) == (["mixed_pixels"], close)


@pytest.mark.parametrize(("scale", "kept"), [(0.0, False), (0.01, True)])
def test_an_effect_that_later_ones_make_needless_is_dropped(tmp_path: Path, scale: float, kept: bool) -> None:
    """Found first in place of the cyclic error; it stays only where distances are scaled indeed."""
    truth, board = camera(tmp_path, CYCLIC, DistanceScale(scale)), scene(tmp_path)
    data = record(truth, board, seed=6)
    facts = Facts.of(data, moves=False, surfaces=1, camera=truth)
    problem, folds = Problem(data, board), folds_of(data)
    pool = candidates(camera(tmp_path), facts, effects=["distance_scale", "cyclic_error"])
    first = explore(problem, camera(tmp_path), pool, folds, replicates=0)
    last = explore(problem, camera(tmp_path, CYCLIC, DistanceScale(0.001)), [], folds, replicates=0)
    found = [Found("distance_scale", 900.0, step=0), Found("cyclic_error", 400.0, step=1)]
    state = Search(problem, camera(tmp_path), [first, first, last], folds, found=found)
    state.drop_needless()
    names = ["distance_scale", "cyclic_error"] if kept else ["cyclic_error"]
    assert [one.effect for one in found] == names
    assert set(state.step.fit.camera.effects) == set(names)
    assert len(state.explorations) == 3


def test_all_effects_that_a_later_one_makes_needless_are_dropped(tmp_path: Path) -> None:
    """Where the first leaves, the next is judged anew as the first, and leaves as well."""
    truth, board = camera(tmp_path, CYCLIC), scene(tmp_path)
    data = record(truth, board, seed=6)
    facts = Facts.of(data, moves=False, surfaces=1, camera=truth)
    problem, folds = Problem(data, board), folds_of(data)
    names = ["distance_scale", "mixed_pixels", "cyclic_error"]
    pool = candidates(camera(tmp_path), facts, effects=names)
    first = explore(problem, camera(tmp_path), pool, folds, replicates=0)
    last = explore(
        problem, camera(tmp_path, CYCLIC, MixedPixels(0.05), DistanceScale(0.0002)), [], folds, replicates=0
    )
    found = [
        Found(name, gain, step=k)
        for k, (name, gain) in enumerate(zip(names, (900.0, 500.0, 400.0), strict=True))
    ]
    state = Search(problem, camera(tmp_path), [first, first, first, last], folds, found=found)
    state.drop_needless()
    assert [one.effect for one in state.found] == ["cyclic_error"]
    assert set(state.step.fit.camera.effects) == {"cyclic_error"}


def test_a_member_of_a_pair_that_moves_nothing_does_not_join(tmp_path: Path) -> None:
    """On one grey surface two surfaces in a pixel are none, whatever the pair gains."""
    truth, board = camera(tmp_path, CYCLIC), scene(tmp_path)
    board = Scene((replace(board.surfaces[0], texture=None, reflectivity=0.6),))
    data = record(truth, board, poses=12, seed=3)
    facts = Facts.of(data, moves=False, surfaces=1, camera=truth)
    problem, folds = Problem(data, board), folds_of(data)
    pool = candidates(camera(tmp_path), facts, effects=["cyclic_error", "mixed_pixels"])
    first = explore(problem, camera(tmp_path), pool, folds, replicates=0)
    state = Search(problem, camera(tmp_path), [first], folds)
    best = first.best()
    trial, _ = state._trials().best((best["cyclic_error"], best["mixed_pixels"]), best["mixed_pixels"])
    assert trial.effects == ["cyclic_error"]


def test_unmodulated_light_of_a_moving_camera_is_a_share_of_the_modulated(tmp_path: Path) -> None:
    """A (A) + b (A + B) = interval (A + share B): 1.5 + 2.5 ms of which 2.5 with the unmodulated light."""
    model = camera(tmp_path)
    facts = Facts((60.0,), 1000.0, None, None, saturated=False, moves=True, surfaces=1)
    plain, more = candidates(model, facts, effects=["motion"])
    labels = [one.label for one in more.block.regressors]
    found = more.build(model, dict(zip(labels, (0.0015, 0.0025), strict=True))).effects["motion"]
    assert found == Motion(sample_interval=pytest.approx(0.004), unmodulated=pytest.approx(0.625))
    backwards = more.build(model, dict(zip(labels, (-0.003, 0.001), strict=True))).effects["motion"]
    assert backwards.sample_interval == 1e-4  # type: ignore[attr-defined]
    assert more.positive == (labels[1],)
    assert plain.build(model, {plain.block.regressors[0].label: 0.002}).effects["motion"] == Motion(0.002)


@pytest.mark.parametrize("follows", [True, False])
def test_a_drift_in_addition_to_other_effects_must_follow_time(
    monkeypatch: pytest.MonkeyPatch, follows: bool
) -> None:
    monkeypatch.setattr("rim_camera_ros.select.forward_search.effect_size", lambda *_: 0.01)
    monkeypatch.setattr(Search, "_follows_time", lambda self, trial, name: follows)
    nothing: Any = None
    state = Search(nothing, nothing, [nothing], {}, found=[Found("cyclic_error", 900.0)])

    def why_not(*effects: str) -> str | None:
        model = SimpleNamespace(effects={})
        trial: Any = SimpleNamespace(
            effects=effects, fitted=SimpleNamespace(fit=SimpleNamespace(camera=model))
        )
        return state._why_not(trial, 100.0, 20.0, 30.0)

    refusal = None if follows else NOT_IN_TIME
    assert why_not("warm_up_drift") == why_not("scattering", "ambient_temperature") == refusal
    assert why_not("scattering") is None
    assert why_not("integration_time_offset") is None
    state.found.clear()
    assert why_not("warm_up_drift") is None


@pytest.mark.parametrize(
    ("found", "sigma", "refusal"),
    [
        ("mixed_pixels", 0.9, SAME_PHYSICS),
        ("mixed_pixels", 3.0, None),
        ("cyclic_error", 0.9, None),
    ],
)
def test_a_halo_within_the_neighbours_is_the_form_of_the_mixed_pixels_that_were_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, found: str, sigma: float, refusal: str | None
) -> None:
    """Alone it becomes mixed pixels; given them there is nothing that it could become."""
    monkeypatch.setattr("rim_camera_ros.select.forward_search.effect_size", lambda *_: 0.01)
    nothing: Any = None
    state = Search(nothing, nothing, [nothing], {}, found=[Found(found, 900.0)])
    fitted = camera(tmp_path, Scattering((Kernel(0.7, (sigma, sigma)),)))
    trial: Any = SimpleNamespace(
        effects=["scattering"], fitted=SimpleNamespace(fit=SimpleNamespace(camera=fitted))
    )
    assert state._why_not(trial, 100.0, 20.0, 30.0) == refusal


def test_rays_that_make_what_was_found_impossible_are_no_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An emission that ends just beside a narrow image is none of a wide one: the fit begins without it."""
    wide = camera(tmp_path)
    narrow = replace(wide, optics=replace(wide.optics, fx=1.5 * wide.optics.fx, fy=1.5 * wide.optics.fy))
    edge = float(squared_angle(narrow).max())
    pattern = EmissionPattern(falloff=(-0.9 / edge, 0.0))
    fitted = with_effects(narrow, {pattern.name: pattern, CYCLIC.name: CYCLIC})
    with pytest.raises(InputError, match="falloff must leave the relative power positive"):
        with_effects(wide, fitted.effects)
    begun: list[Any] = []
    monkeypatch.setattr(Search, "_fitted", lambda self, problem, start, *_: begun.append(start))
    step: Any = SimpleNamespace(
        fit=SimpleNamespace(camera=with_effects(wide, {CYCLIC.name: CYCLIC})),
        best_of=lambda names: [0],
        joint=lambda *_: 10.0,
    )
    model = SimpleNamespace(tau=0.01)
    after: Any = SimpleNamespace(
        fit=SimpleNamespace(camera=fitted, forward=SimpleNamespace(amplitude_model=model))
    )
    nothing: Any = None
    state = Search(Problem(nothing, nothing), wide, [step], {}, found=[Found("emission_pattern", 900.0)])
    assert state._without(["camera_constant"], after, 19.0) is None
    state._without(["camera_constant"], after, 21.0)
    assert [list(one.effects) for one in begun] == [["cyclic_error"]]
    assert begun[0].optics == wide.optics
    # nor is there a camera of the file's rays to compare with
    problem = Problem(nothing, nothing, geometry=("camera_constant",))
    assert without_effect("camera_constant", problem, fitted, wide) is None
    kept = without_effect("camera_constant", problem, with_effects(narrow, {CYCLIC.name: CYCLIC}), wide)
    assert kept is not None
    assert (kept[0].geometry, kept[1].optics.fx) == ((), pytest.approx(wide.optics.fx))


@pytest.mark.parametrize(("strength", "begins"), [(-0.9, -0.9), (-1.7, -0.85), (-2.3, -0.575)])
def test_a_linear_guess_that_no_camera_can_have_is_begun_at_less_of_it(
    tmp_path: Path, strength: float, begins: float
) -> None:
    device = camera(tmp_path)
    edge = float(squared_angle(device).max())
    (lobe,) = EmissionPattern.candidates(device, None)  # type: ignore[arg-type]
    labels = [one.label for one in lobe.block.regressors]
    guess = dict(zip(labels, (strength / edge, 0.0), strict=True))
    step: Any = SimpleNamespace(
        fit=SimpleNamespace(camera=device),
        candidates=[lobe],
        spans=[[0, 1]],
        scores=SimpleNamespace(values=lambda numbers: guess),
    )
    begun = Exploration.camera_with(step, [0]).effects["emission_pattern"]
    # power at the corner: 1 + strength, which must stay positive
    assert isinstance(begun, EmissionPattern)
    assert begun.falloff[0] * edge == pytest.approx(begins)


def test_pixels_that_edges_have_reached_do_not_hold_the_rays(tmp_path: Path) -> None:
    """What is beside an edge by the true lens reads as by the file's: it says nothing of the lens."""
    stated, board = camera(tmp_path), scene(tmp_path)
    truth = replace(stated, optics=replace(stated.optics, d=(0.25, 0.0, 0.0, 0.0, 0.0)))
    data = record(truth, board, poses=24, seed=2)
    by_file, by_lens = Forward(data, board, stated), Forward(data, board, truth)
    for forward in (by_file, by_lens):
        forward.estimate_amplitudes()
    rng, stations, spoiled = np.random.default_rng(8), [], 0
    pairs = zip(by_file.predictions(slopes=False), by_lens.predictions(slopes=False), strict=True)
    for own, true in pairs:
        beside = own.used & ~true.view.clean
        spoiled += int(beside.sum())
        reading = own.distance + own.sigma * rng.standard_normal(beside.shape)
        station = own.station
        stations.append(
            replace(
                station,
                distance=np.where(beside, reading, station.distance),
                amplitude=np.where(beside, own.model_reading, station.amplitude),
            )
        )
    assert spoiled > 1000
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    problem = Problem(replace(data, stations=stations), board)
    result = search(problem, stated, facts, effects=["lens_distortion"])
    assert [one.effect for one in result.found] == ["lens_distortion"]
    # with all pixels that were clean by the file it was 0.19, seven standard errors off
    assert abs(result.camera.optics.d[0] - 0.25) < 3 * result.fit.sigma["optics.d.0"]
