"""Light of which the scene file says nothing, taken as measured where it spreads over the array.

Stray light and blur also come from surfaces of unknown reflectivity, and from what stands beside those of the
scene. Their light is in the image, which contains what has spread already: that is undone first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.chain import Chain
from rim_camera_ros.effects.base import ComplexEffect, Effect
from rim_camera_ros.effects.signal import Context, Signal, from_phasor, require_geometry
from rim_camera_ros.fit.data import Station
from rim_camera_ros.phasor import to_phasor

Array = NDArray[Any]


@dataclass(frozen=True)
class Undescribed:
    """Where the scene says nothing of the light, and the image before anything has spread.

    ``nameless`` pixels (H, W) see surfaces of unknown reflectivity; ``outside`` those with a measurement meet
    no surface. ``image`` (H, W) complex is the measured one with what spreads undone. ``place`` is that of
    the first effect, in their order, that acts on it.
    """

    image: Array
    nameless: Array
    outside: Array
    place: int

    def left_of(self, relative: Array) -> Array:
        """Return what is left of a relative change (H, W) complex of the light before it was replaced.

        The light of these pixels is the measured one whatever comes before; of surfaces of the scene the
        distance changes.
        """
        left = np.where(self.nameless, 1j * relative.imag, relative)
        return np.where(self.outside, 0.0, left)

    def changes(self, effect: ComplexEffect, context: Context) -> Iterator[tuple[str, Array]]:
        """Yield relative changes of the light (H, W) complex by parameters of an effect that is undone in it.

        What an effect spreads over a pixel is missing in the light before it: d(L^-1 M) = -L^-1 dL L^-1 M.
        """
        if not effect.has_inverse:
            return
        for path, change in effect.phasor_columns(self.image, context).items():
            with np.errstate(divide="ignore", invalid="ignore"):
                relative = -effect.invert(change, context) / self.image
            relative = np.where(np.isfinite(relative), relative, 0.0)
            # of surfaces of the scene the distance is known
            yield path, np.where(self.outside, relative, np.where(self.nameless, relative.real, 0.0))


def sees_nothing_described(station: Station, context: Context) -> Array:
    """Return the pixels (H, W) with a measurement whose rays meet no surface of the scene."""
    hit = require_geometry(context, "a prediction").hit
    return np.asarray(~hit & (station.count > 0) & (station.amplitude > 0))


def with_measured_light(
    signal: Signal,
    station: Station,
    context: Context,
    *,
    chain: Chain,
    light: Callable[[Station, Array], Array],
    nameless: Array,
    effects: Sequence[Effect] = (),
    place: int = 0,
) -> tuple[Signal, Undescribed | None]:
    """Return the light before ``effects`` with that of undescribed surfaces as measured.

    ``light`` returns the measured light (H, W) [counts] of a station, or what is given where there is none.
    ``nameless`` pixels see surfaces of unknown reflectivity, at the distances of ``signal``. Pixels that see
    no surface of the scene have measured distances as well, without the terms of the ``chain`` and without
    what these distances have in common beyond the scene's. Where something is spread, also returns what it is
    undone in; ``place`` is that of the first of the effects in their order.
    """
    outside = sees_nothing_described(station, context)
    if not (outside.any() or nameless.any()):
        return signal, None
    amplitude, seen = light(station, signal.amplitude), station.count > 0
    measured = np.where(seen, station.distance, signal.distance)
    lit = np.where(seen & (amplitude > 0), amplitude, 1.0)
    terms = chain.evaluated(measured, lit, _with_normal_incidence(context)).total
    before = Signal(measured - terms, amplitude)
    spreading = [effect for effect in effects if effect.spreads and isinstance(effect, ComplexEffect)]
    undone = None
    if spreading:
        phasor = to_phasor(before.distance, before.amplitude, context.ambiguity)
        for effect in reversed(spreading):
            phasor = effect.invert(phasor, context)
        before = from_phasor(phasor, before, context)
        undone = Undescribed(phasor, nameless, outside, place)
    common = _in_common(before, signal, seen, context)
    result = Signal(
        np.where(outside, before.distance - common, signal.distance),
        np.where(outside | nameless, before.amplitude, signal.amplitude),
    )
    return result, undone


def _with_normal_incidence(context: Context) -> Context:
    """Return the context with normal incidence where nothing is known of a surface."""
    incidence = context.incidence
    return context if incidence is None else replace(context, incidence=np.nan_to_num(incidence))


def _in_common(before: Signal, signal: Signal, seen: Array, context: Context) -> float:
    """Return the mean [m] of distances less those of the scene, modulo the ambiguity range.

    It is over the pixels (H, W) with a measurement, the ``seen`` ones.
    """
    difference = (before.distance - signal.distance)[(signal.amplitude > 0) & seen]
    turns = np.exp(2j * np.pi * difference[np.isfinite(difference)] / context.ambiguity)
    return float(np.angle(turns.sum()) * context.ambiguity / (2 * np.pi))
