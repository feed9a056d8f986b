"""Distances that a driver's depth along the axis was turned into by other optics than the driver's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.search import search

from .helpers import camera, record, scene

SHIFT = (3.1, -4.6)


def test_the_term_is_that_of_a_driver_with_another_principal_point(tmp_path: Path) -> None:
    """Depth by the driver's pinhole, distance by ours; the test's camera has no distortion."""
    stated = camera(tmp_path)
    distance = np.linspace(0.7, 3.9, 44 * 36).reshape(36, 44)
    rows, columns = np.mgrid[:36, :44]

    def length(cx: float, cy: float) -> np.ndarray:
        return np.asarray(np.sqrt(1 + ((columns - cx) / 50.0) ** 2 + ((rows - cy) / 50.0) ** 2))

    depth = distance / length(21.7 + 3.1, 17.4 - 4.6)
    converted = depth * length(21.7, 17.4)
    light = Signal(distance, np.full(distance.shape, 900.0))
    after = DistanceScale(0.0, SHIFT).simulate(light, Context(stated))
    assert after.measured == pytest.approx(converted, abs=1e-9)
    assert np.ptp(after.measured - distance) > 0.1


def test_the_search_finds_it(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(camera(tmp_path, DistanceScale(0.004, SHIFT)), board, poses=16, seed=4)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    result = search(Problem(data, board), stated, facts)
    assert [one.effect for one in result.found] == ["distance_scale"]
    fitted = result.fit
    for path, true in zip(("scale", "principal_point.0", "principal_point.1"), (0.004, *SHIFT), strict=True):
        path = f"effects.distance_scale.{path}"
        assert abs(fitted.parameters[path] - true) < 3.5 * fitted.sigma[path], path
        assert fitted.sigma[path] < 0.5
