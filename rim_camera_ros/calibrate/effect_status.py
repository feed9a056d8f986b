"""The status of each effect by the recordings: fitted, absent up to a size, or not determined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OPTICS, effects_of, vocabulary
from rim_camera_ros.effects.candidate import Candidate
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.select.evidence import Scores

Array = NDArray[Any]
Status = Literal["fitted", "kept", "absent", "undetermined", "left out"]

#: Ratio of an effect's likely size given the data to that by its prior, below which it is determined.
DETERMINED = 0.3
#: Below this [m] (or this relative amplitude) an effect of common strength does not show in the recordings.
LEAST_EFFECT = 0.0002
LEAST_BRIGHTNESS = 0.002
#: Ratio of posterior to prior sigma of all parameters above which an effect of the camera file is kept.
KEPT = 0.7

#: Most stations from which sizes are computed, evenly chosen.
MOST_STATIONS = 60


@dataclass(frozen=True)
class EffectStatus:
    """The status of one effect by the recordings.

    ``bound`` is the 95 % limit of its RMS over the recordings' distances [m] where it is absent,
    ``brightness`` that of the relative amplitude for effects that hardly move distances. ``text`` states the
    status in words, with what to record.
    """

    effect: str
    status: Status
    text: str
    bound: float | None = None
    brightness: float | None = None
    gain: float | None = None


def undetermined_effects(scores: Scores, names: Sequence[str]) -> list[str]:
    """Return the fitted effects about whose parameters the data contain hardly any information."""
    base = scores.base
    sigma = np.sqrt(np.diag(scores.covariance(base))) / scores.prior[base]
    owners = [scores.regressors[int(i)].owner for i in base]
    return [
        name
        for name in names
        if (own := [s for s, owner in zip(sigma, owners, strict=True) if owner == name]) and min(own) > KEPT
    ]


@dataclass
class _Size:
    """Mean products (K, K) of a candidate's columns over the values used: distances [m], log amplitudes.

    Those of distances are without the mean of each pixel, which its offset absorbs.
    """

    distance: Array
    brightness: Array


def sizes_of(
    fitted: Fit, candidates: Sequence[Candidate], tick: Callable[[], None] | None = None
) -> list[_Size]:
    """Return how much each candidate moves distances and amplitudes, per unit of its coefficients."""
    totals = [
        [np.zeros((len(candidate.block.regressors),) * 2), np.zeros((len(candidate.block.regressors),) * 2)]
        for candidate in candidates
    ]
    counts = [0, 0]
    shape = fitted.forward.camera.shape
    looks = np.zeros(shape)
    sums = [np.zeros((len(candidate.block.regressors), *shape)) for candidate in candidates]
    step = max(1, len(fitted.forward.dataset.stations) // MOST_STATIONS)
    for number, prediction in enumerate(fitted.forward.predictions()):
        if number % step:
            continue
        if tick is not None:
            tick()
        used, lit = prediction.used, prediction.amplitude_used
        counts[0] += int(used.sum())
        counts[1] += int(lit.sum())
        reading = prediction.station.amplitude[lit] - prediction.amplitude_residual[lit]
        looks += used
        for candidate, total, by_pixel in zip(candidates, totals, sums, strict=True):
            columns = candidate.block.columns(prediction)
            distance = np.nan_to_num(np.stack([c[0][used] for c in columns]))
            total[0] += distance @ distance.T
            by_pixel[:, used] += distance
            if columns[0][1] is not None and lit.any():
                light = np.stack([np.asarray(c[1])[lit] / reading for c in columns])
                total[1] += np.nan_to_num(light) @ np.nan_to_num(light).T
    for total, by_pixel in zip(totals, sums, strict=True):
        weighted = by_pixel[:, looks > 0] / np.sqrt(looks[looks > 0])
        total[0] -= weighted @ weighted.T
    return [_Size(a / max(counts[0], 1), b / max(counts[1], 1)) for a, b in totals]


def statuses(
    fitted: Fit,
    scores: Scores,
    candidates: Sequence[Candidate],
    spans: Sequence[Sequence[int]],
    *,
    start: Camera,
    kept: Mapping[str, str],
    threshold: float,
    ties: Mapping[str, Sequence[str]] | None = None,
    tick: Callable[[], None] | None = None,
) -> list[EffectStatus]:
    """Return the status of every effect of the vocabulary, in its order.

    ``spans`` are the regressors of each candidate; ``kept`` are the effects that stay as in the file, with
    the reason; ``ties`` are, for a fitted effect, those from which it is indistinguishable in these
    recordings.
    """
    sizes = sizes_of(fitted, candidates, tick)
    owners = {scores.regressors[int(i)].owner for i in scores.base}
    known = effects_of(start)
    result = []
    for name in [*known, *OPTICS]:
        effect = fitted.camera.effects.get(name)
        if vocabulary()[name].estimated == "pixels":
            continue
        if name in kept:
            result.append(EffectStatus(name, "kept", kept[name]))
        elif name in owners:
            words = "fitted" if name in start.effects or name in OPTICS else "fitted; not in the file before"
            tied = (ties or {}).get(name, ())
            if tied:
                words += f"; these recordings cannot distinguish it from {' and '.join(tied)}"
            result.append(EffectStatus(name, "fitted", words))
        elif vocabulary()[name].estimated != "joint":
            why = vocabulary()[name].estimated_elsewhere
            if effect is not None:
                result.append(EffectStatus(name, "kept", f"as in the file: {why or 'a table'}"))
            elif why:
                result.append(EffectStatus(name, "left out", why))
        else:
            own = [k for k, candidate in enumerate(candidates) if candidate.effect == name]
            result.append(_absent(name, own, candidates, scores, spans, sizes, threshold))
    return result


def _absent(
    name: str,
    own: Sequence[int],
    candidates: Sequence[Candidate],
    scores: Scores,
    spans: Sequence[Sequence[int]],
    sizes: Sequence[_Size],
    threshold: float,
) -> EffectStatus:
    if not own:
        return EffectStatus(name, "undetermined", undeterminable(name))
    determined: list[tuple[float, float, float]] = []
    best_ratio = np.inf
    for k in own:
        span = np.array(spans[k], int)
        prior = np.diag(scores.prior[span] ** 2)
        values = np.array(
            [scores.values(span)[candidates[k].block.regressors[i].label] for i in range(len(span))]
        )
        posterior = _posterior(scores, span)
        size = sizes[k]
        # an effect that offsets of pixels absorb entirely is 0 up to rounding of either sign
        typical = float(np.sqrt(max(np.sum(size.distance * prior), 0.0)))
        bright = float(np.sqrt(max(np.sum(size.brightness * prior), 0.0)))
        visible = typical > LEAST_EFFECT or bright > LEAST_BRIGHTNESS
        shape = size.distance / max(LEAST_EFFECT, 1e-12) ** 2 + size.brightness / LEAST_BRIGHTNESS**2
        ratio = float(np.sqrt(max(np.sum(shape * posterior), 0.0) / max(np.sum(shape * prior), 1e-300)))
        if visible:
            best_ratio = min(best_ratio, ratio)
        if visible and ratio < DETERMINED:
            gain = float(scores.gain(span))
            determined.append(
                (_bound(size.distance, values, posterior), _bound(size.brightness, values, posterior), gain)
            )
    if not determined:
        why = (
            "it would hardly move anything in these recordings"
            if not np.isfinite(best_ratio)
            else f"they narrow it down to {best_ratio:.0%} of what is common"
        )
        return EffectStatus(
            name,
            "undetermined",
            f"cannot be determined from these recordings: {why}; {vocabulary()[name].record()}",
        )
    bound, brightness = max(status[0] for status in determined), max(status[1] for status in determined)
    gain = max(status[2] for status in determined)
    limits = [f"{bound * 1e3:.2g} mm RMS"] if bound > 5e-6 else []
    if brightness > 20 * bound:
        limits.append(f"{brightness * 100:.2g} % of the amplitude")
    text = f"absent: at most {' and '.join(limits)}"
    if gain > threshold:
        text = text.replace("absent: at", "not fitted, at") + f", though with it {likelier(gain)}"
        return EffectStatus(name, "left out", text, bound, brightness, gain)
    return EffectStatus(name, "absent", text, bound, brightness, gain)


def likelier(gain: float) -> str:
    """Return a gain in nats in words."""
    return f"held-out poses are 10^{gain / np.log(10):.0f} times as probable"


def _posterior(scores: Scores, span: Array) -> Array:
    """Return the posterior covariance of a candidate's coefficients, jointly with all that is fitted."""
    columns = scores.columns(span.tolist())
    place = np.searchsorted(columns, span)
    try:
        return np.asarray(scores.covariance(columns)[np.ix_(place, place)])
    except linalg.LinAlgError:
        return np.diag(scores.prior[span] ** 2)


def _bound(size: Array, values: Array, posterior: Array) -> float:
    """Return the 95 % limit of an RMS: that of the estimate plus 1.96 times that of its uncertainty."""
    centre = float(np.sqrt(max(float(values @ size @ values), 0.0)))
    return centre + 1.96 * float(np.sqrt(max(float(np.sum(size * posterior)), 0.0)))


def undeterminable(name: str) -> str:
    """Return what is missing to determine a requested effect on which the data have no information."""
    return f"{vocabulary()[name].lacking}; {vocabulary()[name].record()}"
