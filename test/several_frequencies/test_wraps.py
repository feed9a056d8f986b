"""Wraps of several frequencies against enumeration, analytic counts, and noise that is drawn."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from rim_camera_ros.measurement.wraps import WrapTable, common_range, possible

C = 299_792_458.0
KINECT = (80e6, 16e6, 120e6)
TWO = (100e6, 80e6)


def ranges(*frequencies: float) -> list[float]:
    return [C / (2 * one) for one in frequencies]


@cache
def table(frequencies: tuple[float, ...], low: float = 0.0, high: float | None = None) -> WrapTable:
    top = common_range(frequencies) if high is None else high
    return WrapTable(ranges(*frequencies), (low, top))


def measured(
    periods: list[float], distance: np.ndarray, sigma: np.ndarray, rng: np.random.Generator
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Distances modulo each period with noise, and their sigmas, (1, N) float32."""
    d = [
        np.mod(distance + s * rng.standard_normal(distance.size), period).astype(np.float32)[None]
        for period, s in zip(periods, sigma, strict=True)
    ]
    return d, [np.full((1, distance.size), one, np.float32) for one in sigma]


@pytest.mark.parametrize(
    ("frequencies", "expected"),
    [(KINECT, C / 16e6), (TWO, C / 40e6), ((20e6, 21e6), C / 2e6), ((30e6,), C / 60e6)],
)
def test_phases_repeat_where_the_greatest_common_divisor_does(
    frequencies: tuple[float, ...], expected: float
) -> None:
    assert common_range(frequencies) == pytest.approx(expected, rel=1e-12)


def test_every_distance_has_its_wraps_in_the_table() -> None:
    rows = possible(ranges(*KINECT), (0.0, C / 16e6))
    distances = np.linspace(0, C / 16e6, 40_001)[:-1] + 1e-5
    seen = {tuple(int(d // one) for one in ranges(*KINECT)) for d in distances}
    # ends of ranges within 18.74 m: 9 of 80 MHz, 1 of 16 MHz, 14 of 120 MHz; 4 + 1 of them coincide
    assert len(seen) == 9 + 1 + 14 - 5 + 1
    assert seen <= set(rows)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.4, 18.4), st.permutations(KINECT))
def test_without_noise_the_distance_is_found(distance: float, frequencies: list[float]) -> None:
    periods = ranges(*frequencies)
    d = [np.full((1, 1), distance % one, np.float32) for one in periods]
    found = table(tuple(frequencies), 0.3, 18.5).resolve(d, [np.full((1, 1), 0.01, np.float32)] * 3)
    assert found.distance[0, 0] == pytest.approx(distance, abs=2e-5)


@pytest.mark.parametrize("frequencies", [KINECT, TWO])
def test_the_most_likely_wraps_are_those_of_an_enumeration(frequencies: tuple[float, ...]) -> None:
    """An independent search: least squares for every combination of wraps whatever, in float64."""
    periods, rng = ranges(*frequencies), np.random.default_rng(3)
    low, high = 0.3, common_range(frequencies) - 0.3
    sigma = np.array(periods) / (2 * np.pi * np.array([3.0, 4.0, 3.5][: len(periods)]))
    distance = rng.uniform(low, high, 400)
    d, s = measured(periods, distance, sigma, rng)
    found = WrapTable(periods, (low, high)).resolve(d, s)
    best = np.full(distance.size, np.inf)
    answer, costs = np.full(distance.size, np.nan), []
    weights = 1 / sigma**2
    for row in itertools.product(*(range(-1, int(high // one) + 2) for one in periods)):
        places = np.stack([d[i][0].astype(float) + row[i] * periods[i] for i in range(len(periods))])
        mean = weights @ places / weights.sum()
        cost = weights @ (places - mean) ** 2
        cost[(mean < low) | (mean > high)] = np.inf
        costs.append(cost)
        answer = np.where(cost < best, mean, answer)
        best = np.minimum(best, cost)
    assert np.allclose(found.distance[0], answer, atol=1e-4)
    others = np.exp((best - np.array(costs)) / 2).sum(axis=0) - 1
    lead = -2 * np.log(others)
    near = lead < 10  # the table leaves out wraps that need noise of more than a tenth of a period
    assert near.sum() > 50
    assert np.allclose(found.lead[0][near], lead[near], rtol=2e-3, atol=0.02)


@pytest.mark.parametrize("frequencies", [KINECT, TWO])
def test_wrong_wraps_are_as_frequent_as_stated(frequencies: tuple[float, ...]) -> None:
    periods, rng = ranges(*frequencies), np.random.default_rng(8)
    high = common_range(frequencies) - 0.1
    wraps = table(frequencies, 0.3, high)
    n = 150_000
    for times in (4.0, 5.0):
        sigma = np.array(periods) / (2 * np.pi * times)
        distance = rng.uniform(0.5, high - 0.2, n)
        found = wraps.resolve(*measured(periods, distance, sigma, rng))
        wrong = int((np.abs(found.distance[0] - distance) > min(periods) / 3).sum())
        assert wrong > 150
        assert found.wrong[0].mean() == pytest.approx(wrong / n, rel=0.15)
        assert wraps.probability_of_error(sigma) == pytest.approx(wrong / n, rel=0.15)


@pytest.mark.parametrize("frequencies", [KINECT, TWO])
@pytest.mark.parametrize("times", [2.0, 2.5, 3.0, 4.0])
def test_faint_wraps_are_wrong_as_often_as_stated(frequencies: tuple[float, ...], times: float) -> None:
    """With phases of phasors in circular noise, whose sigma is that of the measured amplitude.

    Measured amplitudes are noisy themselves: what is stated may be too much, by three tenths at 4 sigma.
    """
    periods, rng, n = ranges(*frequencies), np.random.default_rng(12), 60_000
    high = common_range(frequencies) - 0.1
    distance = rng.uniform(0.5, high - 0.2, n)
    d, sigma = [], []
    for period in periods:
        noise = rng.standard_normal(n) + 1j * rng.standard_normal(n)
        phasor = times * np.exp(2j * np.pi * distance / period) + noise
        d.append((np.angle(phasor) / (2 * np.pi) % 1 * period).astype(np.float32)[None])
        sigma.append((period / (2 * np.pi) / np.abs(phasor)).astype(np.float32)[None])
    found = table(frequencies, 0.3, high).resolve(d, sigma)
    known = np.isfinite(found.wrong[0])
    assert known.mean() > 0.98
    wrong = np.abs(found.distance[0] - distance)[known] > min(periods) / 3
    assert 0.93 * wrong.mean() < found.wrong[0][known].mean() < 1.33 * wrong.mean()


@pytest.mark.parametrize("frequencies", [KINECT, TWO])
def test_less_than_one_wrap_in_ten_thousand_is_wrong_at_ten_sigma(frequencies: tuple[float, ...]) -> None:
    periods, rng = ranges(*frequencies), np.random.default_rng(5)
    high = common_range(frequencies) - 0.05
    wraps, n = table(frequencies, 0.3, high), 200_000
    sigma = np.array(periods) / (2 * np.pi * 10.0)
    distance = rng.uniform(0.5, high - 0.5, n)
    found = wraps.resolve(*measured(periods, distance, sigma, rng))
    wrong = int((~(np.abs(found.distance[0] - distance) < min(periods) / 3)).sum())
    # one in ten thousand would make 20; so few happen with a probability below 1e-6
    assert binom.cdf(wrong, n, 1e-4) < 1e-6
    assert wraps.probability_of_error(sigma) < 1e-5


def test_a_table_allows_its_own_wraps_alone() -> None:
    periods = ranges(*TWO)
    given_rows = WrapTable(periods, (0.0, 7.4), [(0, 0), (3, 2)])
    distance = np.array([0.7, 4.6, 2.0])  # wraps (0, 0), (3, 2), (1, 1)
    d = [np.mod(distance, one).astype(np.float32)[None] for one in periods]
    found = given_rows.resolve(d, [np.full((1, 3), 0.01, np.float32)] * 2).distance[0]
    assert found[:2] == pytest.approx(distance[:2], abs=1e-5)
    assert abs(found[2] - 2.0) > 0.5
    assert given_rows.wraps_at(4.6) == (3, 2)


def test_a_frequency_without_a_distance_gives_none() -> None:
    d = [np.array([[0.3, np.nan]], np.float32), np.array([[0.3, 0.3]], np.float32)]
    found = table(TWO).resolve(d, [np.full((1, 2), 0.01, np.float32)] * 2)
    assert found.distance[0, 0] == pytest.approx(0.3)
    assert np.isnan(found.distance[0, 1])
    assert not found.lead[0, 1] >= 0
