"""Four samples, complex image, ambiguity, waveforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.phasor import (
    Waveform,
    ambiguity_range,
    demodulate,
    dynamic_range,
    frequency_selectivity,
    nearest_period,
    parse_waveform,
    phase_distance,
    selectivity_envelope,
    to_phasor,
    wrap,
    wrap_residual,
)

L = 7.49481145
TURN = 2 * math.pi


# --- limits of the method -----------------------------------------------------------------------


def test_ambiguity_range_and_resolution() -> None:
    assert ambiguity_range(20e6) == pytest.approx(7.49481, abs=5e-6)
    assert ambiguity_range(31e6) == pytest.approx(299792458 / 62e6, rel=1e-14)
    assert ambiguity_range(20e6) / 2**16 == pytest.approx(0.114e-3, abs=5e-7)


def test_dynamic_range() -> None:
    found = dynamic_range(nearest=0.2, farthest=7.5, least_reflectivity=0.05, greatest_reflectivity=1.0)
    assert found == pytest.approx(89, abs=0.05)
    assert 10 ** (found / 20) == pytest.approx(28_000, rel=0.005)


def test_frequency_selectivity() -> None:
    """The thesis' example: 20.0 and 20.1 MHz, 1 ms. The sinc is 0 there, its envelope better than 40 dB."""
    assert frequency_selectivity(frequency_difference=0.1e6, window=1e-3) == pytest.approx(0, abs=1e-15)
    envelope = selectivity_envelope(frequency_difference=0.1e6, window=1e-3)
    assert 20 * math.log10(envelope) == pytest.approx(-49.94, abs=0.01)
    assert envelope == selectivity_envelope(frequency_difference=-0.1e6, window=1e-3)


def test_frequency_selectivity_is_the_mean_of_a_turning_phasor() -> None:
    difference, window = 730.0, 1.3e-3
    t = (np.arange(200_000) + 0.5) / 200_000 - 0.5
    mean = np.cos(TURN * difference * window * t).mean()
    assert frequency_selectivity(frequency_difference=difference, window=window) == pytest.approx(
        mean, abs=1e-9
    )


@settings(derandomize=True, max_examples=100, deadline=None)
@given(st.floats(-1e6, 1e6), st.floats(1e-6, 0.1))
def test_the_envelope_bounds_the_selectivity(difference: float, window: float) -> None:
    found = abs(frequency_selectivity(frequency_difference=difference, window=window))
    assert found <= selectivity_envelope(frequency_difference=difference, window=window) + 1e-12


# --- complex image ------------------------------------------------------------------------------


def test_phasor_by_hand() -> None:
    """A quarter of the ambiguity range is a quarter turn, anticlockwise."""
    found = to_phasor(np.array([0.0, L / 4, L / 8]), np.array([3.0, 5.0, 2.0]), L)
    np.testing.assert_allclose(found, [3, 5j, math.sqrt(2) * (1 + 1j)], atol=1e-12)


def test_no_distance_or_no_light_is_zero() -> None:
    found = to_phasor(np.array([np.nan, 1.0, 1.0, np.inf]), np.array([700.0, 0.0, np.nan, 300.0]), L)
    assert found.tolist() == [0, 0, 0, 0]
    assert np.isnan(phase_distance(found, L)).all()


@settings(derandomize=True, max_examples=100, deadline=None)
@given(st.floats(-40, 40), st.floats(0.5, 60000), st.floats(-40, 40))
def test_distance_of_a_phasor_is_the_distance_modulo_the_range(d: float, a: float, near: float) -> None:
    phasor = to_phasor(np.array([d]), np.array([a]), L)
    found = phase_distance(phasor, L)
    assert 0 <= found[0] < L
    assert math.remainder(found[0] - d, L) == pytest.approx(0, abs=1e-9)
    unwrapped = nearest_period(found, np.array([near]), L)[0]
    assert abs(unwrapped - near) <= L / 2 * (1 + 1e-12)
    assert math.remainder(unwrapped - d, L) == pytest.approx(0, abs=1e-9)


def test_nearest_period_leaves_what_has_no_neighbour() -> None:
    assert nearest_period(np.array([3.1]), np.array([np.nan]), L).tolist() == [3.1]


def test_single_precision_stays_single() -> None:
    d, a = np.array([1.25, 6.5], np.float32), np.array([900.0, 33.0], np.float32)
    phasor = to_phasor(d, a, L)
    assert phasor.dtype == np.complex64
    found = phase_distance(phasor, L)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, d, atol=2e-6)
    assert wrap(np.array([8.0], np.float32), L).dtype == np.float32


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.floats(-1e6, 1e6))
def test_wrapping(x: float) -> None:
    wrapped = float(wrap(np.array([x]), L)[0])
    assert 0 <= wrapped < L
    assert math.remainder(wrapped - x, L) == pytest.approx(0, abs=1e-8)
    residual = float(wrap_residual(np.array([x]), L)[0])
    assert residual + 1e-8 > -L / 2
    assert residual <= L / 2 + 1e-8
    assert math.remainder(residual - x, L) == pytest.approx(0, abs=1e-8)


def test_ends_of_the_wrapped_intervals() -> None:
    """[0, L) and (-L / 2, L / 2]."""
    assert wrap(np.array([0.0, 8.0, -8.0, -1e-18]), 8.0).tolist() == [0.0, 0.0, 0.0, 0.0]
    assert wrap_residual(np.array([4.0, -4.0, 12.0, -12.0, 3.0]), 8.0).tolist() == [4.0, 4.0, 4.0, 4.0, 3.0]


# --- four samples -------------------------------------------------------------------------------


def _samples(phase: np.ndarray, amplitude: float, offset: float) -> np.ndarray:
    """c(tau_k) = B + A cos(phase - k pi / 2), eq. 2.3 sampled at quarter periods."""
    return np.array([offset + amplitude * np.cos(phase - k * np.pi / 2) for k in range(4)])


def test_demodulation_by_hand() -> None:
    """Sign convention of eq. 2.5 in all four quadrants: atan2(c1 - c3, c0 - c2), in [0, 2 pi)."""
    phase = np.array([0.0, 0.3, 1.9, 3.5, 5.9])
    found, amplitude, offset = demodulate(_samples(phase, 140.0, 900.0))
    np.testing.assert_allclose(found, phase, atol=1e-12)
    np.testing.assert_allclose(amplitude, 140.0, rtol=1e-12)
    np.testing.assert_allclose(offset, 900.0, rtol=1e-12)
    assert demodulate(np.array([[10.0], [7.0], [2.0], [1.0]]))[0][0] == pytest.approx(math.atan2(6, 8))
    assert demodulate(np.array([[2.0], [1.0], [10.0], [7.0]]))[0][0] == pytest.approx(
        math.atan2(6, 8) + math.pi
    )


def test_phase_lies_in_one_turn() -> None:
    found, _, _ = demodulate(np.array([[1.0], [-1e-300], [0.0], [0.0]]))
    assert 0 <= found[0] < TURN


def test_sampling_interval_lowers_the_amplitude_and_leaves_the_phase() -> None:
    """Means over dt = 0.4 T, integrated numerically; eqs. 2.6, 2.7 with delta = pi dt / T."""
    phase, share = np.array([0.7, 4.4]), 0.4
    t = (np.arange(20_000) + 0.5) / 20_000 - 0.5
    within = np.cos(phase[:, None] - TURN * share * t)
    quadrature = np.sin(phase[:, None] - TURN * share * t)
    samples = 500 + 80 * np.array([within.mean(1), quadrature.mean(1), -within.mean(1), -quadrature.mean(1)])
    raw = demodulate(samples)
    np.testing.assert_allclose(raw[0], phase, atol=1e-9)
    np.testing.assert_allclose(raw[1], 80 * math.sin(math.pi * share) / (math.pi * share), rtol=1e-8)
    np.testing.assert_allclose(demodulate(samples, integration_share=share)[1], 80, rtol=1e-8)


def test_contrast_of_half_a_period() -> None:
    """Dt = T / 2 leaves 2 / pi of the amplitude."""
    _, amplitude, _ = demodulate(_samples(np.array([1.0]), 2 / math.pi, 5.0), integration_share=0.5)
    assert amplitude[0] == pytest.approx(1.0, rel=1e-12)


def test_demodulation_refuses() -> None:
    with pytest.raises(ValueError, match="four samples are needed, found 3"):
        demodulate(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"integration_share must lie in \[0, 1\), found 1"):
        demodulate(np.zeros((4, 2)), integration_share=1.0)


# --- harmonics ----------------------------------------------------------------------------------


def test_a_pure_sinusoid_has_no_error() -> None:
    phase = np.linspace(0, TURN, 97)
    assert np.abs(Waveform.sinusoid().phase_error(phase)).max() < 1e-12


@pytest.mark.parametrize("order", [2, 4, 6, 10])
def test_even_harmonics_leave_the_distance_alone(order: int) -> None:
    """Sec. 2.1.2.2."""
    phase = np.linspace(-1, 9, 211)
    error = Waveform(((order, 0.31 - 0.12j),)).phase_error(phase)
    assert np.abs(error).max() < 1e-12


def _sinusoid(error: np.ndarray, phase: np.ndarray, order: int) -> complex:
    """A of Im(a exp(i order phase)) = |a| sin(order phase + arg a), by projection."""
    return complex(2j * np.mean(error * np.exp(-1j * order * phase)))


PHASE = np.arange(720) * (TURN / 720)


@pytest.mark.parametrize("a3", [0.02, -0.03, 0.01 - 0.02j])
def test_third_harmonic_makes_four_periods_of_the_opposite_sign(a3: complex) -> None:
    """Samples see exp(3 i phi) turn backwards: exp(i phi) + conj(a3) exp(-3 i phi)."""
    error = Waveform(((3, a3),)).phase_error(PHASE)
    # Im(conj(a3) exp(-4 i phi)) = Im(-a3 exp(4 i phi)) up to a real part
    assert _sinusoid(error, PHASE, 4) == pytest.approx(-a3, abs=abs(a3) ** 3)
    assert _sinusoid(error, PHASE, 8) == pytest.approx(a3**2 / 2, abs=abs(a3) ** 3)
    for order in (1, 2, 3, 5, 6, 7):
        assert abs(_sinusoid(error, PHASE, order)) < 1e-12


@pytest.mark.parametrize("a7", [0.02, -0.013j])
def test_seventh_harmonic_makes_eight_periods(a7: complex) -> None:
    error = Waveform(((7, a7),)).phase_error(PHASE)
    assert _sinusoid(error, PHASE, 8) == pytest.approx(-a7, abs=abs(a7) ** 3)
    assert abs(_sinusoid(error, PHASE, 4)) < 1e-12


@pytest.mark.parametrize(("duty", "share"), [(0.5, 0.6), (0.35, 0.5), (0.3, 0.55), (0.42, 0.25)])
def test_square_wave_by_its_fourier_coefficients(duty: float, share: float) -> None:
    """Order 4 from harmonics 3 and 5, order 8 from 7 and 9 and from the squares of 3 and 5."""

    def coefficient(h: int) -> float:
        # numerically: the h-th coefficient of a centred pulse of width duty, averaged over a window of share
        t = (np.arange(100_000) + 0.5) / 100_000 - 0.5
        pulse = (np.abs(t) < duty / 2).astype(float)
        window = (np.abs(t) < share / 2).astype(float)
        return float(np.mean(pulse * np.cos(TURN * h * t)) * np.mean(window * np.cos(TURN * h * t)))

    a = {h: coefficient(h) / coefficient(1) for h in (3, 5, 7, 9)}
    error = Waveform.square(duty, integration_share=share, orders=9).phase_error(PHASE)
    third = 3 * max(abs(x) for x in a.values()) ** 3 + 2e-4
    four = a[5] - a[3] + a[5] * a[7] - a[3] * a[9]
    eight = a[9] - a[7] + (a[3] ** 2 - a[5] ** 2) / 2
    assert _sinusoid(error, PHASE, 4) == pytest.approx(four, abs=third)
    assert _sinusoid(error, PHASE, 8) == pytest.approx(eight, abs=third)


def test_square_wave_of_half_a_period_has_no_even_harmonics() -> None:
    strengths = dict(Waveform.square(0.5, orders=9).harmonics)
    assert strengths[3] == pytest.approx(-1 / 3)
    assert strengths[5] == pytest.approx(1 / 5)
    assert abs(strengths[2]) < 1e-15
    assert abs(strengths[8]) < 1e-15


def test_samples_of_a_waveform() -> None:
    found = Waveform(((3, 0.1j),)).samples(np.array([0.4]), np.array([7.0]))
    expected = [
        7 * (math.cos(0.4 - k * math.pi / 2) - 0.1 * math.sin(3 * (0.4 - k * math.pi / 2))) for k in range(4)
    ]
    assert found[:, 0].tolist() == pytest.approx(expected, abs=1e-12)


def test_waveforms_from_text() -> None:
    assert parse_waveform("sinusoid") == Waveform()
    assert parse_waveform("square") == Waveform.square(0.5)
    assert parse_waveform("square:0.35") == Waveform.square(0.35)
    assert parse_waveform("harmonics:3=0.1,5=-0.02j") == Waveform(((3, 0.1 + 0j), (5, -0.02j)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("triangle", r"unknown waveform 'triangle': sinusoid, square:DUTY or harmonics:3=0\.1,5=-0\.02"),
        ("square:1.2", r"waveform 'square:1\.2': duty cycle must lie between 0 and 1, found 1\.2"),
        ("square:wide", "waveform 'square:wide': could not convert"),
        ("harmonics:1=0.1", "waveform 'harmonics:1=0.1': a harmonic's order must be at least 2, found 1"),
        ("harmonics:3", "waveform 'harmonics:3': not enough values"),
        ("harmonics:", "unknown waveform"),
    ],
)
def test_texts_that_are_no_waveform(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_waveform(text)
