"""What a further effect must gain and move: forms that are not quite true leave rests like other effects."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, field

from rim_camera_ros.calibrate.exploration import Exploration
from rim_camera_ros.calibrate.mixed_candidates import footprint_of
from rim_camera_ros.calibrate.sizes import effect_size
from rim_camera_ros.effects.base import DistanceTerm, Effect
from rim_camera_ros.effects.mixed_pixels import MixedPixels

#: A further effect must gain this share of what the effects before it gained: more where it is of the kind
#: of one of them, whose form is never quite the true one and leaves such a rest.
LEAST_SHARE = 0.0015


LEAST_SHARE_OF_KIND = 0.05


#: ... and a good part of what one gained that heats and cools as it does: a thermal mass more than the form
#: has looks like the other.
LEAST_SHARE_OF_THERMAL = 0.25


#: ... and still more beside effects of which no form is near every true one: surfaces out of the view send
#: light as well.
LEAST_SHARE_BESIDE_ROUGH = 0.15


_ROUGH = {
    "multipath": frozenset(
        {"emitter_offset", "camera_constant", "lens_distortion", "distance_scale", "radiometry", "scattering"}
    ),
}


#: What heats and cools.
OF_TIME = frozenset({"warm_up_drift", "ambient_temperature"})
_KINDS = (
    frozenset({"scattering", "mixed_pixels", "multipath", "saturation_bleed"}),
    frozenset({"emission_pattern", "amplitude_nonlinearity", "emitter_offset", "radiometry", "scattering"}),
    frozenset({"cyclic_error", "distance_scale", "camera_constant", "lens_distortion", "emitter_offset"}),
    # where the rays go decides how much light a pixel gets of the pattern
    frozenset({"emission_pattern", "camera_constant", "lens_distortion"}),
    OF_TIME,
)


#: ... unless it changes whole poses, whose errors limit what it can gain.
LEAST_SHARE_OF_POSES = 0.0005


#: A further effect that does not change whole poses must gain this share of what stays unexplained: what the
#: form of a large effect leaves is like many others a little.
LEAST_SHARE_OF_UNEXPLAINED = 0.01


OF_POSES = frozenset({"warm_up_drift", "ambient_temperature", "integration_time_offset"})


#: Mixed pixels act within a pixel of edges. Smooth functions of distance, amplitude, angle or time leave no
#: rest there, whatever their form; these may.
_AT_EDGES = frozenset(
    {
        "amplitude_nonlinearity",
        "camera_constant",
        "lens_distortion",
        "motion",
        "multipath",
        "saturation_bleed",
        "scattering",
    }
)


#: It nearly changes whole poses; how far it moves distances tells it from the rest of another of its kind.
_OF_SIZE = frozenset({"distance_scale"})


#: What changes with distance in most recordings: a form in it leaves what looks like a scale of distance.
_FALLING = frozenset({"amplitude", "incidence"})


#: ... and share of what a curve of the distance gains beside another effect of it: a straight line is a part
#: of any curve.
_SHARE_OF_CURVE = 0.3


#: A further effect must move distances by this much somewhere [m] (RMS over the 5 % of pixels it moves most).
LEAST_SIZE = 0.0005


#: ... and these shares of what one of its kind, or any other, moves them: the rest that its form leaves.
LEAST_SIZE_OF_KIND = 0.15


LEAST_SIZE_OF_ALL = 0.07


#: What drifts depend on.
_OF_DRIFTS = {"warm_up_drift": {"time"}, "ambient_temperature": {"ambient_temperature", "temperature"}}


@dataclass
class Found:
    """An effect that joined: its gain in nats alone at that step, and which others explain it as well.

    ``step`` is the number of the exploration that it was found in.
    """

    effect: str
    gain: float
    ties: list[str] = field(default_factory=list)
    step: int = 0


def least_size(step: Exploration, chosen: Sequence[str], found: Sequence[Found]) -> float:
    """Return how far further effects must move distances [m]: more beside others of their kind."""
    mixed = step.fit.camera.effects.get("mixed_pixels")
    crossed = isinstance(mixed, MixedPixels) and mixed.footprint is not None
    found = _like(chosen, found, crossed=crossed)
    rivals = [
        one.effect
        for one in found
        for name in chosen
        if any(name in kind and one.effect in kind for kind in _KINDS)
    ]
    shares = {one.effect: LEAST_SIZE_OF_ALL for one in found}
    shares |= dict.fromkeys(rivals, LEAST_SIZE_OF_KIND)
    sizes = {name: effect_size(step.fit, [name], step.fit.start) for name in shares}
    return max([LEAST_SIZE, *(share * sizes[name] for name, share in shares.items())])


def _like(chosen: Sequence[str], found: Sequence[Found], *, crossed: bool) -> list[Found]:
    """Return those found whose form may leave a rest like what is chosen.

    ``crossed``: where mixed pixels are those alone that an edge crosses, no form does.
    """
    if set(chosen) != {"mixed_pixels"}:
        return list(found)
    return [] if crossed else [one for one in found if one.effect in _AT_EDGES]


def own_covariates(effect: Effect) -> frozenset[str]:
    """Return the covariates that a distance term of the vocabulary is a function of."""
    if not isinstance(effect, DistanceTerm):
        return frozenset()
    return frozenset({*effect.depends_on(), *_OF_DRIFTS.get(effect.name, ())})


def left_by_forms(step: Exploration, found: Sequence[Found], covariates: Set[str] | None = None) -> float:
    """Return the gain of the best smooth function of a covariate that an effect found depends on.

    Of some ``covariates`` alone where they are given.
    """
    effects = [step.fit.camera.effects.get(one.effect) for one in found]
    own = {name for one in effects if one is not None for name in own_covariates(one)}
    own = own if covariates is None else own & covariates
    smooth = range(step.named, len(step.candidates))
    return max([0.0, *(float(step.gains[k]) for k in smooth if step.candidates[k].variant in own)])


def needed(step: Exploration, number: int, found: Sequence[Found]) -> float:
    """Return what a candidate must gain [nats] after others were found.

    After two, more than a smooth function of what those depend on, which would say the same; a scale of
    distance more than one of amplitude or incidence after one, and a good part of one of distance.
    """
    effect = step.candidates[number].effect
    found = _like([effect], found, crossed=footprint_of(step.candidates[number]) is not None)
    share = LEAST_SHARE_OF_POSES if effect in OF_POSES else LEAST_SHARE
    need = share * sum(one.gain for one in found)
    for one in found:
        if effect not in _OF_SIZE and any(effect in kind and one.effect in kind for kind in _KINDS):
            need = max(need, LEAST_SHARE_OF_KIND * one.gain)
        if effect in OF_TIME and one.effect in OF_TIME:
            need = max(need, LEAST_SHARE_OF_THERMAL * one.gain)
        if effect in _ROUGH.get(one.effect, ()):
            need = max(need, LEAST_SHARE_BESIDE_ROUGH * one.gain)
    if found and effect not in OF_POSES:
        need = max(need, LEAST_SHARE_OF_UNEXPLAINED * step.unexplained)
    if effect in _OF_SIZE:
        of_distance = _SHARE_OF_CURVE * left_by_forms(step, found, frozenset({"distance"}))
        need = max(need, left_by_forms(step, found, _FALLING), of_distance)
    if len(found) > 1 and effect not in OF_POSES:
        need = max(need, left_by_forms(step, found))
    return max(float(step.thresholds[number]), need)
