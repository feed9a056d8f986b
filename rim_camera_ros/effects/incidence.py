"""Terms of the angle of incidence alone, which the correction tabulates over it."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.signal import Context, Image


@dataclass(frozen=True)
class IncidenceTerm(DistanceTerm):
    """A distance term that depends on the setting and on the angle between ray and normal alone."""

    @abstractmethod
    def at(self, gon: Image, context: Context) -> Image | float:
        """Return the term in metres at angles in gon."""


def incidence_gon(angle: Image) -> Image:
    """Return min(|angle|, 90 gon) in gon for an angle in rad (400 gon = 360 degrees)."""
    result: Image = np.minimum(np.abs(angle) * (200.0 / np.pi), 90.0)
    return result
