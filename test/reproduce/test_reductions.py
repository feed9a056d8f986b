"""The reductions recover numbers that are known from elsewhere: analytic cases and the thesis' own tables."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.stats import norm

from rim_camera_ros.errors import RimError
from rim_camera_ros.reproduce import reductions as reduce
from rim_camera_ros.reproduce.incidence import TABLE_3_5
from rim_camera_ros.reproduce.precision import TABLE_3_3
from rim_camera_ros.reproduce.principles import wrapping
from rim_camera_ros.reproduce.results import Printed, Row
from rim_camera_ros.reproduce.targets import TABLE_3_4

L = 7.49481145


# --- statistics ------------------------------------------------------------------------------------


def test_a_histogram_gives_the_gaussian_of_table_3_3() -> None:
    """Quantiles of a normal distribution: c = sqrt(2) sigma, widened by the bins' variance w^2 / 12."""
    sigma, width = 0.02636, 0.005
    values = norm(2.557, sigma).ppf((np.arange(7957) + 0.5) / 7957)
    fitted = reduce.fit_histogram(values, bin_width=width)
    assert fitted.b == pytest.approx(2.557, abs=2e-4)
    assert fitted.sigma == pytest.approx(math.sqrt(sigma**2 + width**2 / 12), rel=2e-3)
    # the table's own height with its own number of values and width: bins of 5 mm
    assert fitted.a == pytest.approx(612.8, rel=0.02)
    assert fitted.determination > 0.9999


def test_a_histogram_of_one_value_is_refused() -> None:
    with pytest.raises(RimError, match=r"1 occupied bins cannot be fitted \(give narrower bins\)"):
        reduce.fit_histogram(np.full(50, 1.5), bin_width=0.01)


def test_noise_floors_of_table_3_3() -> None:
    """The floors that belong to the table: 4.6 and 3.9 mm."""
    for name, floor in (("sr3000", 4.6e-3), ("sr2", 3.9e-3)):
        sigma = np.array(TABLE_3_3[name]) / math.sqrt(2)
        assert reduce.fit_noise((16, 60, 100), sigma).floor == pytest.approx(floor, abs=5e-5)


def test_noise_model_is_recovered() -> None:
    amplitude = np.geomspace(60, 12000, 9)
    fitted = reduce.fit_noise(amplitude, np.hypot(0.0031, 17.3 / amplitude))
    assert fitted.floor == pytest.approx(0.0031, rel=1e-6)
    assert fitted.slope == pytest.approx(17.3, rel=1e-6)


# --- amplitude, angle of incidence -----------------------------------------------------------------


@pytest.mark.parametrize("setting", TABLE_3_4)
def test_hyperbola_of_table_3_4(setting: int) -> None:
    a, b = TABLE_3_4[setting]
    amplitude = np.geomspace(70, 9000, 15)
    found = reduce.fit_hyperbola(
        amplitude, a / (amplitude - b) + 2.287, distance_sigma=0.002, amplitude_sigma=0.5
    )
    assert (found.a, found.b, found.c) == pytest.approx((a, b, 2.287), rel=1e-5)
    at = np.array([b - 3.0, b + 250.0])
    np.testing.assert_allclose(found.offset(at), [np.nan, a / 250.0], rtol=1e-4)


def test_hyperbola_states_its_errors() -> None:
    """Over 200 draws the deviations agree with the sigmas: errors of both coordinates count."""
    rng = np.random.default_rng(11)
    amplitude = np.geomspace(100, 3000, 16)
    normalised = []
    for _ in range(200):
        seen = amplitude + rng.normal(0, 1.5, 16)
        distance = 237.0 / (amplitude - 15.71) + rng.normal(0, 0.004, 16)
        one = reduce.fit_hyperbola(seen, distance, distance_sigma=0.004, amplitude_sigma=1.5)
        normalised.append(((one.a - 237.0) / one.a_sigma, (one.b - 15.71) / one.b_sigma))
    spread = np.std(normalised, axis=0)
    np.testing.assert_allclose(spread, 1.0, atol=0.15)


@pytest.mark.parametrize("setting", TABLE_3_5)
def test_polynomial_of_table_3_5(setting: int) -> None:
    gon = np.arange(0.0, 81.0, 10.0)
    a = TABLE_3_5[setting]
    by_hand = a[0] * gon**4 + a[1] * gon**3 + a[2] * gon**2 + a[3] * gon
    np.testing.assert_allclose(reduce.quartic(gon, a), by_hand, rtol=1e-12)
    np.testing.assert_allclose(reduce.fit_quartic(gon, by_hand), a, rtol=1e-7)


def test_angles_are_folded_and_lonely_ones_go() -> None:
    gon, folded = reduce.fold_angles([-20, -10, 0, 10, 20, 30], [5.0, 1.0, 7.0, 2.0, np.nan, 3.0])
    np.testing.assert_array_equal(gon, [0.0, 10.0])
    np.testing.assert_array_equal(folded, [7.0, 1.5])


# --- linearity -------------------------------------------------------------------------------------


def test_a_sinusoid_with_offset_and_slope_is_recovered() -> None:
    d = np.arange(0.3, 7.31, 0.05)
    error = 0.3 - 0.004 * d + 0.081 * np.sin(4 * 2 * np.pi / L * d + 2.5)
    error[[3, 40]] = np.nan
    fitted = reduce.fit_cyclic(d, error, ambiguity=L)
    assert (fitted.offset, fitted.slope) == pytest.approx((0.3, -0.004), abs=1e-9)
    assert (fitted.amplitude, fitted.phase) == pytest.approx((0.081, 2.5), abs=1e-9)
    assert fitted.rms < 1e-12
    np.testing.assert_allclose(fitted.cyclic(np.array([0.0]), L), [0.081 * math.sin(2.5)], atol=1e-9)
    assert reduce.strongest_order(d, error, ambiguity=L, orders=range(1, 9)) == 4


def test_phase_and_amplitude_state_their_errors() -> None:
    rng = np.random.default_rng(5)
    d = np.arange(1.46, 3.97, 0.1)
    normalised = []
    for _ in range(200):
        error = 0.05 * np.sin(4 * 2 * np.pi / L * d - 0.7) + rng.normal(0, 0.003, d.size)
        one = reduce.fit_cyclic(d, error, ambiguity=L)
        normalised.append(((one.amplitude - 0.05) / one.amplitude_sigma, (one.phase + 0.7) / one.phase_sigma))
    np.testing.assert_allclose(np.std(normalised, axis=0), 1.0, atol=0.2)
    np.testing.assert_allclose(np.mean(normalised, axis=0), 0.0, atol=0.25)


def test_a_long_wave_is_not_taken_for_the_strongest() -> None:
    """A line with a bend has a large first order in addition to its slope, but order 4 leaves less."""
    d = np.arange(0.5, 7.3, 0.05)
    error = 0.1 * d + 0.003 * (d - 3.9) ** 2 + 0.08 * np.sin(4 * 2 * np.pi / L * d + 0.3)
    assert reduce.fit_cyclic(d, error, ambiguity=L, order=1).amplitude > 0.01
    assert reduce.strongest_order(d, error, ambiguity=L, orders=range(1, 9)) == 4


def test_too_few_distances_are_refused() -> None:
    with pytest.raises(RimError, match=r"cannot be fitted to 5 points \(measure more distances\)"):
        reduce.fit_cyclic(np.arange(5.0), np.ones(5), ambiguity=L)


def test_a_plane_is_recovered() -> None:
    row, column = np.array([10, 10, 71, 130, 110.0]), np.array([10, 160, 87, 15, 87.0])
    values = 0.4 + 0.003 * row - 0.0021 * column
    plane = reduce.fit_plane(row, column, values, np.array([0.1, 0.2, 0.1, 0.3, 0.1]))
    assert (plane.constant, plane.by_row, plane.by_column) == pytest.approx((0.4, 0.003, -0.0021))
    assert float(plane.at(143, 175)) == pytest.approx(0.4 + 0.429 - 0.3675)
    assert plane.rms < 1e-12


# --- drifts, counts --------------------------------------------------------------------------------


def test_an_exponential_settles_after_tau_log() -> None:
    """80 mm with 180 s: 1 mm is left after 180 ln 80 = 788.8 s."""
    time = np.arange(0.0, 2400.0, 5.0)
    drift = -0.08 * np.exp(-time / 180.0)
    assert reduce.settled_after(time, drift, final=0.0, tolerance=1e-3) == pytest.approx(788.8, abs=0.1)
    assert reduce.settled_after(time, drift, final=0.0, tolerance=0.1) == 0.0
    assert math.isnan(reduce.settled_after(time, drift, final=0.5, tolerance=0.1))


def test_moving_mean_keeps_a_line_inside_and_the_mean_at_the_ends() -> None:
    np.testing.assert_allclose(reduce.moving_mean([1.0, 2.0, 4.0, 8.0], 3), [1.5, 7 / 3, 14 / 3, 6.0])


def test_half_range_and_root_mean_square_leave_out_nan() -> None:
    assert reduce.half_range([3.0, np.nan, -2.0]) == 2.5
    assert reduce.root_mean_square([3.0, np.nan, -4.0]) == pytest.approx(math.sqrt(12.5))


def test_counts_that_wrap_give_range_and_size() -> None:
    distance = np.arange(0.5, 8.5, 0.07)
    counts = np.mod(distance, 6.2) / 6.2 * 4096 + 11.0
    assert wrapping(distance, counts) == pytest.approx((6.2, 6.2 / 4096), rel=1e-9)


# --- rows ------------------------------------------------------------------------------------------


def test_deviation_from_a_number_a_range_and_a_bound() -> None:
    assert Printed.number(26.4).deviation(27.0) == pytest.approx(0.6)
    assert Printed.number(26.4).deviation(26.0) == pytest.approx(-0.4)
    assert Printed(5.0, 10.0, "5-10").deviation(7.0) == 0.0
    assert Printed(5.0, 10.0, "5-10").deviation(4.5) == -0.5
    assert Printed(5.0, 10.0, "5-10").deviation(12.0) == 2.0
    assert Printed(40.0, math.inf, "better than 40").deviation(49.9) == 0.0


def test_what_cannot_be_reproduced_has_no_deviation() -> None:
    assert Row("pitch", "table 2.2", Printed.number(40.0), None, "um", "no").deviation is None
    assert Row("x", "table 2.2", Printed.number(40.0), math.nan, "um", "no").deviation is None


def test_tolerance_is_a_tenth_of_what_is_printed_or_two_sigmas() -> None:
    def row(printed: Printed, ours: float | None, sigma: float | None = None) -> Row:
        return Row("q", "s", printed, ours, "mm", "how", sigma=sigma)

    assert row(Printed.number(26.4), 29.0).within_tolerance is True
    assert row(Printed.number(26.4), 29.1).within_tolerance is False
    assert row(Printed.number(26.4), 29.1, 1.4).within_tolerance is True
    assert row(Printed.number(-26.4), -23.8).within_tolerance is True
    # of a range the end that is nearer
    assert row(Printed(40.0, 50.0, "40-50"), 36.5).within_tolerance is True
    assert row(Printed(40.0, 50.0, "40-50"), 54.5).within_tolerance is True
    assert row(Printed(40.0, 50.0, "40-50"), 35.5).within_tolerance is False
    assert row(Printed(40.0, math.inf, "better than 40"), 36.1).within_tolerance is True
    assert row(Printed(40.0, math.inf, "better than 40"), 35.9).within_tolerance is False
    assert row(Printed.number(0.0), 0.1).within_tolerance is False
    assert row(Printed.number(1.0), None).within_tolerance is None
    assert json.dumps(row(Printed.number(1.0), np.float64(1.2)).within_tolerance) == "false"
