"""The evidence of the noise of repeated frames in a verdict: unmodulated light, another noise."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added, with_effects
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.described import Rest
from rim_camera_ros.diagnose.result import Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.diagnose.variance import Variance
from rim_camera_ros.effects import AdditionalLight, CovariateTable, UnmodulatedLight, vocabulary
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.sections import NoiseSection
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.exploration import Exploration

_NOISE = NoiseSection.name
#: Effects that may be named by repeated frames alone, though no distance moves.
OF_NOISE = frozenset(name for name, effect in vocabulary().items() if effect.shows_in == "noise")
#: Relative deviation of the variance below which it may be due to light that no named physics predicts.
_OF_UNKNOWN_LIGHT = 0.2
#: Covariates that correlate with the light of a surface.
_OF_LIGHT = frozenset({"amplitude", "distance", "contrast"})
#: Share of the likelihood [nats] lost by too small a noise below which other differences count as the shift
#: that comes with the unmodulated light which makes the noise.
_SHIFT_OF_BACKGROUND = 0.02
#: Ratio of gains up to which a scale of distance counts as a smooth function of the light.
_AS_SCALE = 1.25


def with_variance(
    verdict: str,
    missing: list[Missing],
    model: Camera,
    variance: Variance,
    ties: list[list[str]],
    shifted: bool,
    known: Set[str] = frozenset(),
) -> tuple[str, list[Missing], Camera]:
    """Add the evidence of repeated frames: unmodulated light, or another noise than that of the file.

    Unmodulated light is named only where distances are ``shifted`` as well; otherwise it is another noise.
    Noise depends on the light: where the light is unknown physics, a small deviation of the noise is no
    evidence. ``known`` are the effects of the camera file.
    """
    if verdict == "inconsistent_setup":
        return verdict, missing, model
    possible = variance.background > 0 and effect_of(model, UnmodulatedLight) is None
    # the shift of distances correlates with the unmodulated light that a surface reflects
    of_light = {effect.effect for effect in missing} <= {UNKNOWN} and all(
        set(effect.covariates) <= _OF_LIGHT for effect in missing
    )
    unknown_light = verdict == "unknown_physics" and abs(variance.ratio - 1) < _OF_UNKNOWN_LIGHT
    if variance.noise_is_wrong and not (unknown_light and not (possible and of_light)):
        after = variance.noise
        if possible:
            ties.append([UnmodulatedLight.name, _NOISE])
        if possible and shifted:
            level = variance.background
            sentence = (
                f"background light: {level:.3g} counts of unmodulated light add photon noise; the "
                f"variance of "
                f"repeated frames is {variance.ratio:.2f} times the model's, most where it is dark"
            )
            named = Missing(UnmodulatedLight.name, 1.0, {"level": level}, {}, sentence)
            model = added(model, UnmodulatedLight(level=level))
            if of_light:
                missing, verdict = [], "missing_physics"
                described = {CovariateTable.name, AdditionalLight.name} - known
                kept = {n: e for n, e in model.effects.items() if n not in described}
                model = with_effects(model, kept)
        else:
            shot = f", {after.shot:.3g} m*sqrt(counts)" if after.shot else ""
            sentence = (
                f"noise: the variance of repeated frames is {variance.ratio:.2f} times the model's; they "
                f"fit floor {after.floor * 1e3:.2g} mm{shot} and {after.amplitude:.3g} m*counts over the "
                "amplitude"
            )
            numbers = {"floor": after.floor, "shot": after.shot, "amplitude": after.amplitude}
            named = Missing(_NOISE, 1.0, numbers, {}, sentence)
            model = replace(model, noise=after)
        missing = [*missing, named]
        if verdict != "unknown_physics":
            verdict = "missing_physics"
    return verdict, missing, model


def separate_unknown(
    missing: Sequence[Missing], camera: Camera
) -> tuple[list[Missing], list[Adjusted], list[str]]:
    """Return unknown physics alone, another noise as adjusted, and notes on the other entries.

    With the verdict ``unknown_physics`` a report names nothing else as missing.
    """
    noise = camera.noise
    before = {"floor": noise.floor, "shot": noise.shot, "amplitude": noise.amplitude}
    others = [effect for effect in missing if effect.effect != UNKNOWN]
    adjusted = [Adjusted(_NOISE, before, other.parameters) for other in others if other.effect == _NOISE]
    notes = [f"in addition to it, and in camera.yaml: {other.sentence}" for other in others]
    return [effect for effect in missing if effect.effect == UNKNOWN], adjusted, notes


def only_background(result: Result, rest: Rest | None, variance: Variance, camera: Camera) -> bool:
    """Return whether the effects found are no more than the shift that comes with unmodulated light.

    They are where their gain is next to nothing compared with the loss by the noise, or less than that of a
    smooth function of the light. A scale of distance is nearly such a function itself: far surfaces are dark.
    """
    found = bool(result.found) and variance.noise_is_wrong and variance.background > 0
    if not found or effect_of(camera, UnmodulatedLight) is not None:
        return False
    named = result.gained
    gain = named + (0.0 if rest is None else rest.on_top)
    scale = len(result.found) == 1 and vocabulary()[result.found[0].effect].scales_distance
    most = _by_light(result.explorations[0]) * (_AS_SCALE if scale else 1.0)
    return gain < _SHIFT_OF_BACKGROUND * _cost(result, variance) or most > named


def only_rectified_noise(result: Result, variance: Variance) -> bool:
    """Return whether a response that was found alone is no more than the bias of amplitudes by a large noise.

    The mean length of a noisy phasor is above the phasor's (Rice 1944), most where it is dark.
    """
    alone = bool(result.found) and all(vocabulary()[finding.effect].is_response for finding in result.found)
    too_noisy = variance.noise_is_wrong and variance.ratio > 1
    return alone and too_noisy and result.gained < _SHIFT_OF_BACKGROUND * _cost(result, variance)


def _by_light(baseline: Exploration) -> float:
    """Return the gain of the best smooth function of a covariate that correlates with the light."""
    smooth = range(baseline.named, len(baseline.candidates))
    return max(
        (float(baseline.gains[k]) for k in smooth if baseline.candidates[k].variant in _OF_LIGHT), default=0.0
    )


def only_noise(result: Result, rest: Rest, variance: Variance) -> bool:
    """Return whether the remainder is next to nothing compared with the loss by too small a noise."""
    return variance.noise_is_wrong and rest.on_top < _SHIFT_OF_BACKGROUND * _cost(result, variance)


def _cost(result: Result, variance: Variance) -> float:
    """Return the loss of likelihood by too small a noise [nats]."""
    _, rows = result.explorations[0].scores.chi_square()
    return 0.5 * max(variance.ratio - 1.0, 0.0) * rows
