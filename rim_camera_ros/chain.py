"""The forward chain: light passes the effects in their order; terms are evaluated at the delivered light.

The simulation of frames, the prediction of mean frames in a fit, and the tables of the correction all use
this chain, so that they cannot disagree.
"""

from __future__ import annotations

from collections.abc import Iterable, MutableMapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.base import ComplexEffect, DistanceTerm, Effect, ResponseEffect
from rim_camera_ros.effects.signal import Context, Signal, from_phasor
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.phasor import to_phasor

Array = NDArray[Any]

#: Steps of the derivatives of terms: of the distance [m], and relative ones of the amplitude.
_STEP = 1e-4


@dataclass(frozen=True)
class Terms:
    """The sum of the terms in metres, and its derivatives by distance [-] and amplitude [m/count]."""

    total: Array | float
    by_distance: Array | float = 0.0
    by_amplitude: Array | float = 0.0


@dataclass(frozen=True)
class Chain:
    """The effects of a camera, grouped by where they act, each group in the order along the light.

    ``light`` changes the light that the optics deliver, ``terms`` are added to its distance, and ``response``
    turns its amplitude into the published one.
    """

    light: tuple[Effect, ...]
    terms: tuple[DistanceTerm, ...]
    response: ResponseEffect | None

    @classmethod
    def of(cls, effects: Iterable[Effect], *, of_means: bool = False) -> Chain:
        """Sort ordered effects; ``of_means`` excludes those without a predictable mean."""
        kept = [effect for effect in effects if effect.predictable or not of_means]
        responses = [
            response_effect for response_effect in kept if isinstance(response_effect, ResponseEffect)
        ]
        return cls(
            tuple(effect for effect in kept if not isinstance(effect, DistanceTerm | ResponseEffect)),
            tuple(distance_term for distance_term in kept if isinstance(distance_term, DistanceTerm)),
            responses[-1] if responses else None,
        )

    def evaluated(
        self, distance: Array, amplitude: Array, context: Context, *, slopes: bool = False
    ) -> Terms:
        """Return the terms at delivered distance [m] and amplitude [counts]; derivatives if ``slopes``."""
        total: Any = 0.0
        by_distance: Any = 0.0
        by_amplitude: Any = 0.0
        for term in self.terms:
            total = total + term.term(distance, amplitude, context)
            depends = term.depends_on() if slopes else ()
            if "distance" in depends:
                sides = (term.term(distance + step, amplitude, context) for step in (_STEP, -_STEP))
                by_distance = by_distance + (next(sides) - next(sides)) / (2 * _STEP)
            if "amplitude" in depends:
                sides = (term.term(distance, amplitude * (1 + step), context) for step in (_STEP, -_STEP))
                by_amplitude = by_amplitude + (next(sides) - next(sides)) / (2 * _STEP * amplitude)
        return Terms(total, by_distance, by_amplitude)

    def published(self, amplitude: Array) -> Array:
        """Return the published amplitudes in counts of delivered ones."""
        return amplitude if self.response is None else self.response.compressed(amplitude)


def deliver(
    effects: Iterable[Effect],
    signal: Signal,
    context: Context,
    *,
    before: MutableMapping[str, Signal] | None = None,
) -> Signal:
    """Return the light after the effects; ``before`` collects the light before each effect by name."""
    phasor: Array | None = None
    for effect in effects:
        if phasor is not None and (before is not None or not isinstance(effect, ComplexEffect)):
            signal = from_phasor(phasor, signal, context)
        if before is not None:
            before[effect.name] = signal
        if isinstance(effect, ComplexEffect):
            if phasor is None:
                phasor = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
            phasor = effect.apply(phasor, context)
        else:
            signal, phasor = effect.simulate(signal, context), None
    return signal if phasor is None else from_phasor(phasor, signal, context)


def ideal_amplitude(geometry: Geometry, power: float) -> Array:
    """Return power * reflectivity * cos(incidence) / distance^2 in counts (H, W), 0 where nothing is seen.

    ``power`` [counts m^2] is gain * integration time times that of the pose.
    """
    with np.errstate(invalid="ignore"):
        light = power * geometry.reflectivity * geometry.cos_incidence / geometry.distance**2
    return np.where(geometry.hit, light, 0.0)
