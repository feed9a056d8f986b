"""Priors are about the camera file, whatever a fit begins at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_numbers
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.steps import moved_from
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene

HYPERBOLA = AmplitudeOffset(MappingProxyType({t: Hyperbola(9.0, 1.2) for t in (16.0, 60.0, 100.0)}))
CYCLIC = CyclicError((Harmonic(4, 0.011, 0.7),))


def test_a_fit_ends_at_the_same_place_wherever_it_begins(tmp_path: Path) -> None:
    """Of few poses the pole of a hyperbola is known little better than its prior says (1.2 counts)."""
    stated = camera(tmp_path, CYCLIC, HYPERBOLA)
    board = scene(tmp_path)
    data = record(stated, board, poses=6, frames=2, seed=4)
    path = "effects.amplitude_offset.hyperbola.100.b"
    elsewhere = with_numbers(stated, {path: 6.0, "effects.cyclic_error.harmonics.0.phase": 1.3})
    problem = Problem(data, board)
    about_file = [fit(replace(problem, origin=stated), one) for one in (stated, elsewhere)]
    about_start = fit(problem, elsewhere)
    first, second = (one.parameters for one in about_file)
    sigma = about_file[0].sigma
    assert sigma[path] > 0.6
    for name, value in first.items():
        assert second[name] == pytest.approx(value, abs=0.1 * sigma[name]), name
    assert abs(about_start.parameters[path] - first[path]) > 0.5 * sigma[path]


def test_distances_from_the_file_are_by_the_shortest_turn(tmp_path: Path) -> None:
    stated = camera(tmp_path, CyclicError((Harmonic(4, 0.011, 3.0),)), HYPERBOLA)
    phase = "effects.cyclic_error.harmonics.0.phase"
    start = with_numbers(stated, {phase: 3.0 + 0.4 - 2 * np.pi, "optics.fx": 51.5, "radiometry.gain": 99.0})
    start = replace(start, effects={**start.effects, "integration_time_offset": offsets(0.03)})
    moved = moved_from(stated, start)
    # what the file does not have, and the power of the light, have priors of their own
    assert moved == pytest.approx({phase: 0.4, "optics.fx": 1.5})
    assert moved_from(None, start) == moved_from(start, start) == {}


def offsets(first: float) -> IntegrationTimeOffset:
    return IntegrationTimeOffset(MappingProxyType({16.0: first, 60.0: -0.25 * first, 100.0: -0.7 * first}))


def test_what_known_terms_had_taken_up_goes_back_to_the_effect(tmp_path: Path) -> None:
    """The hyperbola of one setting takes up much of an offset of that setting, while that is unknown.

    The differences of the offsets are determined; a constant in all of them is one of the pixels.
    """
    known: Camera = camera(tmp_path, CYCLIC, HYPERBOLA)
    true = camera(tmp_path, CYCLIC, HYPERBOLA, offsets(0.03))
    board = scene(tmp_path)
    data = record(true, board, poses=9, frames=3, seed=6)
    facts = Facts.of(data, moves=False, surfaces=1, camera=known)
    result = search(Problem(data, board), known, facts, effects=["integration_time_offset"], most=1)
    assert [one.effect for one in result.found] == ["integration_time_offset"]
    ended = fit(replace(result.problem, origin=known, robust=False), true)
    for name, value in ended.parameters.items():
        assert result.fit.parameters[name] == pytest.approx(value, abs=0.5 * ended.sigma[name]), name
