"""Curves of effects with the band that the covariance of their parameters makes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import with_numbers
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.errors import InputError
from rim_camera_ros.reports.curves import effect_panels
from test.calibrate.helpers import camera


def test_a_band_where_one_side_is_no_possible_camera(tmp_path: Path) -> None:
    path = "effects.emission_pattern.falloff.0"
    # at the corner most light is gone, and nearly all a pixel beside it: a little more and there is none
    plain = camera(tmp_path)
    corner = float(np.nanmax(np.arccos(plain.rays[..., 2])) ** 2)
    dim = camera(tmp_path, EmissionPattern((-0.92 / corner, 0.0)))
    with pytest.raises(InputError, match="falloff must leave the relative power positive"):
        with_numbers(dim, {path: -0.98 / corner})
    sigma = 0.1
    (panel,) = effect_panels(dim, [path], np.array([[sigma**2]]))
    curve = panel.curves[0]
    assert curve.sigma is not None
    # power in percent: 1 + f1 q, of which f1 makes q
    np.testing.assert_allclose(curve.sigma, 100 * sigma * np.radians(curve.x) ** 2, rtol=1e-6, atol=1e-9)


def test_the_angle_of_incidence_is_drawn_in_degrees(tmp_path: Path) -> None:
    """The polynomial is of gon: a slope of 1 mm per gon is 60 mm at 54 degrees."""
    effect = IncidenceAngle({60.0: (0.0, 0.0, 0.0, 0.001)})
    (panel,) = effect_panels(camera(tmp_path, effect), [], np.zeros((0, 0)))
    (curve,) = panel.curves
    assert panel.x == "angle [deg]"
    assert np.interp(54.0, curve.x, curve.y) == pytest.approx(-60.0, rel=1e-6)
