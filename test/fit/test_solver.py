"""The joint adjustment: derivatives, parameters within their sigma, nulls, held-out chi-square."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects, with_numbers
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.linearised import Linearised
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.evidence import Scores, folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.null_replicates import IMPERFECTIONS, null_scores
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene


def known() -> list[Effect]:
    return [
        EmissionPattern((-1.3, 0.7)),
        CyclicError((Harmonic(4, 0.011, 0.7),), (0.004, -0.002)),
        AmplitudeOffset(
            MappingProxyType(
                {16.0: Hyperbola(9.0, 0.4), 60.0: Hyperbola(25.0, 1.5), 100.0: Hyperbola(40.0, 0.6)}
            )
        ),
        IntegrationTimeOffset(MappingProxyType({16.0: -0.03, 60.0: -0.004, 100.0: 0.003})),
    ]


def test_derivatives_are_those_of_the_prediction(tmp_path: Path) -> None:
    """Scattering passes on to the terms, the emission pattern to scattering: all as finite differences
    say.
    """
    own = camera(tmp_path, *known(), Scattering((Kernel(0.02, (5.0, 7.0)),)))
    board = scene(tmp_path)
    data = record(own, board, poses=1, frames=1)
    for name, effect in own.effects.items():
        for path in effect.priors():
            full = f"effects.{name}.{path}"
            value = camera_numbers(own)[full]
            step = 1e-4 * max(abs(value), 0.1)
            sides = []
            for sign in (1, -1):
                moved = with_numbers(own, {full: value + sign * step})
                sides.append(next(Forward(data, board, moved).predictions(AmplitudeModel())))
            middle = next(Forward(data, board, own).predictions(AmplitudeModel()))
            column, light = middle.columns(own.effects[name])[path]
            numeric = (sides[0].distance - sides[1].distance) / (2 * step)
            pixels = middle.used
            scale = np.abs(numeric[pixels]).max() + 1e-9
            assert np.allclose(column[pixels], numeric[pixels], atol=2e-3 * scale, rtol=0), full
            by_light = -(sides[0].amplitude_residual - sides[1].amplitude_residual) / (2 * step)
            scale = np.abs(by_light[pixels]).max() + 1e-6
            assert np.allclose(light[pixels], by_light[pixels], atol=3e-3 * scale, rtol=0), full


@pytest.mark.parametrize("direction", ["offset", "tilt_x", "tilt_y"])
def test_errors_of_a_pose_are_those_of_the_geometry(tmp_path: Path, direction: str) -> None:
    own, board = camera(tmp_path), scene(tmp_path)
    data = record(own, board, poses=1, frames=1, wrong=0.0)
    before = next(Forward(data, board, own).predictions(AmplitudeModel()))
    column = next(one for one in before.pose_columns if one.path == f"pose.board.{direction}")
    pose = data.stations[0].truth["board"]
    from rim_camera_ros.rotations import quaternion, rotation_matrix

    rotation = rotation_matrix(pose.orientation)
    size = 1e-5
    if direction == "offset":
        position = np.array(pose.position) + size * rotation[:, 2]
        moved = Pose((position[0], position[1], position[2]), pose.orientation)
    else:
        half = (size / 2, 0.0, 0.0, 1.0) if direction == "tilt_x" else (0.0, size / 2, 0.0, 1.0)
        moved = Pose(pose.position, quaternion(rotation @ rotation_matrix(half)))
    station = replace(data.stations[0], truth={"board": moved})
    after = next(Forward(replace(data, stations=[station]), board, own).predictions(AmplitudeModel()))
    same = before.used & after.used
    by_distance = (after.distance - before.distance)[same] / size
    assert np.allclose(column.distance[same], by_distance, rtol=1e-3, atol=1e-4)
    by_light = np.log(after.model_amplitude / before.model_amplitude)[same] / size
    assert np.allclose(column.amplitude[same], by_light, rtol=1e-3, atol=1e-3)


def test_hidden_parameters_come_back_within_their_sigma(tmp_path: Path) -> None:
    truth = camera(tmp_path, *known())
    board = scene(tmp_path)
    data = record(truth, board, poses=24, seed=3)
    start = with_numbers(
        truth,
        {
            "effects.cyclic_error.harmonics.0.amplitude": 0.006,
            "effects.cyclic_error.harmonics.0.phase": 1.3,
            "effects.amplitude_offset.hyperbola.60.a": 15.0,
            "effects.emission_pattern.falloff.0": -1.0,
            "radiometry.gain": 100.0,
        },
    )
    result = fit(Problem(data, board), start, fold_of=folds_of(data))
    assert result.converged
    numbers = camera_numbers(truth)
    # ripples of the light are no numbers of a camera file: they must come out as none
    errors = {
        path: (value - numbers.get(path, 0.0)) / result.sigma[path]
        for path, value in result.parameters.items()
    }
    assert max(abs(e) for e in errors.values()) < 4.0, errors
    assert np.sqrt(np.mean(np.square(list(errors.values())))) == pytest.approx(1.0, abs=0.5)
    chi_square, rows = Scores(result.equations, range(len(result.parameters))).chi_square(held_out=True)
    # simulated amplitudes are better than the percent to which any amplitude is predicted
    assert 0.85 < chi_square / rows < 1.02


def test_an_inexact_model_is_fitted_to_a_share_of_what_its_residuals_leave_uncertain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Residuals beyond the stated noise, with outliers: fewer steps than for noise alone."""
    truth = camera(tmp_path, *known())
    board = scene(tmp_path)
    data = record(truth, board, poses=24, seed=3)
    rng = np.random.default_rng(12)
    stations = []
    for one in data.stations:
        noise = np.sqrt(one.distance_variance / np.maximum(one.count, 1))
        stations.append(replace(one, distance=one.distance + 2.0 * noise * rng.standard_t(3, noise.shape)))
    problem = Problem(replace(data, stations=stations), board)
    start = with_numbers(truth, {"effects.cyclic_error.harmonics.0.amplitude": 0.006})
    found = fit(problem, start, iterations=12)
    monkeypatch.setattr(Linearised, "unit_variance", 1.0)
    exact = fit(problem, start, iterations=40)
    assert found.converged
    assert found.iterations < exact.iterations
    scale = np.sqrt(found.chi_square / found.rows)
    assert scale > 1.5
    for path, value in found.parameters.items():
        if path in exact.sigma:
            assert value == pytest.approx(exact.parameters[path], abs=0.1 * scale * exact.sigma[path]), path


def test_nothing_is_found_where_nothing_is_missing(tmp_path: Path) -> None:
    """Nulls first: pose errors, powers and noise are no physics."""
    truth = camera(tmp_path, *known())
    board = scene(tmp_path)
    for seed in (5, 6):
        data = record(truth, board, seed=seed)
        facts = Facts.of(data, moves=False, surfaces=1, camera=truth)
        result = search(Problem(data, board), truth, facts)
        assert result.found == []


@pytest.mark.long
@pytest.mark.parametrize(
    "hidden",
    [
        Scattering((Kernel(0.03, (6.0, 6.0)),)),
        IncidenceAngle(MappingProxyType(dict.fromkeys((16.0, 60.0, 100.0), (0.0, 0.0, 0.0, 0.0003)))),
    ],
    ids=lambda one: one.name,
)
def test_what_is_missing_is_found(tmp_path: Path, hidden: Effect) -> None:
    stated = camera(tmp_path, *known())
    truth = with_effects(stated, {**stated.effects, hidden.name: hidden})
    board = scene(tmp_path)
    data = record(truth, board, seed=8)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    result = search(Problem(data, board), stated, facts)
    assert [one.effect for one in result.found] == [hidden.name]
    assert result.log_likelihood > result.start_log_likelihood + 100


def test_replicates_have_the_covariance_that_they_claim(tmp_path: Path) -> None:
    """Right-hand sides of nulls: variance = Gram matrix, by which gains are judged."""
    truth: Camera = camera(tmp_path, *known())
    board = scene(tmp_path)
    data = record(truth, board, poses=12)
    facts = Facts.of(data, moves=False, surfaces=1, camera=truth)
    step = explore(Problem(data, board), truth, candidates(truth, facts), folds_of(data), replicates=0)
    nulls = null_scores(step.scores, replicates=400, seed=2)
    gram = nulls.full.gram
    # ... and what all poses share, apart from the noise: errors of reflectivities, poses, optics, a weak lobe
    common = [i for i, one in enumerate(nulls.regressors) if one.label.startswith(IMPERFECTIONS)]
    assert len(common) > 10
    claimed = np.diag(gram) + np.sum((gram[:, common] * nulls.prior[common]) ** 2, axis=1)
    # replicates draw no fixed pattern: what is the same in every frame but for a hundredth is not compared
    raw = sum(np.diag(fold.gram)[: len(claimed)] for fold in step.fit.equations.folds)
    assert raw.shape == claimed.shape
    usable = (claimed > 0.01 * raw) & (claimed * nulls.prior**2 > 1)
    assert usable.sum() > 30
    spread = nulls.full.right.std(axis=1)[usable] / np.sqrt(claimed[usable])
    assert spread == pytest.approx(np.ones(usable.sum()), abs=0.2)


def test_folds_hold_every_setting(tmp_path: Path) -> None:
    data = record(camera(tmp_path), scene(tmp_path), poses=15, frames=1)
    folds = folds_of(data)
    for setting in (16.0, 60.0, 100.0):
        own = {folds[(0, s.pose)] for s in data.stations if s.settings.integration_time == setting}
        assert own == set(range(5))


def test_a_recording_without_common_pixels_is_refused(tmp_path: Path) -> None:
    own, board = camera(tmp_path), scene(tmp_path)
    data = record(own, board, poses=3, frames=1)
    behind = {"board": Pose((0.0, 0.0, -2.0))}
    lost = replace(data, stations=[replace(one, truth=behind) for one in data.stations])
    with pytest.raises(InputError, match="no pixel can be used"):
        fit(Problem(lost, board), own)
