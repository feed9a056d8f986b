"""Detectors and first photons against photons that are followed one by one, and against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rim_camera_ros.single_photon.detector import SinglePhotonDetector
from rim_camera_ros.single_photon.first_photon import (
    coates,
    detection_probabilities,
    draw_histogram,
    ready_cycles,
)

QUIET = SinglePhotonDetector(dark_count_rate=0.0, afterpulse_probability=0.0)
LIGHT_SPEED = 299_792_458.0


def test_numbers_of_the_thesis() -> None:
    """Secs. 2.2.1, 2.3.3: 750 uW of 100 mW pulses of 150 ps are 50 MHz; 300 ps; less than 40 ns."""
    detector = SinglePhotonDetector()
    assert detector.pulse_rate == pytest.approx(750e-6 / (100e-3 * 150e-12))
    assert detector.ambiguity == pytest.approx(LIGHT_SPEED / 100e6)
    assert detector.bin_width == pytest.approx(156.25e-12)
    assert detector.time_sigma == pytest.approx(math.hypot(150e-12 / 2.354820, 300e-12), rel=1e-6)
    assert detector.missed_cycles == 2
    assert replace(detector, dead_time=41e-9).missed_cycles == 3
    assert replace(detector, dead_time=0.0).missed_cycles == 0
    assert detector.cycles(0.2) == 10_000_000


def test_response_is_the_integral_of_a_gaussian_that_wraps() -> None:
    times = np.array([3.3e-9, 19.95e-9])
    share = QUIET.response(times)
    np.testing.assert_allclose(share.sum(axis=0), 1.0, rtol=1e-12)
    centres = (np.arange(128) + 0.5) * QUIET.bin_width
    assert (share[:, 0] * centres).sum() == pytest.approx(3.3e-9, abs=1e-14)
    spread = (share[:, 0] * (centres - 3.3e-9) ** 2).sum()
    assert spread == pytest.approx(QUIET.time_sigma**2 + QUIET.bin_width**2 / 12, rel=1e-6)
    # 50 ps before the end of the cycle: the first bin of the next holds what lies 50 to 206.25 ps behind
    low, high = (0.5 * math.erf(t / QUIET.time_sigma / math.sqrt(2)) for t in (50e-12, 206.25e-12))
    assert share[0, 1] == pytest.approx(high - low, rel=1e-6)


@pytest.mark.parametrize(
    ("temperature", "rate"), [(None, 400.0), (20.0, 400.0), (36.0, 1600.0), (12.0, 200.0)]
)
def test_dark_counts_double(temperature: float | None, rate: float) -> None:
    detector = replace(QUIET, dark_count_rate=400.0, dark_count_temperature=20.0, dark_count_doubling=8.0)
    assert detector.dark_rate(temperature) == pytest.approx(rate)
    rates = detector.rates(
        distance=np.array([1.0]),
        signal=np.array([0.0]),
        background=0.0,
        exposure=0.1,
        temperature=temperature,
    )
    np.testing.assert_allclose(rates, rate / 50e6 / 128, rtol=1e-12)


def test_first_photons_in_closed_form() -> None:
    """Constant light: P_i = (1 - exp(-r)) exp(-i r), a geometric distribution."""
    rates = np.full((128, 1), 0.03)
    expected = -np.expm1(-0.03) * np.exp(-0.03 * np.arange(128))
    np.testing.assert_allclose(detection_probabilities(rates)[:, 0], expected, rtol=1e-12)


def _one_by_one(rates: np.ndarray, cycles: int, missed: int, rng: np.random.Generator) -> np.ndarray:
    """Follow the photons of one pixel, cycle by cycle."""
    histogram = np.zeros(len(rates), int)
    photons = rng.poisson(rates, (cycles, len(rates))) > 0
    first = np.where(photons.any(axis=1), photons.argmax(axis=1), -1)
    cycle = 0
    while cycle < cycles:
        if first[cycle] < 0:
            cycle += 1
        else:
            histogram[first[cycle]] += 1
            cycle += 1 + missed
    return histogram


@pytest.mark.parametrize("missed", [0, 2, 7])
def test_histograms_are_those_of_photons_followed_one_by_one(missed: int) -> None:
    rng = np.random.default_rng(5)
    detector = replace(QUIET, bins=16)
    rates = detector.rates(
        distance=np.array([1.3]), signal=np.array([900.0]), background=500.0, exposure=2e-5
    )
    cycles, repeats = 1000, 400
    followed = np.array([_one_by_one(rates[:, 0], cycles, missed, rng) for _ in range(repeats)])
    drawn = draw_histogram(np.repeat(rates, 4000, axis=1), cycles=cycles, missed=missed, rng=rng)
    error = followed.std(axis=0, ddof=1) / math.sqrt(repeats)
    assert np.all(np.abs(followed.mean(axis=0) - drawn.mean(axis=1)) < 4.5 * error + 0.02)
    # the number of detections varies as little as their dead time lets it
    of_followed, of_drawn = followed.sum(axis=1).var(ddof=1), drawn.sum(axis=0).var(ddof=1)
    assert of_followed == pytest.approx(of_drawn, rel=4.5 * math.sqrt(2 / repeats))


@pytest.mark.parametrize("missed", [0, 2])
def test_coates_undoes_pile_up(missed: int) -> None:
    """1.5 detections in a cycle: first photons see late light too faint by 3, Coates' estimator does not."""
    rng = np.random.default_rng(8)
    rates = np.full((64, 500), 1.5 / 64)
    rates[50] = 0.1
    histogram = draw_histogram(rates, cycles=40_000, missed=missed, rng=rng)
    found = coates(histogram, cycles=40_000, missed=missed)
    ready = ready_cycles(histogram, cycles=40_000, missed=missed)
    naive = (histogram / ready).mean(axis=1)
    assert rates[49, 0] / naive[49] == pytest.approx(math.exp(1.5 * 49 / 64), rel=0.03)
    left = ready.mean() * np.exp(-np.cumsum(rates[:, 0]) + rates[:, 0])
    sigma = np.sqrt(np.expm1(rates[:, 0]) / left)
    error = found.mean(axis=1) - rates[:, 0]
    assert np.abs(error / sigma).max() < 4.5 / math.sqrt(500) + 0.01
    np.testing.assert_allclose(found.std(axis=1), sigma, rtol=0.15)


def test_coates_where_no_cycle_is_left() -> None:
    histogram = np.array([[3], [7], [0]])
    found = coates(histogram, cycles=10)[:, 0]
    assert found[0] == pytest.approx(-math.log(0.7))
    assert np.isinf(found[1])
    assert np.isnan(found[2])


def test_afterpulses_follow_the_detections() -> None:
    """Their sum is a geometric series; they begin a dead time of two cycles behind the pulse, and decay."""
    detector = replace(QUIET, afterpulse_probability=0.04, afterpulse_time_constant=15e-9)
    faint = QUIET.rates(distance=np.array([0.9]), signal=np.array([50.0]), background=0.0, exposure=0.2)
    rates = detector.with_afterpulses(faint)
    assert rates.sum() / faint.sum() == pytest.approx(1 / 0.96, rel=1e-5)
    # few enough that those of afterpulses do not count
    few = replace(detector, afterpulse_probability=1e-4)
    added = (few.with_afterpulses(faint) - faint)[:, 0]
    pulse = round(0.9 * 2 / LIGHT_SPEED / QUIET.bin_width)
    decay = math.log(added[pulse + 20] / added[pulse + 60])
    assert decay == pytest.approx(40 * QUIET.bin_width / 15e-9, rel=0.02)
    # the decay wraps: it goes on behind the end of the cycle
    wrapped = added[pulse - 20] / added[127]
    assert wrapped == pytest.approx(math.exp(-(pulse - 19) * QUIET.bin_width / 15e-9), rel=0.02)
