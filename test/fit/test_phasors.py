"""Priors of sinusoids: of a phasor, whatever amplitude and phase a fit has come to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.steps import of_phasors

from ..calibrate.helpers import camera, record, scene

AMPLITUDE, PHASE = (f"effects.cyclic_error.harmonics.0.{one}" for one in ("amplitude", "phase"))
OTHER = "effects.cyclic_error.gradient.0"

sizes = st.floats(1e-6, 0.05)
angles = st.floats(-6.0, 6.0)


def pair(size: float, turn: float, begun: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the prior and its 1-sigma, of amplitude and phase."""
    regressors = [
        Regressor(OTHER, "cyclic_error", 0.3),
        Regressor(AMPLITUDE, "cyclic_error", sigma),
        Regressor(PHASE, "cyclic_error", 1.0),
    ]
    away = np.array([0.7, size - begun, turn])
    found, moved = of_phasors(regressors, away, {OTHER: 0.9, AMPLITUDE: size, PHASE: 0.4})
    assert (found[0].prior, moved[0]) == (0.3, 0.7)
    assert away[1] == size - begun
    return moved[1:], np.array([one.prior for one in found[1:]])


@given(size=sizes, turn=angles, begun=sizes, sigma=st.floats(0.001, 0.02))
def test_the_prior_is_that_of_the_phasor(size: float, turn: float, begun: float, sigma: float) -> None:
    moved, prior = pair(size, turn, begun, sigma)
    off = abs(size * np.exp(1j * turn) - begun)
    assert np.sum((moved / prior) ** 2) == pytest.approx((off / sigma) ** 2, rel=1e-6, abs=1e-9)


@given(size=st.floats(0.001, 0.05), turn=angles, begun=sizes)
def test_its_slope_too(size: float, turn: float, begun: float) -> None:
    def half_square(size: float, turn: float) -> float:
        return 0.5 * float(abs(size * np.exp(1j * turn) - begun) / 0.005) ** 2

    moved, prior = pair(size, turn, begun, 0.005)
    step = 1e-7
    by_size = (half_square(size + step, turn) - half_square(size - step, turn)) / (2 * step)
    by_turn = (half_square(size, turn + step) - half_square(size, turn - step)) / (2 * step)
    scale = half_square(size, turn) + 1.0
    assert moved[0] / prior[0] ** 2 == pytest.approx(by_size, abs=1e-3 * scale / size)
    assert moved[1] / prior[1] ** 2 == pytest.approx(by_turn, abs=1e-3 * scale)


def test_a_turn_by_pi_where_an_amplitude_goes_through_nothing_costs_nothing() -> None:
    before, after = (pair(size, turn, 1e-5, 0.005) for size, turn in ((1e-6, 0.2), (1e-6, 0.2 + np.pi)))
    cost = [float(np.sum((moved / prior) ** 2)) for moved, prior in (before, after)]
    assert cost == pytest.approx([0.0, 0.0], abs=1e-4)


def test_an_amplitude_of_nothing_has_a_finite_prior() -> None:
    moved, prior = pair(0.0, 0.3, 0.002, 0.005)
    assert np.all(np.isfinite(moved) & np.isfinite(prior))


def test_a_small_harmonic_of_the_file_may_have_any_phase(tmp_path: Path) -> None:
    plain, board = camera(tmp_path), scene(tmp_path)

    def by(amplitude: float, phase: float) -> CyclicError:
        return CyclicError(harmonics=(Harmonic(4, 0.007, 0.6), Harmonic(8, amplitude, phase)))

    true, stated = by(0.004, -0.9), by(1e-5, 2.2)
    data = record(with_effects(plain, {true.name: true}), board, poses=16, seed=6)
    fitted = fit(Problem(data, board), with_effects(plain, {stated.name: stated}))
    assert fitted.converged
    found = fitted.camera.effects["cyclic_error"]
    assert isinstance(found, CyclicError)
    phasors = [h.amplitude * np.exp(1j * h.phase) for h in found.harmonics]
    for one, i in zip(phasors, (0, 1), strict=True):
        there = true.harmonics[i]
        sigma = fitted.sigma[f"effects.cyclic_error.harmonics.{i}.amplitude"]
        assert abs(one - there.amplitude * np.exp(1j * there.phase)) < 4 * sigma
        assert sigma < 0.001


def test_what_is_found_does_not_depend_on_the_phase_of_a_harmonic_of_nothing(tmp_path: Path) -> None:
    plain, board = camera(tmp_path), scene(tmp_path)
    true = CyclicError(harmonics=(Harmonic(4, 0.007, 0.6),))
    data = record(with_effects(plain, {true.name: true}), board, poses=16, seed=3)
    found = []
    for phase in (2.2, 0.6, -1.3):
        stated = CyclicError(harmonics=(Harmonic(4, 0.0072, 0.4), Harmonic(8, 1e-6, phase)))
        fitted = fit(Problem(data, board), with_effects(plain, {stated.name: stated}), tolerance=0.01)
        last = fitted.camera.effects["cyclic_error"]
        assert isinstance(last, CyclicError)
        found.append(last.harmonics[1].amplitude * np.exp(1j * last.harmonics[1].phase))
    assert found[1:] == pytest.approx([found[0]] * 2, abs=3e-6)
