"""What changes the light beside the camera file's effects: ripples over the phase, surfaces unlike Lambert's.

The harmonics of the modulation that bend the distance also make the amplitude ripple with the same periods
(Kahlmann 2007, sec. 3.3.1, sampling a signal that is no sine). A rough surface brightens towards grazing
incidence in proportion to what it reflects (Oren & Nayar 1994); a glossy one adds light near normal incidence
whatever its colour (Cook & Torrance 1982). No parameter of a camera file describes either: they are estimated
beside the camera's, the ripples always, the surfaces where they are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.scene import Geometry

Array = NDArray[Any]

PREFIX = "radiometry."
_DEGREES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
_KNOTS = np.radians(_DEGREES)
_PERIODS = (4, 8)
#: Reflectivity to which the gloss is referred, and the least factor on the light.
_REFERENCE = 0.3
_LEAST = 0.1
#: Labels by curve; the one in proportion to the reflectivity is 0 at normal incidence, where it could not be
#: told from the power.
RIPPLES = tuple(f"{PREFIX}ripple.{n}.{part}" for n in _PERIODS for part in ("cosine", "sine"))
DIFFUSE = tuple(f"{PREFIX}diffuse.{k:.0f}" for k in _DEGREES[1:])
GLOSS = tuple(f"{PREFIX}gloss.{k:.0f}" for k in _DEGREES)
SURFACES = (*DIFFUSE, *GLOSS)
_ALL = frozenset((*RIPPLES, *SURFACES))


def of_light(path: str) -> bool:
    """Whether a parameter is of a curve of the light, which no camera file has."""
    return path in _ALL


@dataclass(frozen=True)
class LightCurves:
    """Factors on the light: 1 + ripples(phase), and 1 + diffuse(incidence) + gloss(incidence) 0.3 / colour.

    ``values`` by label, 0 where absent; over the incidence linear between the angles.
    """

    values: Mapping[str, float] = field(default_factory=dict)

    def factor(self, geometry: Geometry, ambiguity: float) -> Array:
        """Return the factor (H, W) on the light of Lambert's surfaces under a pure sine."""
        return self._ripples(geometry, ambiguity) * self.surfaces(geometry)

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
        heights = [0.0] * (len(_KNOTS) - len(heights)) + heights
        return np.asarray(np.interp(angle, _KNOTS, heights))

    def columns(self, geometry: Geometry, ambiguity: float, labels: Sequence[str]) -> list[Array]:
        """Return the derivatives (H, W) of the logarithm of the light by `RIPPLES` or by `SURFACES`."""
        if labels[0] in RIPPLES:
            return [wave / self._ripples(geometry, ambiguity) for wave in _waves(geometry, ambiguity)]
        angle, ratio = _angle_and_ratio(geometry)
        factor = self.surfaces(geometry)
        weights = [np.interp(angle, _KNOTS, row) for row in np.eye(len(_KNOTS))]
        return [one / factor for one in weights[1:]] + [one * ratio / factor for one in weights]

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
                where = "" if labels is DIFFUSE else f" (for a reflectivity of {_REFERENCE:g})"
                parts.append(f"{name} up to {abs(value):.0%} {more}, at {angle} degrees{where}")
        return " and ".join(parts)


def _waves(geometry: Geometry, ambiguity: float) -> list[Array]:
    phase = np.nan_to_num(geometry.distance) * (2 * np.pi / ambiguity)
    return [wave(n * phase) for n in _PERIODS for wave in (np.cos, np.sin)]


def _angle_and_ratio(geometry: Geometry) -> tuple[Array, Array]:
    angle = np.nan_to_num(geometry.incidence)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = _REFERENCE / np.where(geometry.reflectivity > 0, geometry.reflectivity, np.inf)
    return angle, np.asarray(ratio)
