"""Curves that change amplitudes in addition to effects: ripples over the phase, other surfaces, a response.

The harmonics of the modulation that bend the distance also make the amplitude ripple with the same periods
(Kahlmann 2007, sec. 3.3.1, sampling a signal that is no sine). A rough surface brightens towards grazing
incidence in proportion to what it reflects (Oren & Nayar 1994); a glossy one adds light near normal incidence
whatever its colour (Cook & Torrance 1982). No parameter of a camera file describes these: they are estimated
jointly with the camera, the ripples always, the surfaces on request, and a free response in addition to an
`amplitude_nonlinearity`, whose single parameter does not describe every amplifier.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.geometry import Geometry
from rim_camera_ros.phasor import cosine_and_sine
from rim_camera_ros.scene import Scene

Array = NDArray[Any]

PREFIX = "radiometry."
#: Angles of the heights of surfaces; close together near normal incidence, where a print's gloss is some five
#: degrees wide.
_DEGREES = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
_PERIODS = (4, 8)
#: Reflectivity to which the gloss is referred, and the least factor on the light.
_REFERENCE = 0.3
_LEAST = 0.1
#: Labels of a weak lobe and of a falloff begin so.
LOBE_PREFIX = f"{PREFIX}lobe."
#: Labels by curve; the one in proportion to the reflectivity is 0 at normal incidence, where it could not be
#: distinguished from the power.
RIPPLES = tuple(f"{PREFIX}ripple.{n}.{part}" for n in _PERIODS for part in ("cosine", "sine"))
DIFFUSE = tuple(f"{PREFIX}diffuse.{k:.0f}" for k in _DEGREES[1:])
GLOSS = tuple(f"{PREFIX}gloss.{k:.0f}" for k in _DEGREES)
SURFACES = (*DIFFUSE, *GLOSS)
#: Logarithms (base 10) of the light over a level at which the curve of the published amplitude has its
#: heights; it is 1 at the level, as it could not be distinguished from the power otherwise.
_LOGARITHMS = (-2.0, -1.6, -1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2, 1.6, 2.0)
RESPONSE = tuple(f"{PREFIX}response.{k:+.1f}" for k in _LOGARITHMS if k != 0.0)
#: A weak lobe that every surface may have in addition to Lambert's law, at coarser angles, and its 1-sigma.
#: At normal incidence it is as unknown as elsewhere: the gain of a camera is that for Lambert's law.
_LOBE_DEGREES = (0.0, 10.0, 20.0, 35.0, 55.0, 80.0)
LOBE_SIGMA = 0.03
LOBE_DIFFUSE = tuple(f"{LOBE_PREFIX}diffuse.{k:.0f}" for k in _LOBE_DEGREES)
LOBE_GLOSS = tuple(f"{LOBE_PREFIX}gloss.{k:.0f}" for k in _LOBE_DEGREES)
#: Emitters are extended and stand beside the lens: light falls off a little otherwise than with 1 / d^2.
_FALLOFF_DISTANCES = (0.35, 0.7, 1.4, 2.8, 5.6)
_FALLOFF_KNOTS = np.log(_FALLOFF_DISTANCES)
FALLOFF = tuple(f"{LOBE_PREFIX}falloff.{k:g}" for k in _FALLOFF_DISTANCES)
LOBE = (*LOBE_DIFFUSE, *LOBE_GLOSS, *FALLOFF)
#: Labels of the relative errors of reflectivities begin so; then surface and tile.
TILES = "reflectivity."
_GRID = np.logspace(-1.0, 6.0, 3000)
_ALL = frozenset((*RIPPLES, *SURFACES, *RESPONSE, *LOBE))


def of_light(path: str) -> bool:
    """Whether a parameter belongs to a curve of the light, which no camera file has."""
    return path in _ALL or path.startswith(TILES)


def tile_labels(scene: Scene) -> tuple[str, ...]:
    """Return the labels of the tiles of all surfaces, by the numbers of `Geometry.tile`."""
    return tuple(f"{TILES}{surface.name}.{k}" for surface in scene.surfaces for k in range(surface.tiles))


@dataclass(frozen=True)
class LightCurves:
    """Factors on the light: 1 + ripples(phase), and 1 + diffuse(incidence) + gloss(incidence) 0.3 / colour.

    ``values`` are by label, 0 where absent; over the incidence they are splines between the angles. Published
    amplitudes are multiplied by a response, relative to that at ``level`` counts of light. ``tiles`` are the
    labels of the tiles whose reflectivity is not exactly that of the scene file.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    level: float = 1000.0
    tiles: tuple[str, ...] = ()

    def factor(self, geometry: Geometry, ambiguity: float) -> Array:
        """Return the factor (H, W) on the light of Lambert's surfaces under a pure sine."""
        return self._ripples(geometry, ambiguity) * self.surfaces(geometry) * self._imperfect(geometry)

    def _imperfect(self, geometry: Geometry) -> Array:
        """Return the factor (H, W) of reflectivities and of a weak lobe."""
        factor = np.ones(geometry.distance.shape)
        if not self.values.keys().isdisjoint(LOBE):
            angle, ratio = _angle_and_ratio(geometry)
            basis = _weights(_LOBE_DEGREES, angle)
            diffuse = basis @ np.array([self.values.get(k, 0.0) for k in LOBE_DIFFUSE])
            gloss = basis @ np.array([self.values.get(k, 0.0) for k in LOBE_GLOSS])
            falloff = np.interp(
                _log_distance(geometry), _FALLOFF_KNOTS, [self.values.get(k, 0.0) for k in FALLOFF]
            )
            factor = np.maximum(1.0 + diffuse + gloss * ratio + falloff, _LEAST)
        if self.tiles:
            logarithms = np.array([*(self.values.get(label, 0.0) for label in self.tiles), 0.0])
            factor = factor * np.exp(np.clip(logarithms, -3.0, 3.0))[geometry.tile]
        return factor

    def _ripples(self, geometry: Geometry, ambiguity: float) -> Array:
        if self.values.keys().isdisjoint(RIPPLES):
            return np.ones(geometry.distance.shape)
        waves = _waves(geometry, ambiguity)
        change = sum(self.values.get(label, 0.0) * wave for label, wave in zip(RIPPLES, waves, strict=True))
        return np.asarray(np.maximum(1.0 + change, _LEAST))

    def surfaces(self, geometry: Geometry) -> Array:
        """Return the factor (H, W) of surfaces unlike Lambert's."""
        if self.values.keys().isdisjoint(SURFACES):
            return np.ones(geometry.distance.shape)
        angle, ratio = _angle_and_ratio(geometry)
        change = self._curve(DIFFUSE, angle) + self._curve(GLOSS, angle) * ratio
        return np.asarray(np.maximum(1.0 + change, _LEAST))

    def _curve(self, labels: Sequence[str], angle: Array) -> Array:
        heights = [self.values.get(label, 0.0) for label in labels]
        return np.asarray(_weights(_DEGREES, angle)[..., -len(heights) :] @ np.array(heights))

    def columns(self, geometry: Geometry, ambiguity: float, labels: Sequence[str]) -> list[Array]:
        """Return the derivatives (H, W) of the logarithm of the light by `RIPPLES`, `SURFACES` or `LOBE`."""
        if labels[0] in RIPPLES:
            ripples = self._ripples(geometry, ambiguity)
            return [wave / ripples for wave in _waves(geometry, ambiguity)]
        angle, ratio = _angle_and_ratio(geometry)
        if labels[0] in FALLOFF:
            far = _log_distance(geometry)
            return [np.interp(far, _FALLOFF_KNOTS, row) for row in np.eye(len(_FALLOFF_KNOTS))]
        if labels[0] in LOBE:
            rows = list(np.moveaxis(_weights(_LOBE_DEGREES, angle), -1, 0))
            far = _log_distance(geometry)
            falloff = [np.interp(far, _FALLOFF_KNOTS, row) for row in np.eye(len(_FALLOFF_KNOTS))]
            return [*rows, *(row * ratio for row in rows), *falloff]
        factor = self.surfaces(geometry)
        weights = list(np.moveaxis(_weights(_DEGREES, angle), -1, 0))
        return [weight / factor for weight in weights[1:]] + [weight * ratio / factor for weight in weights]

    def response(self, light: Array) -> Array:
        """Return the factor on the published amplitude at light in counts."""
        if not self.responds:
            return np.ones(np.shape(light))
        heights = [self.values.get(f"{PREFIX}response.{k:+.1f}", 0.0) for k in _LOGARITHMS]
        return np.asarray(np.maximum(1.0 + np.interp(self._logarithm(light), _LOGARITHMS, heights), _LEAST))

    def without(self, labels: Iterable[str]) -> LightCurves:
        """Return the curves without those of some labels."""
        gone = frozenset(labels)
        return replace(self, values={key: one for key, one in self.values.items() if key not in gone})

    @property
    def responds(self) -> bool:
        """Whether there is a response."""
        return not self.values.keys().isdisjoint(RESPONSE)

    def light_of(self, published: Array, compressed: Callable[[Array], Array]) -> Array:
        """Return the light in counts of published amplitudes, which are ``compressed`` with a response."""
        readings = np.maximum.accumulate(compressed(_GRID) * self.response(_GRID))
        return np.asarray(np.interp(published, readings, _GRID))

    def response_columns(self, light: Array) -> list[Array]:
        """Return the derivatives of the logarithm of the published amplitude by `RESPONSE`."""
        logarithm, factor = self._logarithm(light), self.response(light)
        rows = np.eye(len(_LOGARITHMS))
        return [
            np.interp(logarithm, _LOGARITHMS, row) / factor
            for row, k in zip(rows, _LOGARITHMS, strict=True)
            if k != 0.0
        ]

    def _logarithm(self, light: Array) -> Array:
        return np.asarray(np.log10(np.maximum(light, 1e-3) / self.level))

    def bend(self) -> float:
        """Return the greatest deviation of the response from 1."""
        return max(abs(self.values.get(f"{PREFIX}response.{k:+.1f}", 0.0)) for k in _LOGARITHMS)

    def ripple(self) -> float:
        """Return the largest relative amplitude of a ripple."""
        pairs = zip(RIPPLES[::2], RIPPLES[1::2], strict=True)
        return max(float(np.hypot(self.values.get(a, 0.0), self.values.get(b, 0.0))) for a, b in pairs)

    def sentence(self) -> str:
        """Return the curves of the surfaces in words."""
        parts = []
        kinds = (("in proportion to their reflectivity", DIFFUSE), ("whatever their colour", GLOSS))
        for name, labels in kinds:
            at = max(labels, key=lambda one: abs(self.values.get(one, 0.0)))
            value = self.values.get(at, 0.0)
            if abs(value) >= 0.005:
                angle = at.rpartition(".")[2]
                more = "more" if value > 0 else "less"
                if labels is DIFFUSE:
                    where = " than at normal incidence"
                else:
                    where = f" for a reflectivity of {_REFERENCE:g}"
                parts.append(f"{name} up to {abs(value):.0%} {more}{where}, at {angle} degrees")
        return " and ".join(parts)


def _waves(geometry: Geometry, ambiguity: float) -> list[Array]:
    phase = np.nan_to_num(geometry.distance) * (2 * np.pi / ambiguity)
    cosine, sine = cosine_and_sine(_PERIODS[0] * phase)
    # of twice the angle
    return [cosine, sine, 2 * cosine * cosine - 1, 2 * sine * cosine]


def _log_distance(geometry: Geometry) -> Array:
    return np.asarray(np.log(np.maximum(np.nan_to_num(geometry.distance), 1e-3)))


@cache
def _even_spline(degrees: tuple[float, ...]) -> Callable[[Array], Array]:
    from scipy.interpolate import CubicSpline

    none = np.zeros(len(degrees))
    spline: Callable[[Array], Array] = CubicSpline(
        np.radians(degrees), np.eye(len(degrees)), bc_type=((1, none), (2, none))
    )
    return spline


def _weights(degrees: tuple[float, ...], angle: Array) -> Array:
    """Return the weights (..., N) of heights at angles, of splines that are even in the angle.

    Linear interpolation would miss a tenth of a lobe that is 10 degrees wide.
    """
    return np.asarray(_even_spline(degrees)(np.minimum(angle, np.radians(degrees[-1]))))


def _angle_and_ratio(geometry: Geometry) -> tuple[Array, Array]:
    angle = np.nan_to_num(geometry.incidence)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = _REFERENCE / np.where(geometry.reflectivity > 0, geometry.reflectivity, np.inf)
    return angle, np.asarray(ratio)
