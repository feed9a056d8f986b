"""Powers of the poses, gains of pixels, a response, and how well amplitudes are predicted. Nulls first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.light_curves import RESPONSE
from rim_camera_ros.fit.amplitudes import AMPLITUDE_MODEL, AmplitudeModel
from rim_camera_ros.fit.fold_sums import share_of
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import FreeResponse, Problem
from rim_camera_ros.fit.residuals import amplitude_error
from rim_camera_ros.fit.solver import fit

from ..calibrate.helpers import camera, record, scene


def test_amplitudes_beyond_what_a_response_can_reach_tell_no_power(tmp_path: Path) -> None:
    """P = A / (1 + c A) stays below 1 / c: of a pixel that published more no light is known."""
    board = scene(tmp_path)
    data = record(camera(tmp_path), board, poses=4, frames=2, seed=2)
    # in each pose some pixels are above
    highest = min(float(one.amplitude.max()) for one in data.stations)
    forward = Forward(data, board, camera(tmp_path, AmplitudeNonlinearity(compression=1.05 / highest)))
    model = forward.estimate_amplitudes()
    assert len(model.gains) == 4
    assert np.all(np.isfinite(list(model.gains.values())))
    assert np.isfinite(model.tau)
    # without a response all are known: powers as simulated, to the 1 % that they vary
    straight = Forward(data, board, camera(tmp_path)).estimate_amplitudes()
    assert list(straight.gains.values()) == pytest.approx([1.0] * 4, abs=0.04)


def test_gains_of_pixels_are_those_of_readings_whatever_the_response(tmp_path: Path) -> None:
    """Ln P = g + ln R(A): derivatives by a response hold no gain, which a prior of gains would pull at."""
    stated, board = camera(tmp_path, AmplitudeNonlinearity(compression=3e-5)), scene(tmp_path)
    data = record(stated, board, poses=2, frames=2, seed=3)
    gains = 0.05 * np.random.default_rng(8).standard_normal(stated.shape)
    forward = Forward(data, board, stated)
    plain, uneven = (
        next(iter(forward.predictions(AmplitudeModel({}, 0.0, one))))
        for one in (np.zeros(stated.shape), gains)
    )
    used = plain.amplitude_used & uneven.amplitude_used
    assert used.sum() > 500
    assert (uneven.model_reading / plain.model_reading)[used] == pytest.approx(np.exp(gains[used]))
    assert uneven.pixel_gain_column()[1][used] == pytest.approx(uneven.model_reading[used])
    by_compression = [
        one.columns(AmplitudeNonlinearity(compression=3e-5))["compression"][1] / one.model_reading
        for one in (plain, uneven)
    ]
    assert by_compression[1][used] == pytest.approx(by_compression[0][used])
    for before, after in zip(plain.curve_columns(RESPONSE), uneven.curve_columns(RESPONSE), strict=True):
        relative = [(one[1] / at.model_reading)[used] for one, at in ((before, plain), (after, uneven))]
        assert relative[1] == pytest.approx(relative[0])


@pytest.mark.parametrize("size", [0.005, 0.015])
def test_gains_smaller_than_stated_bend_no_response(tmp_path: Path, size: float) -> None:
    """Of 2 % stated: a power above 1 made all gains smaller, which 1,584 of them would be gladly."""
    stated, board = camera(tmp_path, AmplitudeNonlinearity(compression=1e-8)), scene(tmp_path)
    assert stated.radiometry.pattern_sigma == 0.02
    data = record(stated, board, seed=7)
    gains = size * np.random.default_rng(4).standard_normal(stated.shape)
    data.stations = [replace(one, amplitude=one.amplitude * np.exp(gains)) for one in data.stations]
    found = fit(Problem(data, board, response=FreeResponse(1000.0)), stated)
    labels = [label for label in RESPONSE if found.sigma[label] < 0.15]
    assert len(labels) >= 4
    ratios = [found.parameters[label] / found.sigma[label] for label in labels]
    assert np.abs(ratios).max() < 3.0


def test_gains_of_pixels_are_no_error_that_neighbours_share(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, board, seed=7)
    gains = 0.03 * np.random.default_rng(4).standard_normal(stated.shape)
    data.stations = [replace(one, amplitude=one.amplitude * np.exp(gains)) for one in data.stations]
    forward = Forward(data, board, stated)
    forward.estimate_amplitudes()
    assert amplitude_error(forward, {}) < 0.01


@pytest.mark.parametrize("size", [0.01, 0.03])
def test_errors_that_the_pixels_of_a_patch_share_are_found(tmp_path: Path, size: float) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, board, seed=7)
    rng = np.random.default_rng(5)
    forward = Forward(data, board, stated)
    forward.estimate_amplitudes()
    quiet = amplitude_error(forward, {})
    stations = []
    for one in forward.predictions():
        patches = forward.views.patches(one.view)
        factor = np.exp(size * rng.standard_normal(patches.max() + 1))[patches]
        stations.append(replace(one.station, amplitude=one.station.amplitude * factor))
    data.stations = stations
    assert np.hypot(quiet, size) == pytest.approx(amplitude_error(forward, {}), rel=0.15)
    assert AMPLITUDE_MODEL <= quiet < 0.006


def test_a_response_scales_densities_of_independent_amplitudes_as_it_does_noise(tmp_path: Path) -> None:
    """What a response changes in the norm of the likelihood it changes in that of scipy's densities."""
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, board, poses=2, frames=2, seed=3)
    norms, exact = [], []
    for camera_file in (stated, camera(tmp_path, AmplitudeNonlinearity(compression=3e-5))):
        forward = Forward(data, board, camera_file)
        # as in all that is compared
        forward.camera_of_noise = stated
        one = next(iter(forward.predictions(AmplitudeModel())))
        assert one.amplitude_used.sum() > 500
        share = share_of(one, [], gain_sigma=0.0, stray_light=0.0, factors=None)
        norms.append(-share.log_sigma)
        exact.append(
            stats.norm.logpdf(0.0, scale=one.amplitude_noise[one.amplitude_used]).sum()
            + stats.norm.logpdf(0.0, scale=one.sigma[one.used]).sum()
        )
    assert exact[1] - exact[0] > 20
    assert norms[1] - norms[0] == pytest.approx(exact[1] - exact[0], rel=0.01)


def test_another_camera_is_compared_given_the_same_imperfections(tmp_path: Path) -> None:
    """Reflectivities and lobes that were found are no part of the difference between two cameras."""
    stated, board = camera(tmp_path), scene(tmp_path)
    bent = record(camera(tmp_path, AmplitudeNonlinearity(compression=2e-5)), board, poses=6, frames=2, seed=5)
    found = fit(
        Problem(bent, board, origin=stated), camera(tmp_path, AmplitudeNonlinearity(compression=1e-5))
    )
    curves = found.forward.light_curves
    assert curves is not None
    assert len(curves.values) > 10

    def readings(forward: Forward) -> np.ndarray:
        return np.concatenate([one.model_reading[one.amplitude_used] for one in forward.predictions()])

    here = readings(found.forward)
    plain = Forward(bent, found.scene, found.camera, views=found.forward.views)
    plain.amplitude_model, plain.masks = found.forward.amplitude_model, found.forward.masks
    assert np.abs(readings(plain) / here - 1.0).max() > 1e-3
    assert readings(found.by_another(found.camera)) == pytest.approx(here, rel=1e-9)
    # of a camera without the response its compression is all that differs, and the power
    effect = found.camera.effects["amplitude_nonlinearity"]
    assert isinstance(effect, AmplitudeNonlinearity)
    straight = readings(found.by_another(replace(found.camera, effects={})))
    assert np.abs(straight / here - 1.0).max() > 0.05
    # gains of pixels are those of readings, 2 % of a compression of 10 %
    assert effect.compressed(straight) == pytest.approx(here, rel=3e-3)
