"""Optics that are known already: by a start, by a covariance, and what is written of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rim_camera_ros.camera import Covariance
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.photogrammetry import OPTICS_PARAMETERS, Observations, estimate_optics
from rim_camera_ros.photogrammetry.known_optics import prior_of, stated_optics, with_optics
from rim_camera_ros.photogrammetry.projection import OPTICS_PATHS, optics_of
from rim_camera_ros.photogrammetry.report import OpticsCovariance

from .helpers import SR3000, camera, field, seen, stations, vector

TRUE = vector(SR3000)
#: What a calibration of an SR-3000 leaves of each parameter: px and units of plumb_bob.
SIGMAS = np.array([0.3, 0.3, 0.4, 0.4, 0.01, 0.05, 0.0005, 0.0005, 0.2])


def weak(seed: int, count: int = 4) -> Observations:
    """Few stations of a coarse image, which tell little of the distortion."""
    rng = np.random.default_rng(seed)
    return seen(field(), stations(rng, count), rng, sigma=0.3)


def test_a_distortion_that_the_recording_does_not_tell_stays_as_it_is_known() -> None:
    optics, covariance, report = estimate_optics(weak(3), start=SR3000)
    left = {name for group in report.insignificant for name in group.parameters}
    assert {"k2", "k3", "p1", "p2"} <= left
    for name in left - {"fy"}:
        i = OPTICS_PARAMETERS.index(name)
        assert vector(optics)[i] == TRUE[i]
    wrong = vector(optics) - TRUE
    for path in covariance.parameters:
        assert abs(wrong[OPTICS_PATHS.index(path)]) < 3.5 * covariance.sigma(path)


def test_a_covariance_is_knowledge_in_addition_to_the_recording() -> None:
    """Of two independent measurements the mean is weighted by their inverse covariances."""
    rng = np.random.default_rng(8)
    factor = np.tril(rng.normal(0, 0.2, (9, 9)), -1) + np.eye(9)
    known = SIGMAS[:, None] * (factor @ factor.T) * SIGMAS
    start = optics_of(TRUE + SIGMAS * (factor @ rng.normal(size=9)))
    observations = weak(5, 12)
    alone, own, report = estimate_optics(observations, start=start, significance=None)
    prior = OpticsCovariance(OPTICS_PATHS, known)
    optics, covariance, both = estimate_optics(observations, start=start, known=prior)
    assert both.insignificant == ()
    inverse = np.linalg.inv(own.matrix), np.linalg.inv(known)
    expected = np.linalg.inv(inverse[0] + inverse[1])
    mean = expected @ (inverse[0] @ vector(alone) + inverse[1] @ vector(start))
    found = np.sqrt(np.diag(covariance.matrix))
    # the projection is not quite linear over the errors of weak observations
    assert np.abs((vector(optics) - mean) / found).max() < 0.2
    np.testing.assert_allclose(found, np.sqrt(np.diag(expected)), rtol=0.1)
    assert (found < 0.9 * np.sqrt(np.diag(known))).any()
    assert report.sigma_zero == pytest.approx(1.0, abs=0.15)
    assert not [note for note in both.notes if "depart" in note]


def test_a_lens_that_is_not_the_one_that_was_known_is_said() -> None:
    prior = OpticsCovariance(("optics.fx", "optics.fy", "optics.d.0"), np.diag([0.3, 0.3, 0.01]) ** 2)
    start = replace(SR3000, fx=190.0, fy=190.0)
    _, _, report = estimate_optics(weak(6, 12), start=start, known=prior)
    assert "by more than the covariance that it states" in report.notes[0]
    assert "if it is another lens or focus" in report.notes[0]


def test_parameters_that_are_stated_exactly_or_follow_others_have_no_prior() -> None:
    matrix = np.array([[0.04, 0.04, 0.0], [0.04, 0.04, 0.0], [0.0, 0.0, 0.0]])
    prior, names = prior_of(SR3000, OpticsCovariance(("optics.fx", "optics.fy", "optics.cx"), matrix))
    assert names == ("fx",)
    np.testing.assert_allclose(np.abs(prior.root), [[5.0, *np.zeros(8)]])


def test_effects_err_with_the_optics_as_far_as_these_follow_the_old_ones() -> None:
    """By Bayes: e = e0 + g (x0 - x), with a part of x that is measured anew with the same weight."""
    scale = "effects.distance_scale.scale"
    old = np.array([[4e-6, 1e-3], [1e-3, 1.0]])
    given = replace(camera(), covariance=Covariance((scale, "optics.fx"), ArrayFile("c.npy", old)))
    stated = stated_optics(given)
    assert stated is not None
    assert stated.sigma("optics.fx") == 1.0
    new = with_optics(given, SR3000, OpticsCovariance(("optics.fx", "optics.cx"), np.diag([0.5, 0.2])))
    assert new.covariance is not None
    assert new.covariance.parameters == ("optics.fx", "optics.cx", scale)
    # half of the new fx is the old one
    expected = [[0.5, 0.0, 0.5e-3], [0.0, 0.2, 0.0], [0.5e-3, 0.0, 4e-6]]
    np.testing.assert_allclose(new.covariance.matrix.values, expected, atol=1e-15)
