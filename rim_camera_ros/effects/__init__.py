"""The effects, in the order along the light, and the vocabulary that a diagnosis speaks.

Adding one: one file, one line in ``ORDER``, one page in docs. Other packages add theirs through the
entry-point group ``rim_camera_ros.effects`` (name = class); those follow the built-in ones.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.added_light import AddedLight
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.effects.base import ComplexEffect, DistanceTerm, Effect
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.gate_timing import GateTiming
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.interference import Interference
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.motion import Motion
from rim_camera_ros.effects.multipath import Multipath
from rim_camera_ros.effects.physics import Physics
from rim_camera_ros.effects.reference_path import (
    ReferencePath,
    ReferenceScale,
    estimate_reference_scale,
    mean_reading,
)
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Scattering
from rim_camera_ros.effects.sections import OF_SURFACES, OPTICS, SECTIONS
from rim_camera_ros.effects.signal import Context, Signal
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
    AddedLight,
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

#: Effects of a single way of measuring (`rim_camera_ros.measurement`), which act as those of ``ORDER`` do:
#: only files of such cameras may hold them.
PARTICULAR: tuple[type[Effect], ...] = (GateTiming,)


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


def known_effects() -> dict[str, type[Effect]]:
    """Return `registry`, followed by the effects of single ways of measuring."""
    return {**registry(), **{one.name: one for one in PARTICULAR}}


def effects_of(camera: Camera) -> dict[str, type[Effect]]:
    """Return the effects that a camera can have: `registry`, and others that its file holds."""
    known = registry()
    return {**known, **{name: type(effect) for name, effect in camera.effects.items() if name not in known}}


def vocabulary() -> dict[str, type[Physics]]:
    """Return all names of the vocabulary: the effects, then sections that are no effects."""
    return {**known_effects(), **SECTIONS}


def without_poses() -> list[str]:
    """Return by name the effects that change with time or setting, so that one pose identifies them."""
    return sorted(name for name, effect in registry().items() if effect.from_one_pose)


#: Roles that a fit, a correction or a report needs an effect for, whatever it is called: an offset per pixel,
#: which is a nuisance of every fit; an offset per setting; a smooth function of covariates, which stands for
#: unknown physics; errors by position instead of physics; unmodulated light; light of a second camera; a
#: reading of an internal path; sinusoids of the phase; light that is spread, and another way out, which a
#: correction undoes fast; light that does not come from the scene.
PixelMap = FixedPatternOffset
SettingOffset = IntegrationTimeOffset
CovariateTable = Empirical
PositionTable = IntegralTable
UnmodulatedLight = BackgroundLight
ForeignLight = Interference
InternalReference = ReferencePath
HarmonicError = CyclicError
StrayLight = Scattering
EmitterPath = EmitterOffset
AdditionalLight = AddedLight

__all__ = [
    "OF_SURFACES",
    "OPTICS",
    "ORDER",
    "PARTICULAR",
    "SECTIONS",
    "AdditionalLight",
    "ComplexEffect",
    "Context",
    "CovariateTable",
    "DistanceTerm",
    "Effect",
    "EmitterPath",
    "ForeignLight",
    "Harmonic",
    "HarmonicError",
    "InternalReference",
    "Physics",
    "PixelMap",
    "PositionTable",
    "ReferenceScale",
    "SettingOffset",
    "Signal",
    "StrayLight",
    "UnmodulatedLight",
    "effects_of",
    "estimate_reference_scale",
    "known_effects",
    "mean_reading",
    "registry",
    "vocabulary",
    "without_poses",
]
