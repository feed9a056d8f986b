"""Further effects given what a slightly wrong form of the first one leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.candidate import Block, Candidate, Facts, Regressor
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.scene import Scene
from rim_camera_ros.select import confounding
from rim_camera_ros.select.candidates import SHARE, candidates, form_blocks
from rim_camera_ros.select.confounding import shows_in_quiet_pixels
from rim_camera_ros.select.effect_sizes import change_by
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, explore, explored, further_equations

from ..calibrate.helpers import camera, record, scene

STRAY = Scattering((Kernel(0.06, (7.0, 9.0)),))
STEEP = IncidenceAngle(MappingProxyType(dict.fromkeys((16.0, 60.0, 100.0), (1e-8, 0.0, 0.0, 0.0))))


def moved(
    data: Dataset, model: Camera, board: Scene, by: Callable[[Prediction], NDArray[np.float64]]
) -> Dataset:
    """The recording with distances that are longer by some function of its predictions."""
    forward = Forward(data, board, model)
    forward.estimate_amplitudes()
    stations = [
        replace(one.station, distance=one.station.distance + np.nan_to_num(by(one)))
        for one in forward.predictions()
    ]
    return replace(data, stations=stations)


def across(one: Prediction) -> NDArray[np.float64]:
    return np.broadcast_to(np.linspace(-1.0, 1.0, one.distance.shape[1])[None, :], one.distance.shape)


def imitator() -> Candidate:
    """An effect that does not exist: what stray light does, growing from left to right."""

    def columns(one: Prediction) -> list[tuple[NDArray[np.float64], NDArray[np.float64] | None]]:
        return [(np.nan_to_num(change_by(one, "scattering")[0]) * across(one), None)]

    block = Block((Regressor("imitator", "imitator", 1.0),), columns)
    return Candidate("imitator", "", block, lambda model, values: model)


def test_changes_of_a_form_are_shares_of_what_the_effect_does(tmp_path: Path) -> None:
    model, board = camera(tmp_path, STRAY), scene(tmp_path)
    data = record(model, board, poses=6, seed=2)
    step = explore(Problem(data, board), model, [], folds_of(data), replicates=0)
    (block,) = form_blocks(step.fit, ["scattering"], [])

    def size(pairs: list[tuple[NDArray[np.float64], NDArray[np.float64] | None]]) -> float:
        total = 0.0
        for one, (distance, amplitude) in zip(step.fit.forward.predictions(), pairs, strict=True):
            total += float(np.sum((distance[one.used] / one.sigma[one.used]) ** 2))
            if amplitude is not None:
                lit = one.amplitude_used
                total += float(np.sum((amplitude[lit] / one.amplitude_sigma[lit]) ** 2))
        return float(np.sqrt(total))

    predictions = list(step.fit.forward.predictions())
    whole = size([change_by(one, "scattering") for one in predictions])
    found = [block.columns(one) for one in predictions]
    shares = [
        regressor.prior * size([columns[i] for columns in found]) / whole
        for i, regressor in enumerate(block.regressors)
    ]
    assert len(shares) > 20
    assert shares == pytest.approx([SHARE] * len(shares), rel=1e-6)


def test_a_power_of_the_amplitude_is_a_form_of_a_hyperbola(tmp_path: Path) -> None:
    """Changes of form take up what another law of the amplitude leaves; what has no other law has none."""
    rows = MappingProxyType(dict.fromkeys((16.0, 60.0, 100.0), Hyperbola(3.0, 1.0)))
    model = camera(tmp_path, AmplitudeOffset(hyperbola=rows), STEEP, DistanceScale(0.001))
    board = scene(tmp_path)
    data = record(model, board, poses=4, seed=2)
    step = explore(Problem(data, board), model, [], folds_of(data), replicates=0)
    assert form_blocks(step.fit, ["distance_scale", "radiometry", "lens_distortion"], []) == []
    blocks = form_blocks(step.fit, ["amplitude_offset", "incidence_angle"], [])
    assert len(blocks) == 2
    one = next(iter(step.fit.forward.predictions()))
    lit = one.used
    power = (0.02 * (100.0 / np.maximum(one.amplitude, 5.0)) ** 0.9)[lit]
    own = change_by(one, "amplitude_offset")[0][lit]
    design = np.stack([own, *(d[lit] for d, _ in blocks[0].columns(one))], axis=1)
    rest = [power - x @ np.linalg.lstsq(x, power, rcond=None)[0] for x in (design[:, :1], design)]
    assert np.std(rest[1]) < 0.1 * np.std(rest[0])


def test_a_beam_may_point_elsewhere(tmp_path: Path) -> None:
    """A tilted beam brightens one side: a change of the form, though round patterns have none like it."""
    model, board = camera(tmp_path, EmissionPattern(falloff=(1.1, 0.3))), scene(tmp_path)
    data = record(model, board, poses=6, seed=2)
    step = explore(Problem(data, board), model, [], folds_of(data), replicates=0)
    (block,) = form_blocks(step.fit, ["emission_pattern"], [])
    one = next(iter(step.fit.forward.predictions()))
    lit = one.amplitude_used
    tilted = (one.station.amplitude * across(one))[lit]
    design = np.stack([a[lit] for _, a in block.columns(one) if a is not None], axis=1)
    rest = tilted - design @ np.linalg.lstsq(design, tilted, rcond=None)[0]
    assert np.std(rest) < 0.05 * np.std(tilted)


def test_signal_lines_may_delay_a_cyclic_error_otherwise_than_in_proportion(tmp_path: Path) -> None:
    """Its phase bends along the rows, and it grows along the columns: both are changes of its form."""
    flat = CyclicError((Harmonic(4, 0.02, 0.7),), (0.003, 0.0))
    model, board = camera(tmp_path, flat), scene(tmp_path)
    data = record(model, board, poses=6, seed=2)
    step = explore(Problem(data, board), model, [], folds_of(data), replicates=0)
    (block,) = form_blocks(step.fit, ["cyclic_error"], [])
    one = next(iter(step.fit.forward.predictions()))
    effect = step.fit.camera.effects["cyclic_error"]
    assert isinstance(effect, CyclicError)
    (wave,) = effect.harmonics
    far = 4 * 2 * np.pi / one.context.ambiguity * np.nan_to_num(one.delivered.distance)
    angle = far + wave.phase + effect.phase_shift(one.context)
    truth = wave.amplitude * (1 + 0.1 * across(one)) * np.sin(angle + 0.2 * across(one) ** 2)
    rest = (truth - wave.amplitude * np.sin(angle))[one.used]
    design = np.stack([d[one.used] for d, _ in block.columns(one)], axis=1)
    left = rest - design @ np.linalg.lstsq(design, rest, rcond=None)[0]
    assert np.std(left) < 0.15 * np.std(rest)


def test_what_a_wrong_form_leaves_is_no_further_effect(tmp_path: Path) -> None:
    model, board = camera(tmp_path, STRAY), scene(tmp_path)
    truth = camera(tmp_path, STRAY, CyclicError((Harmonic(4, 0.0016, 0.7),), (0.0, 0.0)))
    data = moved(
        record(truth, board, seed=4),
        model,
        board,
        lambda one: 0.35 * np.nan_to_num(change_by(one, "scattering")[0]) * across(one),
    )
    problem, folds = Problem(data, board), folds_of(data)
    facts = Facts.of(data, moves=False, surfaces=1, camera=model)
    named = [
        imitator(),
        *(one for one in candidates(model, facts, effects=["cyclic_error"]) if one.variant == "4"),
    ]
    fitted = explore(problem, model, [], folds, replicates=0).fit
    forms = form_blocks(fitted, ["scattering"], [])
    blocks = [*(one.block for one in named), *forms]
    equations = further_equations(fitted, blocks, folds, problem)
    alone = explored(further_equations(fitted, blocks[:2], folds, problem), named, replicates=0)
    given_forms = explored(equations, named, forms=forms, replicates=0)
    assert alone.gains[0] > 50
    assert given_forms.gains[0] < 0.1 * alone.gains[0]
    assert alone.gains[1] > 50
    assert given_forms.gains[1] > 0.7 * alone.gains[1]


def steep_step(
    tmp_path: Path, by: Callable[[Prediction], NDArray[np.float64]]
) -> tuple[Problem, Exploration]:
    """An exploration of the scale of distances after the angle of incidence was found."""
    model, board = camera(tmp_path, STEEP), scene(tmp_path)
    data = moved(record(model, board, seed=7), model, board, by)
    problem = Problem(data, board)
    facts = Facts.of(data, moves=False, surfaces=1, camera=model)
    scale = candidates(model, facts, effects=["distance_scale"])
    return problem, explore(problem, model, scale, folds_of(data), replicates=0)


@pytest.mark.parametrize(("everywhere", "shown"), [(True, True), (False, False)])
def test_a_further_effect_shows_where_the_first_one_does_not_act(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, everywhere: bool, shown: bool
) -> None:
    def longer(one: Prediction) -> NDArray[np.float64]:
        return np.where((across(one) < 0) | everywhere, 0.008 * one.distance, 0.0)

    problem, step = steep_step(tmp_path, longer)
    assert step.candidates[0].effect == "distance_scale"
    assert step.gains[0] > 50
    monkeypatch.setattr(
        confounding, "change_by", lambda one, name: (np.where(across(one) < 0, 0.5, 0.0), None)
    )
    assert shows_in_quiet_pixels(problem, step, 0, ["incidence_angle"], folds_of(problem.dataset)) is shown


def test_where_nothing_is_left_to_ask_the_first_look_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, step = steep_step(tmp_path, lambda one: np.zeros_like(one.distance))
    folds = folds_of(problem.dataset)
    assert shows_in_quiet_pixels(problem, step, 0, ["lens_distortion"], folds)
    monkeypatch.setattr(confounding, "_LEAST_LEFT", 1.01)
    assert shows_in_quiet_pixels(problem, step, 0, ["incidence_angle"], folds)


def test_the_change_by_an_effect_is_what_it_does(tmp_path: Path) -> None:
    """The change by a term is the term; by stray light, that of the prediction without it."""
    board = scene(tmp_path)
    data = record(camera(tmp_path, STRAY, DistanceScale(0.013)), board, poses=3, seed=1)
    forwards = [
        Forward(data, board, camera(tmp_path, *effects))
        for effects in ((STRAY, DistanceScale(0.013)), (DistanceScale(0.013),))
    ]
    for forward in forwards:
        forward.amplitude_model = forwards[0].amplitude_model
    for one, without in zip(*(forward.predictions() for forward in forwards), strict=True):
        hit = one.used
        scaled, nothing = change_by(one, "distance_scale")
        assert nothing is None
        assert scaled[hit] == pytest.approx(0.013 * one.delivered.distance[hit], rel=1e-9)
        spread, light = change_by(one, "scattering")
        assert light is not None
        assert spread[hit] == pytest.approx((one.distance - without.distance)[hit], abs=4e-4)
        assert np.std(spread[hit]) > 2e-3
