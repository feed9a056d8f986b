"""A response's one parameter, and the curve over the amplitude that it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.trials import RESPONSE_SIZES, TrialFit, fit_trial

from ..calibrate.helpers import camera, record, scene

COMPRESSION = "effects.amplitude_nonlinearity.compression"


def tried(folder: Path, published: Callable[[np.ndarray], np.ndarray]) -> tuple[Exploration, np.ndarray]:
    """Return a trial of the compression where light is ``published`` so, and amplitudes before that."""
    stated, board = camera(folder), scene(folder)
    straight = record(stated, board, poses=12, frames=2, seed=11)
    stations = [replace(one, amplitude=published(one.amplitude)) for one in straight.stations]
    problem = Problem(replace(straight, stations=stations), board, origin=stated)
    without = fit(problem, stated, fold_of=folds_of(problem.dataset))
    start = camera(folder, AmplitudeNonlinearity(compression=1e-6))
    trial = TrialFit(
        ("amplitude_nonlinearity",), problem, start, without.point, folds_of(problem.dataset), seed=3
    )
    light = np.concatenate([one.amplitude[one.amplitude > 0] for one in straight.stations])
    return fit_trial(trial), np.quantile(light, [0.1, 0.5, 0.9])


@pytest.mark.parametrize("compression", [8e-6, 3e-5])
def test_a_compression_is_its_parameter_with_next_to_no_curve(tmp_path: Path, compression: float) -> None:
    """Given a free curve the parameter was 0 to five times the true one, and had no sigma to speak of."""
    found, _ = tried(tmp_path, lambda light: light / (1.0 + compression * light))
    fitted = found.fit
    sigma = fitted.sigma[COMPRESSION]
    assert sigma < 0.4 * compression
    assert fitted.parameters[COMPRESSION] == pytest.approx(compression, abs=3.0 * sigma)
    assert fitted.response is not None
    assert fitted.response.sigma <= RESPONSE_SIZES[2]
    assert not fitted.at_bounds


def test_another_form_is_said_by_the_curve(tmp_path: Path) -> None:
    """A power of the light: 7 % a decade, which a compression describes at bright light only."""
    found, light = tried(tmp_path, lambda one: one * (np.maximum(one, 1.0) / 1000.0) ** -0.03)
    fitted = found.fit
    assert fitted.response is not None
    assert fitted.response.sigma > RESPONSE_SIZES[-1]
    # the parameter is the one by itself: the curve takes nothing of it
    alone, sigma = fitted.response.parameter[COMPRESSION]
    assert fitted.parameters[COMPRESSION] == pytest.approx(alone, abs=2.0 * sigma)
    curves = fitted.forward.light_curves
    assert curves is not None
    effect = fitted.camera.effects["amplitude_nonlinearity"]
    assert isinstance(effect, AmplitudeNonlinearity)
    said = effect.compressed(light) * curves.response(light)
    true = light * (light / 1000.0) ** -0.03
    assert (said / true) / (said / true)[1] == pytest.approx([1.0, 1.0, 1.0], abs=0.01)
