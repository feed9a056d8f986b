"""Sentences of effects whose numbers are negative."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.parameters import ArrayFile


def test_of_both_signs() -> None:
    # |a| / (A - b) is 50 mm at A = |a| / 0.05 + b
    assert (
        "too far, by 50 mm at 800 counts (setting 60)"
        in AmplitudeOffset({60.0: Hyperbola(40.0, 0.0)}).sentence()
    )
    assert (
        "too near, by 50 mm at 800 counts (setting 60)"
        in AmplitudeOffset({60.0: Hyperbola(-40.0, 0.0)}).sentence()
    )
    beyond_the_pole = AmplitudeOffset({1.0: Hyperbola(10.0, 200.0)}).sentence()
    assert "too far, by 50 mm at 400 counts (setting 1)" in beyond_the_pole
    # 4.6 / (92 + 158): with a negative pole, 50 mm would be at -66 counts
    below_zero = AmplitudeOffset({16.0: Hyperbola(4.6, -158.0)}).sentence()
    assert "too far, by 18 mm at 92 counts (setting 16)" in below_zero
    assert "too near, by 18 mm at 60 gon" in IncidenceAngle({60.0: (0.0, 0.0, 0.0, 3e-4)}).sentence()
    assert "too far, by 18 mm at 60 gon" in IncidenceAngle({60.0: (0.0, 0.0, 0.0, -3e-4)}).sentence()
    assert "too long by 1.1 mm per metre" in DistanceScale(0.0011).sentence()
    assert "too short by 1.1 mm per metre" in DistanceScale(-0.0011).sentence()


def test_an_error_that_is_the_same_everywhere_is_one() -> None:
    values = ArrayFile("table.npy", np.full((2, 2, 2), 0.03))
    knots = ((0.0, 40.0), (0.0, 30.0), (0.5, 4.0))
    assert "30.0 mm RMS" in IntegralTable(knots=knots, values=values).sentence()
