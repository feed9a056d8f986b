"""The noise that shipped files state, against the scatter of what their devices evaluate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.diagnose.variance import examine_variance
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.noise import fit_noise
from rim_camera_ros.frame import Settings
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.single_photon.estimation import fisher_sigma

from .recordings import board, dataset, small

#: Board distances [m] and integration times of a camera's range.
PLACES = {
    "epfl64": [(0.5, 100.0), (1.1, 400.0), (1.7, 200.0), (2.3, 400.0), (2.5, 100.0)],
    "gated": [(0.5, 2.0), (1.1, 14.0), (1.7, 30.0), (2.3, 70.0)],
}


@pytest.mark.parametrize("name", sorted(PLACES))
def test_repeated_frames_scatter_as_the_shipped_file_says(name: str, tmp_path: Path) -> None:
    """At all distances, integration times and temperatures together, and pose by pose."""
    camera = small(name, width=52, height=39)
    scene = board(tmp_path / "board.yaml", *zip(*PLACES[name], strict=True), frames=6)
    data = dataset(camera, camera, scene, seed=3)
    forward = Forward(data, scene, camera)
    found = examine_variance(forward)
    assert found.sigma < 0.02
    # single photons: faint pixels scatter by 2 to 4 % more than the bound, which is for many photons
    assert found.ratio == pytest.approx(1.0, abs=3 * found.sigma + (0.02 if name == "epfl64" else 0.0))
    assert not found.noise_is_wrong
    kept = fit_noise(data, camera)
    assert kept is not None
    assert kept.confirmed
    # with numbers that are wrong by a quarter it is fitted, and stays tied to the amplitude's noise
    noisy = replace(camera, noise=replace(camera.noise, shot=1.25 * camera.noise.shot))
    fitted = fit_noise(data, noisy)
    assert fitted is not None
    assert not fitted.confirmed
    assert fitted.noise.shot == pytest.approx(camera.noise.shot, rel=0.04)
    assert fitted.noise.circular_range == camera.noise.circular_range


def test_the_noise_of_gates_goes_with_the_distance_as_the_bound() -> None:
    """Two gates and photons alone: sigma^2 = (c T / 2)^2 x (1 - x) / A; with three the bound itself."""
    camera = small("gated")
    way = measurement_of(camera)
    estimator = way.estimator(camera)  # type: ignore[attr-defined]
    distance, settings = np.array([0.4, 0.9, 1.5, 2.2, 2.7]), Settings(integration_time=20.0)
    for amplitude in (500.0, 2000.0, 40000.0):
        stated = camera.sigma_distance(np.full(5, amplitude), distance=distance, settings=settings)
        assert stated == pytest.approx(estimator.bound(distance, amplitude=amplitude), rel=0.01)
    two = replace(camera.measurement, gates=camera.measurement.gates[:2], read_noise=0.0, rise_time=1e-12)
    sharp = replace(camera, measurement=two)
    sharp = replace(sharp, noise=two.noise(sharp))
    x = distance / (299_792_458.0 * 20e-9 / 2)
    expected = 299_792_458.0 * 20e-9 / 2 * np.sqrt(x * (1 - x) / 3e4)
    found = sharp.sigma_distance(np.full(5, 3e4), distance=distance, settings=settings)
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("time", "temperature"), [(100.0, 15.0), (400.0, 45.0)])
def test_the_noise_of_single_photons_goes_with_time_and_temperature(time: float, temperature: float) -> None:
    """350 Hz at 25 degC, doubled every 10: 18 dark counts in 100 ms at 15 degC, 560 in 400 ms at 45 degC."""
    camera = small("epfl64")
    detector = camera.measurement.detector(camera)
    settings = Settings(integration_time=time, body_temperature=temperature)
    dark = 350.0 * 2 ** ((temperature - 25.0) / 10.0) * time / 1000.0
    for signal in (80.0, 400.0, 5000.0):
        stated = camera.sigma_distance(np.array([signal]), distance=np.array([1.1]), settings=settings)
        bound = fisher_sigma(
            detector,
            distance=1.1,
            signal=signal,
            background=dark + 0.01 * signal,
            cycles=detector.cycles(time / 1000.0),
        )
        assert stated[0] == pytest.approx(bound, rel=0.03)
