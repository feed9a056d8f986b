"""The section on amplitudes where no surface says how much light it reflects."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np

from rim_camera_ros.reports.diagnosis.sections import _brightness


def test_surfaces_of_unknown_reflectivity_have_no_picture_and_no_warning() -> None:
    nothing = np.full((6, 7), np.nan)
    found: Any = SimpleNamespace(brightness_before=nothing, brightness_after=nothing)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _brightness(found) == []
    some = np.where(np.arange(7) < 4, 0.08, np.nan) * np.ones((6, 1))
    found = SimpleNamespace(brightness_before=some, brightness_after=some / 10)
    assert len(_brightness(found)) == 1
