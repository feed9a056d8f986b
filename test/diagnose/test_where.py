"""Where the mismatch is: the map of what a named effect does, in units of the noise of one frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.diagnose.formula import closed_form, formula_curve
from rim_camera_ros.diagnose.where import (
    _shares,
    _times,
    mean_of_halves,
    of_repeated_frames,
    of_residuals,
    of_terms,
)
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Block, Regressor
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.light_curves import RESPONSE, LightCurves
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.noise import Noise
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.candidates import change_of_forms, form_blocks
from rim_camera_ros.select.effect_sizes import change_by
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explored, further_equations

from ..blind.score import intersection_over_union, region
from ..calibrate.helpers import camera, record, scene

STRAY = Scattering((Kernel(0.06, (7.0, 9.0)),))
AMBIGUITY = 299_792_458.0 / 40e6


def sigma(stated: Camera, amplitude: np.ndarray) -> np.ndarray:
    """The test camera's noise [m]: 3 mm and 6 m counts / A."""
    assert (stated.noise.floor, stated.noise.shot, stated.noise.amplitude) == (0.003, 0.0, 6.0)
    lsb = AMBIGUITY / 65536
    return np.sqrt(0.003**2 + (6.0 / amplitude) ** 2 + lsb**2 / 12)


def forward_of(tmp_path: Path, effect: Effect) -> tuple[Forward, Any]:
    truth, board = camera(tmp_path, effect), scene(tmp_path)
    forward = Forward(record(truth, board, poses=5, frames=2, seed=2, wrong=0.0), board, truth)
    # amplitudes that are badly predicted make no frame noisier
    forward.amplitude_model = AmplitudeModel({}, 0.05)
    return forward, SimpleNamespace(forward=forward, camera=truth, scene=board)


def expected(forward: Forward, moved: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean square over the poses in which a pixel is valid, and whether it ever is."""
    total, count = np.zeros(forward.camera.shape), np.zeros(forward.camera.shape)
    for one in forward.predictions():
        valid = (one.station.count > 0) & one.view.geometry.hit & np.isfinite(one.sigma)
        total[valid] += (moved(one) / sigma(forward.camera, one.amplitude))[valid] ** 2
        count[valid] += 1
    return np.divide(total, count, out=total, where=count > 0), count > 0


def located(data: Dataset, board: Scene, stated: Camera, name: str) -> tuple[Fit, np.ndarray, np.ndarray]:
    """A fit, and where an effect is by its form alone and with the changes of its form."""
    problem, folds = Problem(data, board), folds_of(data)
    fitted = fit(problem, stated, fold_of=folds)
    forms = form_blocks(fitted, [name], [])
    step = explored(further_equations(fitted, forms, folds, problem), [], forms=forms, replicates=0)
    rest = change_of_forms(fitted.camera, [name], step.forms, step.conditional.values())
    plain, with_rest = (of_terms(fitted, [name], stated, rest=one).pixels for one in (None, rest))
    return fitted, plain, with_rest


def test_a_distance_term_counts_by_the_distance(tmp_path: Path) -> None:
    forward, fitted = forward_of(tmp_path, DistanceScale(0.004))
    found = of_terms(fitted, ["distance_scale"], forward.camera)
    wanted, seen = expected(forward, lambda one: 0.004 * one.delivered.distance)
    assert seen.mean() > 0.9
    assert found.pixels[seen] == pytest.approx(wanted[seen], rel=1e-5)
    assert found.covariates[0][0] == "distance"
    assert found.covariates[0][1] > 0.95


def test_a_compressed_amplitude_counts_by_what_it_and_its_response_take(tmp_path: Path) -> None:
    """Noise is circular in the complex plane: sigma_A = (2 pi / L) A sigma."""
    forward, fitted = forward_of(tmp_path, AmplitudeNonlinearity(4e-5))
    forward.light_curves = LightCurves(dict.fromkeys(RESPONSE, -0.03), 1000.0)

    def moved(one: Any) -> np.ndarray:
        light = one.model_amplitude
        published = light / (1 + 4e-5 * light) * forward.light_curves.response(light)
        return np.asarray((light - published) * AMBIGUITY / (2 * np.pi * light))

    found = of_terms(fitted, ["amplitude_nonlinearity"], forward.camera)
    wanted, seen = expected(forward, moved)
    assert found.pixels[seen] == pytest.approx(wanted[seen], rel=1e-4)
    assert np.sqrt(found.pixels.max()) > 5
    # with a term of the distance it counts as before
    both = with_effects(forward.camera, {**forward.camera.effects, "distance_scale": DistanceScale(1e-9)})
    combined = Forward(forward.dataset, scene(tmp_path), both)
    combined.amplitude_model, combined.light_curves = forward.amplitude_model, forward.light_curves
    fitted = SimpleNamespace(forward=combined, camera=both, scene=scene(tmp_path))
    again = of_terms(fitted, ["distance_scale", "amplitude_nonlinearity"], both)
    assert again.pixels[seen] == pytest.approx(found.pixels[seen], rel=1e-4)


def test_a_beam_counts_by_the_distances_that_move_with_the_amplitude(tmp_path: Path) -> None:
    """Light that is less by a share s moves distances by s a / A; where none move, s counts in sigma_A."""
    pattern = EmissionPattern(falloff=(-0.4, 0.1))

    def bend(size: float) -> AmplitudeOffset:
        return AmplitudeOffset(
            hyperbola=MappingProxyType(dict.fromkeys((16.0, 60.0, 100.0), Hyperbola(size, 0.0)))
        )

    def share(one: Any) -> np.ndarray:
        u, v = one.context.camera.rays[..., 0], one.context.camera.rays[..., 1]
        square = np.arctan(np.hypot(u, v) / one.context.camera.rays[..., 2]) ** 2
        return np.asarray(np.log(1 - 0.4 * square + 0.1 * square**2))

    forward, fitted = forward_of(tmp_path, pattern)
    _, seen = expected(forward, share)
    alone = of_terms(fitted, ["emission_pattern"], forward.camera).pixels
    wanted, _ = expected(forward, lambda one: share(one) * AMBIGUITY / (2 * np.pi))
    assert alone[seen] == pytest.approx(wanted[seen], rel=0.02, abs=1e-6)

    def with_bend(size: float) -> tuple[Forward, np.ndarray]:
        both = with_effects(forward.camera, {**forward.camera.effects, "amplitude_offset": bend(size)})
        combined = Forward(forward.dataset, fitted.scene, both)
        combined.amplitude_model = forward.amplitude_model
        there = SimpleNamespace(forward=combined, camera=both)
        return combined, of_terms(there, ["emission_pattern"], both).pixels  # type: ignore[arg-type]

    combined, moved = with_bend(6.0)
    # as far as the amplitude that terms see follows the predicted light
    wanted, _ = expected(combined, lambda one: share(one) * -6.0 / one.amplitude * one.amplitude_follows)
    assert moved[seen] == pytest.approx(wanted[seen], rel=0.02, abs=1e-6)
    assert moved[seen].max() < 0.1 * alone[seen].max()
    # by less than half a millimetre they show nothing of it
    _, hardly = with_bend(0.06)
    assert hardly[seen] == pytest.approx(alone[seen], rel=0.01)


def test_what_an_effect_does_beyond_its_form_belongs_to_its_place(tmp_path: Path) -> None:
    """The true beam points elsewhere: the form is round, its changes are not."""
    truth, board = camera(tmp_path, STRAY), scene(tmp_path)
    data = record(truth, board, poses=16, seed=4)
    forward = Forward(data, board, truth)
    forward.estimate_amplitudes()

    def across(one: Any) -> np.ndarray:
        ramp = np.linspace(-1.0, 1.0, one.distance.shape[1])[None, :]
        return np.asarray(0.6 * np.nan_to_num(change_by(one, "scattering")[0]) * ramp)

    moved = [replace(p.station, distance=p.station.distance + across(p)) for p in forward.predictions()]
    data = replace(data, stations=moved)
    fitted, plain, with_rest = located(data, board, truth, "scattering")
    changes = [change_by(p, "scattering")[0] + across(p) for p in forward.predictions()]
    numbers = iter(changes)
    wanted, seen = expected(forward, lambda one: np.nan_to_num(next(numbers)))
    errors = [float(np.std((one - wanted)[seen])) for one in (plain, with_rest)]
    assert errors[1] < 0.5 * errors[0]
    assert (
        change_of_forms(fitted.camera, ["scattering"], (), {})(next(fitted.forward.predictions())).max() == 0
    )


def test_what_bleeds_fades_with_the_gap_to_the_light(tmp_path: Path) -> None:
    """The form says as much in the whole column; the truth fades within 5 px, below the light alone."""
    truth, board = camera(tmp_path, SaturationBleed(column=0.012)), scene(tmp_path)
    truth = replace(truth, sensor=replace(truth.sensor, saturation=2500.0))
    data = record(truth, board, poses=24, seed=4)
    forward = Forward(data, board, truth)
    forward.estimate_amplitudes()

    def fading(one: Any) -> np.ndarray:
        saturated = one.station.saturated > 0
        found = np.zeros(saturated.shape)
        for v, u in np.argwhere(saturated):
            found[v:, u] = np.exp(-np.arange(len(found) - v) / 5.0)
        return np.where(saturated, 0.0, 0.06 * found)

    def said(one: Any) -> np.ndarray:
        saturated = one.station.saturated > 0
        return np.asarray(0.012 * (saturated.any(axis=0) & ~saturated))

    moved = [
        replace(p.station, distance=p.station.distance + fading(p) - said(p)) for p in forward.predictions()
    ]
    data = replace(data, stations=moved)
    fitted, *found = located(data, board, truth, "saturation_bleed")
    wanted = np.zeros(truth.shape)
    count = np.zeros(truth.shape)
    for one in fitted.forward.predictions():
        seen = (one.station.count > 0) & (one.station.saturated == 0) & one.view.geometry.hit
        wanted[seen] += (fading(one) / sigma(truth, one.amplitude))[seen] ** 2
        count += seen
    wanted /= np.maximum(count, 1)
    overlap = [intersection_over_union(region(one), region(wanted)) for one in found]
    assert overlap[0] < 0.6
    assert overlap[1] > 0.85


def test_changes_of_a_form_stay_within_those_that_were_fitted(tmp_path: Path) -> None:
    """A pixel that nobody uses, thrice as far as any other, is moved no more than the others are."""
    truth, board = camera(tmp_path, STRAY), scene(tmp_path)
    forward = Forward(record(truth, board, poses=4, frames=2, seed=4), board, truth)
    forward.estimate_amplitudes()
    column = np.ones(truth.shape)
    block = Block(
        (Regressor("form.scattering.0", "form", 1.0),),
        lambda one: [(0.001 * column * one.delivered.distance**2, None)],
    )
    one = next(iter(forward.predictions()))
    one.used[7, 11] = False
    one.delivered.distance[7, 11] *= 3.0
    change = change_of_forms(truth, ["scattering"], [block], {"form.scattering.0": 1.0})(one)
    assert change[7, 11] == pytest.approx(0.001 * np.nanmax(one.delivered.distance[one.used]) ** 2)


def test_a_camera_without_noise_has_that_of_its_counts(tmp_path: Path) -> None:
    forward, fitted = forward_of(tmp_path, DistanceScale(0.004))
    silent = replace(forward.camera, noise=Noise(floor=0.0, shot=0.0, amplitude=0.0))
    forward = Forward(forward.dataset, fitted.scene, silent)
    found = of_terms(SimpleNamespace(forward=forward, camera=silent), ["distance_scale"], silent)  # type: ignore[arg-type]
    lsb = AMBIGUITY / 65536
    one = next(iter(forward.predictions()))
    assert found.pixels.max() > (0.004 * np.nanmin(one.delivered.distance) / (lsb / np.sqrt(12))) ** 2


def test_residuals_count_beyond_their_noise_in_the_pixels_in_use(tmp_path: Path) -> None:
    """What a scale of distance leaves where it is unknown; a pixel that nobody uses may be anything."""
    truth, board = camera(tmp_path, DistanceScale(0.01)), scene(tmp_path)
    data = record(truth, board, poses=30, frames=2, seed=2, wrong=0.0)
    stated = camera(tmp_path)
    forward = Forward(data, board, stated)
    forward.masks = [(np.ones(stated.shape, bool), np.ones(stated.shape, bool)) for _ in data.stations]
    for used, _ in forward.masks:
        used[7, 11] = False
    for one in data.stations:
        one.distance[7, 11] += 3.0
    nothing = np.zeros(stated.shape)
    fitted: Any = SimpleNamespace(forward=forward, camera=stated, scene=board, pattern=nothing, nuisances={})
    found = of_residuals(fitted).pixels
    wanted, seen = expected(forward, lambda one: 0.01 * one.delivered.distance)
    assert found[7, 11] == 0
    seen[7, 11] = False
    # those at the rim are seen in a pose or two, where noise may be more than what is left
    assert (found[seen] > 0).mean() > 0.97
    assert np.median(found[seen] / wanted[seen]) == pytest.approx(1.0, abs=0.05)


def test_noise_alone_is_left_at_no_time(tmp_path: Path) -> None:
    """Stations of one frame are noisier than those of eight, which is no mismatch."""
    stated, board = camera(tmp_path), scene(tmp_path)
    parts = [
        record(stated, board, poses=n, frames=k, seed=s, wrong=0.0) for n, k, s in ((2, 1, 4), (12, 8, 5))
    ]
    late = [replace(one, time=one.time + 900.0) for one in parts[1].stations]
    data = replace(parts[0], stations=[*parts[0].stations, *late])
    forward = Forward(data, board, stated)
    fitted: Any = SimpleNamespace(
        forward=forward, camera=stated, scene=board, pattern=np.zeros(stated.shape), nuisances={}
    )
    found = of_residuals(fitted)
    assert np.median(found.pixels) < 0.01
    energies = [np.mean((one.residual / one.sigma)[one.used] ** 2) for one in forward.predictions()]
    assert energies == pytest.approx(np.ones(14), abs=0.15)


def test_frames_that_differ_are_where_they_scatter_beyond_their_noise(tmp_path: Path) -> None:
    """The upper left quarter scatters by twice its noise: three times its variance is left, else none."""
    forward, fitted = forward_of(tmp_path, AmplitudeOffset({16: Hyperbola(2.0, 1.0)}))
    corner = np.zeros(forward.camera.shape, bool)
    corner[: corner.shape[0] // 2, : corner.shape[1] // 2] = True
    predictions = list(forward.predictions())
    for k, one in enumerate(predictions):
        own = sigma(forward.camera, one.amplitude)
        variance = (np.where(corner, 2.0, 1.0) * own) ** 2
        forward.dataset.stations[k] = replace(one.station, distance_variance=variance)
    found = of_repeated_frames(fitted)
    seen = expected(forward, lambda one: np.zeros(corner.shape))[1]
    # widths of averaging reach across the border
    inner = np.zeros_like(corner)
    inner[2:6, 2:6] = True
    np.testing.assert_allclose(found.pixels[inner & seen], 3.0, rtol=0.02)
    np.testing.assert_allclose(found.pixels[-6:, -6:][seen[-6:, -6:]], 0.0, atol=0.02)
    assert found.covariates == ()


def test_times_are_from_the_first_to_the_last_frame_of_the_poses() -> None:
    """Stations of 0.08 s at 0, 2, 4 ...: three hold nine tenths of the energy, two of them neighbours."""
    energies = [0.1, 5.0, 4.0, 0.0, -0.3, 3.0, 0.2]
    stations = [(2.0 * k - 0.04, 2.0 * k + 0.04, one) for k, one in enumerate(energies)]
    assert np.ravel(_times(stations[::-1])) == pytest.approx([1.96, 4.04, 9.96, 10.04])
    assert _times([(0.0, 1.0, 0.0), (2.0, 3.0, -1.0)]) == []
    assert _times([]) == []


def test_of_many_times_those_with_the_shortest_gaps_are_joined() -> None:
    starts = [0.0, 10.0, 20.0, 23.0, 40.0, 50.0, 60.0, 62.0, 80.0, 90.0]
    apart = [(t, t + 1.0, e) for start in starts for t, e in ((start, 1.0), (start + 1.3, 0.0))]
    # nine of the ten hold nine tenths
    found = _times(apart)
    assert found[2:7] == [(20.0, 21.0), (23.0, 24.0), (40.0, 41.0), (50.0, 51.0), (60.0, 63.0)]
    assert len(found) == 8


def test_a_pose_of_several_stations_counts_once(tmp_path: Path) -> None:
    forward, fitted = forward_of(tmp_path, DistanceScale(0.004))
    once = of_terms(fitted, ["distance_scale"], forward.camera)
    # it lasts for five minutes more, in blocks of five seconds
    first = forward.dataset.stations[0]
    more = [replace(first, time=first.time - 5.0 * k) for k in range(60, 0, -1)]
    data = replace(forward.dataset, stations=[*more, *forward.dataset.stations])
    fitted.forward = Forward(data, fitted.scene, forward.camera)
    fitted.forward.amplitude_model = forward.amplitude_model
    often = of_terms(fitted, ["distance_scale"], forward.camera)
    assert np.ptp(once.pixels[once.pixels > 0]) > 0
    assert often.pixels == pytest.approx(once.pixels, rel=1e-5)


def test_settings_between_which_there_are_none_make_no_points() -> None:
    """Four integration times; the offset goes with 1 / t, which a point at 0 would forbid."""
    rng = np.random.default_rng(0)
    setting = rng.choice([16.0, 32.0, 64.0, 128.0], 5000)
    offset = 0.32 / setting + rng.normal(0, 0.001, 5000)
    (share, *_), curves = _shares(offset, np.full(5000, 1e6), {"integration_time": setting})
    assert share[0] == "integration_time"
    x, y, error = curves["integration_time"]
    assert x == pytest.approx([16.0, 32.0, 64.0, 128.0])
    assert y == pytest.approx(0.32 / x, abs=1.5e-4)
    assert error == pytest.approx(0.001 / np.sqrt(1250), rel=0.1)
    formula, missed = closed_form("integration_time", x, y, error)
    assert formula_curve(formula, x) == pytest.approx(0.32 / x, abs=2e-4)
    assert missed < 1e-4


def test_noisy_maps_are_averaged_with_the_neighbours_that_poses_agree_about() -> None:
    """A ring in noise gets its neighbours; a single bright column of the array does not."""
    rng = np.random.default_rng(8)
    v, u = np.mgrid[:60, :70]
    ring = 3.0 * np.exp(-0.5 * ((np.hypot(v - 27.0, u - 31.0) - 19.0) / 4.0) ** 2)
    column = 40.0 * (u == 23)
    count = np.full((2, 60, 70), 9.0)
    for true, smooth in ((ring, True), (column, False)):
        # nine mean squares of ten residuals each, the noise taken away
        total = (1 + true) * rng.chisquare(90, (2, 60, 70)) / 10 - 9
        found, plain = (mean_of_halves(total, count, smooth=each) for each in (True, False))
        assert plain == pytest.approx(np.maximum(total.sum(axis=0) / 18, 0.0), rel=1e-5, abs=1e-6)
        error, of_plain = (float(np.mean((x - true) ** 2)) for x in (found, plain))
        if smooth:
            assert error < 0.3 * of_plain
        else:
            assert error == pytest.approx(of_plain, rel=0.05)
    nothing = mean_of_halves(total, np.zeros((2, 60, 70)), smooth=True)
    assert not nothing.any()
