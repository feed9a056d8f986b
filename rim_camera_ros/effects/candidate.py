"""Regressors and candidates: the columns of an effect in a linear fit, and the effect from coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm, Effect
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.frame import Settings

Array = NDArray[Any]
Coefficients = Mapping[str, float]

#: Derivatives (H, W) of measured distance and published amplitude (None: none) by one regressor.
Column = tuple[Array, Array | None]
#: Number of pixels above which a search uses a coarser grid, or fewer variants.
MANY_PIXELS = 60_000
#: 1-sigma of a distance term's prior [m] where it is at its largest.
TERM_SIZE = 0.05


class Reading(Protocol):
    """A fit's prediction of a station's mean frame, as far as columns of regressors need it."""

    @property
    def context(self) -> Context:
        """The context in which effects see the station."""

    @property
    def distance(self) -> Array:
        """Predicted distance (H, W) [m]."""

    def columns(self, effect: Effect) -> dict[str, tuple[Array, Array]]:
        """Return the derivatives of the readings by an effect's parameters, by dotted path."""

    def before_effect(self, name: str) -> Signal:
        """Return the light just before an effect, which need not be one of the camera's."""

    def light_change(self, after: str | None, change: Array) -> tuple[Array, Array]:
        """Return the changes of readings by a relative change of light after an effect (None: scene)."""

    def reading_change(self, by_distance: Array | float, relative: Array | float) -> tuple[Array, Array]:
        """Return the changes of the readings for changes of delivered distance [m] and log amplitude."""

    def curve_columns(self, labels: Sequence[str]) -> list[tuple[Array, Array]]:
        """Return the derivatives of the readings by curves of the light."""


@dataclass(frozen=True)
class Regressor:
    """One column of the design: label, the effect or curve it belongs to, 1-sigma of its prior."""

    label: str
    owner: str
    prior: float


def priors_of(regressors: Sequence[Regressor]) -> Array:
    """Return the 1-sigma of the prior of each regressor (K,)."""
    return np.array([regressor.prior for regressor in regressors], float)


@dataclass(frozen=True)
class Groups:
    """Columns of regressors k, of which each pixel has at most one: ``number`` (H, W), -1 for none.

    Column k is ``own`` in the pixels with the number k, 0 elsewhere, plus ``share[k]`` times ``common``,
    which is the same for all columns (None: 0).
    """

    number: Array
    own: tuple[Array, Array]
    share: Array
    common: tuple[Array, Array] | None = None

    def columns(self) -> list[Column]:
        """Return the columns one by one."""
        result: list[Column] = []
        for number, share in enumerate(self.share.tolist()):
            mine = self.number == number
            distance, amplitude = (image * mine for image in self.own)
            if self.common is not None:
                distance = distance + share * self.common[0]
                amplitude = amplitude + share * self.common[1]
            result.append((distance, amplitude))
        return result


@dataclass(frozen=True)
class Block:
    """Regressors whose columns are computed together; ``in_order`` where they need the stations in order.

    ``grouped`` returns them as `Groups`, where each pixel has at most one of them. ``pointwise`` where the
    columns of each pixel follow from its own light: those of a part of the array can be computed alone.
    """

    regressors: tuple[Regressor, ...]
    columns: Callable[[Any], Sequence[Column]]
    in_order: bool = False
    grouped: Callable[[Any], Groups] | None = None
    pointwise: bool = False


@dataclass(frozen=True)
class Candidate:
    """One variant of an effect that a camera file lacks.

    ``effect`` is its name in the vocabulary, ``variant`` the name of the variant; ``build`` returns the
    camera with it, from the coefficients by label. ``positive`` are labels of coefficients that cannot be
    negative, as added light: negative ones are evidence for another effect. ``footprint`` [px] is set for
    variants that show only in pixels which an edge crosses.
    """

    effect: str
    variant: str
    block: Block
    build: Callable[[Camera, Coefficients], Camera]
    positive: tuple[str, ...] = ()
    footprint: float | None = None


class _Station(Protocol):
    settings: Settings
    amplitude: Array
    count: Array
    saturated: Array


class _Dataset(Protocol):
    @property
    def stations(self) -> Sequence[Any]: ...


@dataclass(frozen=True)
class Facts:
    """The properties of recordings on which candidates depend.

    ``amplitude`` is the median in counts, ``uptime`` [s] and ``ambient`` [degC] are the ranges (None: not
    stated); ``moves`` says whether the camera moves.
    """

    integration_times: tuple[float, ...]
    amplitude: float
    uptime: tuple[float, float] | None
    ambient: tuple[float, float] | None
    saturated: bool
    moves: bool
    surfaces: int

    @classmethod
    def of(cls, dataset: _Dataset, *, moves: bool, surfaces: int, camera: Camera) -> Facts:
        """Collect them from the stations."""
        stations: Sequence[_Station] = dataset.stations
        times = {camera.integration_time(station.settings) for station in stations}
        uptimes = [station.settings.uptime for station in stations]
        ambients = [station.settings.ambient_temperature for station in stations]
        known_up = [u for u in uptimes if u is not None]
        known_ambient = [a for a in ambients if a is not None]
        bright = [
            float(np.median(station.amplitude[station.count > 0]))
            for station in stations
            if station.count.any()
        ]
        return cls(
            integration_times=tuple(sorted(times)),
            amplitude=float(np.median(bright)) if bright else 1.0,
            uptime=(min(known_up), max(known_up)) if len(known_up) == len(uptimes) and known_up else None,
            ambient=(min(known_ambient), max(known_ambient)) if known_ambient else None,
            saturated=any(bool(station.saturated.any()) for station in stations),
            moves=moves,
            surfaces=surfaces,
        )


def has_many_pixels(camera: Camera) -> bool:
    """Return whether there are so many pixels that fewer variants are tried."""
    return camera.sensor.width * camera.sensor.height > MANY_PIXELS


def with_effect(camera: Camera, effect: Effect) -> Camera:
    """Return the camera with one more effect, last and unchecked; see `camera_file.in_order`."""
    return replace(camera, effects=MappingProxyType({**camera.effects, effect.name: effect}))


def effect_block(
    effect: Effect, priors: Mapping[str, float], *, owner: str | None = None, label: str = ""
) -> Block:
    """Return the regressors of some parameters of an effect: ``priors`` by dotted path.

    The label is ``effects.NAME.PATH``, with ``label`` appended to distinguish variants.
    """
    paths = tuple(priors)
    has_amplitude = not isinstance(effect, DistanceTerm)

    def columns(reading: Reading) -> list[Column]:
        found = reading.columns(effect)
        return [(found[path][0], found[path][1] if has_amplitude else None) for path in paths]

    name = effect.name if owner is None else owner
    regressors = tuple(Regressor(f"effects.{effect.name}.{p}{label}", name, priors[p]) for p in paths)
    return Block(regressors, columns, in_order=effect.remembers, pointwise=effect.pointwise)


def together(*blocks: Block) -> Block:
    """Return one block of the regressors of several, in their order."""
    regressors = tuple(regressor for block in blocks for regressor in block.regressors)
    return Block(
        regressors,
        lambda reading: [c for block in blocks for c in block.columns(reading)],
        in_order=any(block.in_order for block in blocks),
        pointwise=all(block.pointwise for block in blocks),
    )


def linear(effect: Effect, priors: Mapping[str, float], variant: str = "") -> Candidate:
    """Return a variant that is linear in the named parameters about those of the effect given.

    Coefficients add to its values, within their bounds; those whose bound they start at must not turn
    negative.
    """
    from rim_camera_ros.parameters import flatten, with_values

    block = effect_block(effect, priors, label=f"@{variant}" if variant else "")
    labels = dict(zip(priors, (regressor.label for regressor in block.regressors), strict=True))
    start, bounds = flatten(effect), effect.bounds()

    def build(camera: Camera, values: Coefficients) -> Camera:
        own = {path: start[path] + values[label] for path, label in labels.items()}
        clipped = {path: float(np.clip(v, *bounds.get(path, (-np.inf, np.inf)))) for path, v in own.items()}
        return with_effect(camera, with_values(effect, clipped))

    positive = tuple(label for path, label in labels.items() if bounds.get(path, (-1.0,))[0] == 0.0)
    return Candidate(effect.name, variant, block, build, positive)
