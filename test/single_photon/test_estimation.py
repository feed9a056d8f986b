"""Distances of histograms: errors against the Cramer-Rao bound, in closed form and in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rim_camera_ros.single_photon.detector import SinglePhotonDetector
from rim_camera_ros.single_photon.estimation import PulseEstimates, PulseEstimator, fisher_sigma
from rim_camera_ros.single_photon.first_photon import draw_histogram

QUIET = SinglePhotonDetector(dark_count_rate=0.0, afterpulse_probability=0.0)
HALF_LIGHT_SPEED = 299_792_458.0 / 2


def measured(
    detector: SinglePhotonDetector,
    *,
    distance: np.ndarray,
    signal: float,
    background: float,
    cycles: int,
    seed: int,
) -> tuple[PulseEstimates, np.ndarray]:
    """Return estimates and errors [m], the latter in (-L / 2, L / 2]."""
    rates = detector.rates(
        distance=distance,
        signal=np.full(distance.shape, signal),
        background=background,
        exposure=cycles / detector.pulse_rate,
    )
    rng = np.random.default_rng(seed)
    histogram = draw_histogram(rates, cycles=cycles, missed=detector.missed_cycles, rng=rng)
    found = PulseEstimator(detector).estimate(histogram, cycles=cycles)
    length = detector.ambiguity
    return found, (found.distance - distance + length / 2) % length - length / 2


@pytest.mark.parametrize(
    ("signal", "background", "cycles"),
    [
        (50.0, 0.0, 10_000_000),
        (50.0, 300.0, 10_000_000),
        (200.0, 2000.0, 10_000_000),
        (5000.0, 1000.0, 10_000_000),
        (3000.0, 6000.0, 10_000),  # 0.9 detections in a cycle
        (10000.0, 3000.0, 10_000),  # 1.3
    ],
)
def test_errors_are_those_of_the_cramer_rao_bound(signal: float, background: float, cycles: int) -> None:
    """Within 10 % from 50 photons on, also in pile-up, without bias, all over the range and its end."""
    distance = np.random.default_rng(3).uniform(0.0, QUIET.ambiguity, 4000)
    found, error = measured(
        QUIET, distance=distance, signal=signal, background=background, cycles=cycles, seed=4
    )
    near = np.abs(error) < 0.3
    assert near.mean() > 0.9985
    sigma = error[near].std()
    stated = math.sqrt(float((found.sigma[near].astype(float) ** 2).mean()))
    bound = np.mean(
        [
            fisher_sigma(QUIET, distance=d, signal=signal, background=background, cycles=cycles) ** 2
            for d in np.linspace(0.1, 2.9, 29)
        ]
    )
    assert sigma == pytest.approx(stated, rel=0.1)
    assert sigma == pytest.approx(math.sqrt(bound), rel=0.1)
    assert abs(error[near].mean()) < 4.5 * sigma / math.sqrt(near.sum())
    assert found.signal.mean() == pytest.approx(signal, rel=0.02)
    assert found.background.mean() == pytest.approx(background, rel=0.02, abs=0.5)


def test_bound_in_closed_form() -> None:
    """Light alone: c / 2 sigma_t / sqrt(S); under much other light sigma^2 = 4 sqrt(pi) sigma_t^3 b / S^2."""
    fine = replace(QUIET, bins=2048)
    scale = HALF_LIGHT_SPEED * fine.time_sigma
    found = fisher_sigma(fine, distance=1.2, signal=80.0, background=0.0, cycles=10_000_000)
    assert found == pytest.approx(scale / math.sqrt(80.0), rel=1e-3)
    found = fisher_sigma(fine, distance=1.2, signal=80.0, background=1e6, cycles=10**10)
    density = 1e6 / 20e-9
    expected = HALF_LIGHT_SPEED * math.sqrt(4 * math.sqrt(math.pi) * fine.time_sigma**3 * density) / 80.0
    assert found == pytest.approx(expected, rel=2e-3)


def test_averaging_reaches_millimetres() -> None:
    """Sec. 2.3.3: 300 ps and 50 kHz for 200 ms, 10 000 measurements; c / 2 * 307 ps / 100 = 0.46 mm."""
    detector = SinglePhotonDetector()
    distance = np.random.default_rng(6).uniform(0.2, 2.8, 2000)
    _, error = measured(
        detector, distance=distance, signal=10_000.0, background=0.0, cycles=10_000_000, seed=7
    )
    assert error.std() * 1e3 == pytest.approx(0.46, abs=0.04)
    assert abs(error.mean()) * 1e3 < 0.1  # afterpulses included


def test_first_photons_alone_would_measure_too_short() -> None:
    """1.5 signal photons in a cycle: the mean time of first photons is early, the estimate is not."""
    distance = np.full(1000, 1.7)
    found, error = measured(QUIET, distance=distance, signal=30_000.0, background=0.0, cycles=20_000, seed=8)
    # E of the first of a Poisson number of Gaussian times, by its density
    t = np.linspace(-6, 6, 20_001)
    density = np.exp(-(t**2) / 2) / math.sqrt(2 * math.pi)
    before = np.cumsum(density) * (t[1] - t[0])
    first = 1.5 * density * np.exp(-1.5 * before)
    early = float((first * t).sum() / first.sum()) * QUIET.time_sigma * HALF_LIGHT_SPEED
    assert early < -0.012
    assert abs(error.mean()) < 0.0002
    assert found.signal.mean() == pytest.approx(30_000.0, rel=0.01)


def test_nothing_detected_is_no_distance() -> None:
    histogram = np.zeros((128, 3), np.uint32)
    histogram[40, 1] = 5
    found = PulseEstimator(QUIET).estimate(histogram, cycles=1000)
    assert np.isnan(found.distance).tolist() == [True, False, True]
    assert found.distance[1] == pytest.approx(40.5 * QUIET.bin_width * HALF_LIGHT_SPEED, rel=1e-3)


def test_blocks_of_pixels_do_not_matter() -> None:
    rng = np.random.default_rng(2)
    rates = QUIET.rates(
        distance=rng.uniform(0, 2.9, 1300), signal=np.full(1300, 400.0), background=90.0, exposure=0.2
    )
    histogram = draw_histogram(rates, cycles=10_000_000, missed=2, rng=rng)
    estimator = PulseEstimator(QUIET)
    whole = estimator.estimate(histogram, cycles=10_000_000)
    part = estimator.estimate(histogram[:, 700:1100], cycles=10_000_000)
    np.testing.assert_allclose(part.distance, whole.distance[700:1100], rtol=1e-6)


def test_histograms_of_another_length() -> None:
    with pytest.raises(
        ValueError, match=r"shape \(64, 5\), expected \(128, pixels\): another number of bins"
    ):
        PulseEstimator(QUIET).estimate(np.zeros((64, 5), np.uint32), cycles=100)
