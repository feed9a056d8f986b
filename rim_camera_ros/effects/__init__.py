"""The effects, in the order along the light, and the vocabulary that a diagnosis speaks.

Adding one: one file, one line in ``ORDER``, one page in docs. Other packages add theirs through the
entry-point group ``rim_camera_ros.effects`` (name = class); those follow the built-in ones.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.effects.base import (
    ComplexEffect,
    Context,
    DistanceTerm,
    Effect,
    Signal,
)
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.interference import Interference
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.motion import Motion
from rim_camera_ros.effects.multipath import Multipath
from rim_camera_ros.effects.reference_path import ReferencePath
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Scattering
from rim_camera_ros.effects.warm_up_drift import WarmUpDrift

#: Emission, scene, optics (on the complex image); demodulation, electronics, drift (terms that add up);
#: read-out. Lens distortion is in the rays; noise and quantisation follow in `rim_camera_ros.pipeline`.
ORDER: tuple[type[Effect], ...] = (
    EmissionPattern,
    EmitterOffset,
    Multipath,
    Motion,
    MixedPixels,
    Scattering,
    Interference,
    CyclicError,
    BackgroundLight,
    AmplitudeOffset,
    IncidenceAngle,
    IntegrationTimeOffset,
    FixedPatternOffset,
    SaturationBleed,
    WarmUpDrift,
    AmbientTemperature,
    DistanceScale,
    IntegralTable,
    Empirical,
    ReferencePath,
    AmplitudeNonlinearity,
)

#: Names of the vocabulary that have no parameters under ``effects``: section of the camera file by name.
SECTIONS = {
    "lens_distortion": "optics",
    "camera_constant": "optics",
    "noise": "noise",
    "radiometry": "radiometry",
}


@cache
def registry() -> dict[str, type[Effect]]:
    """Return all effects by name in the order in which they act, those of other packages last."""
    found = {one.name: one for one in ORDER}
    for entry in entry_points(group="rim_camera_ros.effects"):
        effect = entry.load()
        if not (isinstance(effect, type) and issubclass(effect, Effect)):
            raise TypeError(f"entry point {entry.name} of rim_camera_ros.effects is not an Effect")
        if effect.name in found:
            raise TypeError(
                f"entry point {entry.name} of rim_camera_ros.effects: name '{effect.name}' is taken"
            )
        found[effect.name] = effect
    return found


__all__ = [
    "ORDER",
    "SECTIONS",
    "ComplexEffect",
    "Context",
    "DistanceTerm",
    "Effect",
    "Signal",
    "registry",
]
