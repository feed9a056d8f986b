"""Ways of measuring: one frequency, or another type that is named by ``measurement`` of the camera file.

Outside of this package and `rim_camera_ros.devices` no code depends on the type of a camera; it uses the
interface `Measurement`.
"""

from __future__ import annotations

from rim_camera_ros.camera import Camera
from rim_camera_ros.measurement.base import (
    Change,
    FrameCorrection,
    FrameSimulation,
    Measurement,
    OneFrequency,
    Part,
)
from rim_camera_ros.measurement.gated import Gated
from rim_camera_ros.measurement.several_frequencies import SeveralFrequencies
from rim_camera_ros.measurement.single_photon import SinglePhoton

#: Types by their name in a camera file; each a frozen dataclass of the keys of the group ``measurement``.
TYPES: dict[str, type[Measurement]] = {
    measurement.type: measurement for measurement in (SeveralFrequencies, SinglePhoton, Gated)
}

_ORDINARY = OneFrequency()


def measurement_of(camera: Camera) -> Measurement:
    """Return the way of measuring of a camera."""
    found: Measurement = _ORDINARY if camera.measurement is None else camera.measurement
    return found


__all__ = ["TYPES", "Change", "FrameCorrection", "FrameSimulation", "Measurement", "Part", "measurement_of"]
