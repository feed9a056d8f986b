"""Which effects there are, and the scenes in which each can be seen at all."""

from . import electronics, lighting, multipath, optics, outside, thermal
from .base import LeftOut

VOCABULARY: dict[str, type[LeftOut]] = {
    effect.name: effect
    for module in (electronics, thermal, lighting, optics, multipath)
    for effect in module.EFFECTS
}
OUTSIDE: dict[str, type[LeftOut]] = {effect.name: effect for effect in outside.EFFECTS}
TIERS = ("plain", "masked", "cancelled", "confounded", "two", "unknown", "null")
CONFOUNDED = ("warm_up_drift", "ambient_temperature", "distance_scale")
STRENGTHS = (0.25, 3.0)

SCENES_FOR: dict[str, tuple[str, ...]] = {
    "scattering": ("rich", "board"),
    "amplitude_offset": ("rich", "board", "whitedist", "corner"),
    "incidence_angle": ("rich", "whitedist", "corner", "board"),
    "warm_up_drift": ("rich", "whitedist", "board", "corner"),
    "ambient_temperature": ("rich", "whitedist", "board", "corner"),
    "cyclic_error": ("rich", "whitedist", "sweep", "board", "corner"),
    "mixed_pixels": ("rich", "board"),
    "emission_pattern": ("rich", "whitedist", "board", "sweep"),
    "emitter_offset": ("rich", "whitedist", "board"),
    "integration_time_offset": ("rich", "board", "corner"),
    "distance_scale": ("rich", "whitedist", "board", "sweep"),
    "saturation_bleed": ("rich",),
    "multipath": ("corner",),
    "background_light": ("rich", "board"),
    "interference": ("rich", "whitedist", "board"),
    "motion": ("passage",),
    "amplitude_nonlinearity": ("rich", "whitedist", "board", "sweep"),
    "radiometry": ("rich", "whitedist", "corner"),
    "noise": ("rich", "whitedist", "board", "corner"),
    "column_ripple": ("rich", "board", "sweep"),
    "height": ("rich", "whitedist", "board"),
    "row_amplitude": ("rich", "board"),
    "beat_in_time": ("rich", "whitedist", "board"),
    "row_readout_memory": ("rich", "board"),
    "temperature_pattern": ("rich", "whitedist", "board"),
    "local_contrast": ("rich", "board"),
    "missing_codes": ("rich", "whitedist", "sweep"),
}
NULL_SCENES = ("rich", "whitedist", "sweep", "corner", "board", "passage")

PAIRED = (
    "scattering",
    "amplitude_offset",
    "incidence_angle",
    "warm_up_drift",
    "ambient_temperature",
    "cyclic_error",
    "mixed_pixels",
    "emitter_offset",
    "distance_scale",
)
"""Effects of which two are left out at once."""

MASKABLE = tuple(
    name for name in VOCABULARY if name not in ("noise", "amplitude_nonlinearity", "interference", "motion")
)
"""Effects that known terms can absorb part of."""


def common_scenes(names: tuple[str, ...]) -> tuple[str, ...]:
    """Scenes in which all of these can be seen."""
    return tuple(scene for scene in SCENES_FOR[names[0]] if all(scene in SCENES_FOR[name] for name in names))
