"""Precision of one distance: theory against Monte Carlo, and the camera file's model."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rim_camera_ros.noise import (
    ROUNDING,
    Noise,
    rounding_of_mean,
    shot_noise_precision,
    sigma_amplitude,
    signal_to_noise_precision,
)

L = 7.49481145


def _monte_carlo(amplitude: float, offset: float, phase: float) -> float:
    """Standard deviation in metres of eq. 2.5 with Poisson samples that carry the amplitude itself."""
    rng = np.random.default_rng(2007)
    mean = offset + amplitude * np.cos(phase - np.arange(4) * np.pi / 2)
    c = rng.poisson(mean, (300_000, 4)).astype(float)
    found = np.arctan2(c[:, 1] - c[:, 3], c[:, 0] - c[:, 2])
    error = np.angle(np.exp(1j * (found - phase)))
    return float(error.std() * L / (2 * np.pi))


@pytest.mark.parametrize("phase", [0.4, 2.2])
def test_shot_noise_against_monte_carlo(phase: float) -> None:
    """Eq. 2.8 is pi / 2 above sampled amplitudes (300,000 draws: 0.13 % standard error)."""
    amplitude, offset = 60_000.0, 200_000.0
    theory = shot_noise_precision(ambiguity=L, amplitude=amplitude, offset=offset)
    assert theory / _monte_carlo(amplitude, offset, phase) == pytest.approx(math.pi / 2, rel=0.007)


def test_shot_noise_is_exact_for_samples_over_half_a_period() -> None:
    """The received amplitude A leaves 2 / pi A in the samples (dt = T / 2)."""
    amplitude, offset = 90_000.0, 200_000.0
    theory = shot_noise_precision(ambiguity=L, amplitude=amplitude, offset=offset)
    assert _monte_carlo(amplitude * 2 / math.pi, offset, 1.1) == pytest.approx(theory, rel=0.007)


def test_signal_to_noise_against_monte_carlo() -> None:
    """Eq. 2.9 with all electrons of four samples as signal, their shot noise as noise, contrast A / B."""
    amplitude, offset = 50_000.0, 200_000.0
    found = signal_to_noise_precision(
        modulation_wavelength=2 * L,
        contrast=amplitude / offset,
        signal_to_noise=4 * offset / math.sqrt(4 * offset),
    )
    assert found == pytest.approx(_monte_carlo(amplitude, offset, 0.9), rel=0.007)


def test_more_measurements_are_more_precise() -> None:
    one = signal_to_noise_precision(modulation_wavelength=15.0, contrast=0.4, signal_to_noise=120.0)
    nine = signal_to_noise_precision(
        modulation_wavelength=15.0, contrast=0.4, signal_to_noise=120.0, measurements=9
    )
    assert one == pytest.approx(15.0 / (math.sqrt(8) * math.pi * 0.4 * 120), rel=1e-12)
    assert one / nine == pytest.approx(3, rel=1e-12)


def test_noise_model_by_hand() -> None:
    """sigma^2 = floor^2 + shot^2 / A + (amplitude / A)^2, with background + shot^2 level / A^2."""
    model = Noise(floor=0.003, shot=0.2, amplitude=20.0)
    assert model.sigma_distance(np.array([400.0]))[0] == pytest.approx(
        math.sqrt(9e-6 + 0.04 / 400 + 400 / 160_000), rel=1e-12
    )
    assert model.sigma_distance(np.array([400.0]), background=5000.0)[0] == pytest.approx(
        math.sqrt(9e-6 + 0.04 / 400 + (400 + 0.04 * 5000) / 160_000), rel=1e-12
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_noise_without_light_is_infinite(dtype: type) -> None:
    found = Noise().sigma_distance(np.array([0.0, -3.0, np.nan, 1e-37, 1e5], dtype))
    assert found.dtype == dtype
    assert np.isinf(found[:3]).all()
    assert not np.isnan(found).any()
    assert found[4] == pytest.approx(0.0045087, rel=1e-4)


def test_noise_is_circular_in_the_complex_plane() -> None:
    """A turn is L metres: moving by sigma_d along the circle of radius A is A 2 pi sigma_d / L counts."""
    found = sigma_amplitude(np.array([0.02]), np.array([1500.0]), ambiguity=L)
    assert found[0] == pytest.approx(1500 * 2 * math.pi * 0.02 / L, rel=1e-12)


@pytest.mark.parametrize(("sigma", "averaged"), [(0.02, False), (0.8, True), (3.0, True)])
def test_rounding_of_the_mean_of_frames(sigma: float, averaged: bool) -> None:
    """Against 20,000 pixels of nine frames: means err by a rounding, or by a third of it beside the noise."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(5, 60, 20_000)
    frames = np.rint(truth + rng.normal(0, sigma, (9, truth.size)))
    error = np.var(frames.mean(axis=0) - truth) - sigma**2 / 9
    stated = rounding_of_mean(np.array([sigma**2]), np.array([9]))
    assert stated == pytest.approx([ROUNDING / 9 if averaged else ROUNDING])
    assert error == pytest.approx(float(stated[0]), rel=0.15, abs=0.02 * sigma**2)
