"""Entries of named effects: parameters, probabilities, and recordings that would distinguish rivals."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.diagnose.codes import MissingCodes
from rim_camera_ros.diagnose.menu import Proposal
from rim_camera_ros.diagnose.result import Missing, Ranked
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.effects import OF_SURFACES, SECTIONS, registry, vocabulary
from rim_camera_ros.effects.base import Effect, ResponseEffect
from rim_camera_ros.effects.light_curves import PREFIX, SURFACES, LightCurves
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.info.text import several
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.exploration import Exploration
from rim_camera_ros.select.pixel_gains import GainSpread

Array = NDArray[Any]

#: Quantiles of a recording's amplitudes at which a response is stated.
_DARK_TO_BRIGHT = (0.05, 0.5, 0.95)
#: Least relative ripple of the amplitude that is reported.
_VISIBLE_RIPPLE = 0.005


def missing_effect(
    name: str,
    fitted: Fit,
    intervals: Mapping[str, tuple[float, float, float]],
    probability: float,
    *,
    origin: Camera,
    distance_sigma: float | None = None,
) -> Missing:
    """Return the entry of an effect that was found; ``origin`` is the camera file that lacks it.

    ``distance_sigma`` [m] is the 1-sigma of the distances that it causes.
    """
    camera = fitted.camera
    probability = min(max(probability, 0.0), 1.0)
    effect = camera.effects.get(name)
    if effect is None:
        if name in OF_SURFACES:
            curves = fitted.forward.light_curves or LightCurves()
            own = {path: v for path, v in intervals.items() if path in SURFACES}
            return Missing(
                name,
                probability,
                {path.removeprefix(PREFIX): value for path, (value, _, _) in own.items()},
                {path.removeprefix(PREFIX): (low, high) for path, (_, low, high) in own.items()},
                f"{SECTIONS[name].missing}: {curves.sentence()}",
            )
        prefix = "optics."
        own = {path.removeprefix(prefix): v for path, v in intervals.items() if path.startswith(prefix)}
        sentence = SECTIONS[name].missing
        values = {
            path.removeprefix(prefix): v
            for path, v in camera_numbers(camera).items()
            if path.startswith(prefix)
        }
    else:
        prefix = f"effects.{name}."
        own = {path.removeprefix(prefix): v for path, v in intervals.items() if path.startswith(prefix)}
        sentence = _response_sentence(effect, fitted) or effect.sentence()
        values = {
            path.removeprefix(prefix): v
            for path, v in camera_numbers(camera).items()
            if path.startswith(prefix)
        }
    size = None if vocabulary()[name].shows_in == "amplitude" else _size(fitted, name, origin)
    if size is not None:
        sentence += f"; it moves distances by up to {size * 1e3:.3g} mm in this recording (99 % of them less)"
        if distance_sigma is not None:
            sentence += (
                f", known to {distance_sigma * 1e3:.2g} mm (1 sigma) apart from offsets of the pixels, if "
                "its form is the true one"
            )
    return Missing(
        effect=name,
        probability=probability,
        parameters=values,
        interval={path: (low, high) for path, (_, low, high) in own.items()},
        sentence=sentence,
        magnitude=size,
        distance_sigma=None if size is None else distance_sigma,
    )


def _response_sentence(effect: Effect, fitted: Fit) -> str | None:
    """Return the published counts of dark, medium and bright light in words, if the response is a curve."""
    curves = fitted.forward.light_curves
    if not isinstance(effect, ResponseEffect) or curves is None or not curves.responds:
        return None
    values = [station.amplitude[station.count > 0] for station in fitted.forward.dataset.stations]
    published = np.quantile(np.concatenate(values), _DARK_TO_BRIGHT)
    light = curves.light_of(published, effect.compressed)
    said = [" / ".join(f"{value:,.1f}" for value in values) for values in (light, published)]
    return f"amplitude response: {said[0]} counts of light are published as {said[1]}"


def _size(fitted: Fit, name: str, origin: Camera) -> float | None:
    from rim_camera_ros.select.effect_sizes import contribution

    values = []
    for prediction in fitted.forward.predictions():
        image = contribution(prediction, name, origin)
        values.append(np.abs(np.broadcast_to(image, prediction.used.shape)[prediction.used]))
    everything = np.concatenate(values) if values else np.zeros(0)
    return float(np.quantile(everything, 0.99)) if everything.size else None


def missing_codes_of(codes: MissingCodes, camera: Camera) -> Missing:
    """Return the entry for distance counts that never occur: unknown physics, with their spacing [m]."""
    step = codes.step * camera.sensor.lsb
    if codes.ranges:
        what = (
            f"{several(codes.ranges, 'range')} of distance counts amid frequent ones never occur "
            f"({codes.step:.0f} counts, {step * 1e3:.3g} mm; {codes.share:.0%} of the distances belong there)"
        )
    else:
        what = (
            f"beside {codes.share:.0%} of the frequent distance counts lie counts that never occur "
            f"(steps of {codes.step:.0f} counts, {step * 1e3:.2g} mm)"
        )
    sentence = f"unknown physics: {what}: the read-out has missing codes"
    return Missing(
        UNKNOWN, 1.0, {}, {}, sentence, ("distance",), step / np.sqrt(12), "staircase of the distance"
    )


def first_frames() -> Missing:
    """Return the entry for poses whose first frame differs from those after it: unknown physics."""
    sentence = (
        "unknown physics: the first frame of each pose differs from those after it, which are alike, in what "
        "all pixels share: the camera keeps something of the exposure before, or poses were not yet at rest; "
        "record without the first frame of each pose"
    )
    return Missing(UNKNOWN, 1.0, {}, {}, sentence, ("time",))


def large_gains(gains: GainSpread) -> Missing:
    """Return the entry for gains of pixels beyond those that the camera file states: unknown physics."""
    sentence = (
        f"unknown physics: neighbouring pixels see light that differs by {gains.found:.1%} (1 sigma) in all "
        f"poses, where the camera file states gains of {gains.stated:.1%} (radiometry.pattern_sigma): light "
        "goes from pixel to pixel, a surface that rests before the camera has a texture which the scene file "
        "lacks, or pixels are as unequal as that; then state it"
    )
    if gains.are_of_lines:
        sentence = (
            "unknown physics: means over rows or columns of pixels see light that differs from that of their "
            f"neighbours by {gains.of_line_means:.1%} (1 sigma) at least in all poses: light goes from one "
            "to the next, or whole rows or columns have a gain, which no camera file states"
        )
    return Missing(UNKNOWN, 1.0, {}, {}, sentence)


def ranking_of(baseline: Exploration, result: Result) -> list[Ranked]:
    """Return every effect scored alone, the best first.

    The gain of an effect that was fitted non-linearly is that of the fit.
    """
    best = baseline.best()
    gains = {effect: float(baseline.gains[k]) for effect, k in best.items()}
    if result.found:
        first = result.found[0]
        gains[first.effect] = max(first.gain, gains.get(first.effect, first.gain))
        for finding in result.found[1:]:
            gains.setdefault(finding.effect, finding.gain)
    identifiability = {
        effect: baseline.scores.identifiability(baseline.spans[k]) for effect, k in best.items()
    }
    ranking = [
        Ranked(name, float(weight), gain, *identifiability.get(name, (None, None)))
        for (name, gain), weight in zip(gains.items(), _probabilities(gains.values()), strict=True)
    ]
    return sorted(ranking, key=lambda rival: -rival.gain)


def with_unknown(ranking: Sequence[Ranked], gain: float) -> list[Ranked]:
    """Return the ranking with unknown physics, which gains so many nats, as one of the effects."""
    ranked = [*ranking, Ranked(UNKNOWN, 0.0, gain)]
    weights = _probabilities([rival.gain for rival in ranked])
    found = [replace(rival, probability=float(p)) for rival, p in zip(ranked, weights, strict=True)]
    return sorted(found, key=lambda rival: -rival.gain)


def _probabilities(gains: Collection[float]) -> Array:
    """Return the softmax over gains [nats] and a gain of 0 for no effect, without that of the latter."""
    values = np.array([*gains, 0.0])
    weights = np.exp(values - values.max())
    return np.asarray(weights[:-1] / weights.sum())


def unseen_effects(step: Exploration) -> list[str]:
    """Return the effects on which this recording has less than a nat of information: it cannot show them."""
    seen: dict[str, float] = {}
    for k in range(step.named):
        name = step.candidates[k].effect
        seen[name] = max(seen.get(name, 0.0), step.scores.information(step.spans[k]))
    absent = set(registry()) - set(step.fit.camera.effects) - set(seen)
    hidden = {name for name, info in seen.items() if info < 1.0}
    silent = {
        name for name, effect in registry().items() if effect.stated_by_pixels or effect.estimated == "pixels"
    }
    return sorted((absent | hidden) - silent)


def next_recording(
    ties: Sequence[Sequence[str]], advice: Mapping[tuple[str, ...], Proposal | None]
) -> str | None:
    """Return what to record to distinguish rivals, None where there are none.

    ``advice`` holds the best of the shipped experiments, by simulation, for each set of rivals.
    """
    known = registry()
    parts = []
    for names in ties:
        if tuple(names) in advice:
            proposal = advice[tuple(names)]
            rivals = " and ".join(name.replace("_", " ") for name in names)
            parts.append(
                f"none of the shipped experiments would distinguish {rivals} at their present strength"
                if proposal is None
                else f"{proposal.name} ({proposal.minutes:.0f} min) is expected to distinguish {rivals} by "
                f"{proposal.gain:,.0f} nats"
            )
        parts += [f"for {name}: {known[name].observable}" for name in names if name in known]
    return "; ".join(parts) if parts else None


def notes_of_refused(result: Result) -> list[str]:
    """Return notes on effects that gain and are not named: one sentence for each reason."""
    by_reason: dict[str, list[str]] = {}
    for refused in result.refused:
        entry = f"{refused.effect} ({refused.gain:,.0f} nats, its threshold {refused.threshold:,.0f})"
        by_reason.setdefault(refused.why, []).append(entry)
    return [f"not added, {why}: {', '.join(entries)}" for why, entries in by_reason.items()]


def notes_of_light(fitted: Fit) -> list[str]:
    """Return notes on amplitudes that no camera file describes."""
    curves = fitted.forward.light_curves
    notes = []
    if curves is not None and curves.ripple() >= _VISIBLE_RIPPLE:
        notes.append(
            f"amplitudes ripple by {curves.ripple():.1%} over the phase, as harmonics of the modulation make "
            "them; a camera file does not describe it"
        )
    if curves is not None and curves.responds and curves.bend() >= _VISIBLE_RIPPLE:
        notes.append(
            f"amplitudes respond to light otherwise than A / (1 + compression * A), by up to "
            f"{curves.bend():.1%}; a camera file does not describe it"
        )
    return notes
