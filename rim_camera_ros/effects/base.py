"""What an effect is: one frozen dataclass of parameters that can simulate, correct, and be fitted.

How effects combine (see the chain in `rim_camera_ros.effects.ORDER`): scene and optics effects act on
the complex image and deliver one distance and one amplitude per pixel; every other term is evaluated
at *that* distance and amplitude, and the terms add up to the measured distance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.footprint import Cells, FootprintLight
from rim_camera_ros.frame import Settings
from rim_camera_ros.parameters import flatten
from rim_camera_ros.phasor import nearest_period, phase_distance, to_phasor, wrap
from rim_camera_ros.scene import Geometry

Image = NDArray[Any]
#: What a term may depend on; terms of one kind are folded into tables by the correction.
Dependency = Literal["distance", "amplitude", "pixel", "incidence", "frame", "settings"]
#: How well one frame suffices to undo an effect.
Undo = Literal["exact", "planes", "partial", "none"]


@dataclass(frozen=True)
class Signal:
    """Light and measurement of one exposure, all (H, W).

    ``distance`` [m] and ``amplitude`` [counts] are what the optics deliver, noise-free and unwrapped;
    NaN and 0 where there is no light. ``offset`` [m] is the sum of the terms so far: the measured
    distance is ``distance + offset``. ``published`` is the amplitude after the electronics, None where
    it is the amplitude itself.
    """

    distance: Image
    amplitude: Image
    offset: Image | float = 0.0
    published: Image | None = None

    @property
    def measured(self) -> Image:
        """Measured distance in metres, before noise and wrapping."""
        result: Image = self.distance + self.offset
        return result

    @property
    def published_amplitude(self) -> Image:
        """Amplitude in counts before noise and clipping."""
        return self.amplitude if self.published is None else self.published


@dataclass
class Context:
    """What an effect may know beside the signal.

    ``geometry``, ``geometry_at(seconds)`` (the scene that much later, with its ideal amplitude) and
    ``footprint(cells)`` (the light around the centres of the pixels) only in simulation; ``moving`` says
    whether the camera moves meanwhile; ``incidence`` [rad] (H, W) is true in simulation, estimated in
    correction; ``saturated`` (H, W) marks saturated pixels; ``time`` [s] counts from the first frame;
    ``memory`` is kept from frame to frame; ``notes`` collects what the user should be told.
    """

    camera: Camera
    settings: Settings = field(default_factory=Settings)
    stamp: int = 0
    time: float = 0.0
    geometry: Geometry | None = None
    geometry_at: Callable[[float], tuple[Geometry, Image]] | None = None
    footprint: Callable[[Cells], FootprintLight] | None = None
    incidence: Image | None = None
    saturated: NDArray[np.bool_] | None = None
    moving: bool = False
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    memory: dict[str, Any] = field(default_factory=dict)
    notes: set[str] = field(default_factory=set)

    @property
    def ambiguity(self) -> float:
        return self.camera.sensor.ambiguity

    @cached_property
    def column(self) -> NDArray[np.float64]:
        """Column coordinate u, (1, W)."""
        return np.arange(self.camera.sensor.width, dtype=float)[None, :]

    @cached_property
    def row(self) -> NDArray[np.float64]:
        """Row coordinate v, (H, 1)."""
        return np.arange(self.camera.sensor.height, dtype=float)[:, None]

    @cached_property
    def integration_time(self) -> float:
        """The frame's integration time in the device's unit; `InputError` where unknown."""
        return self.camera.integration_time(self.settings)


#: Derivatives of measured distance [m] and published amplitude [counts] by one parameter.
Column = tuple[Image | float, Image | float]


@dataclass(frozen=True)
class Effect(ABC):
    """Base of all effects; a subclass is the effect's parameters and its behaviour."""

    name: ClassVar[str]
    #: one line: what it is, for people
    title: ClassVar[str]
    #: what a recording must contain for the parameters to be observable
    observable: ClassVar[str]
    #: the signature that would refute it
    refuted_by: ClassVar[str]
    #: how well one frame suffices to undo it
    undo: ClassVar[Undo] = "exact"
    #: whether it keeps something in the context's memory, for which frames must come in their order
    remembers: ClassVar[bool] = False

    @abstractmethod
    def simulate(self, signal: Signal, context: Context) -> Signal:
        """Return the signal with the effect."""

    def correct(self, signal: Signal, context: Context) -> Signal:
        """Return the signal without the effect, as far as `undo` declares (default: unchanged)."""
        return signal

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        """Return the derivatives of measured distance and published amplitude by each parameter.

        ``signal`` is what `simulate` receives; keys are the dotted paths of `parameters.flatten`.
        """
        return {}

    @abstractmethod
    def sentence(self) -> str:
        """Return in words, with numbers, what the effect does."""

    def check(self, camera: Camera) -> None:  # noqa: B027 -- most have nothing to check
        """Raise ValueError where the parameters do not fit the camera (shapes, regions)."""

    @classmethod
    @abstractmethod
    def example(cls, camera: Camera) -> Effect:
        """Return the effect at a plausible strength, for demonstrations and tests."""

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the allowed range of each parameter by dotted path."""
        return {path: (low, high) for path, (low, high, _) in self._metadata().items()}

    def priors(self) -> dict[str, float]:
        """Return the size that is common for each parameter (1-sigma of a weak prior)."""
        return {path: size for path, (_, _, size) in self._metadata().items() if size is not None}

    def _metadata(self) -> dict[str, tuple[float, float, float | None]]:
        return _metadata_of(self, "", (-np.inf, np.inf, None))


def _metadata_of(
    value: Any, prefix: str, inherited: tuple[float, float, float | None]
) -> dict[str, tuple[float, float, float | None]]:
    if isinstance(value, float):
        return {prefix[:-1]: inherited}
    result: dict[str, tuple[float, float, float | None]] = {}
    if hasattr(value, "__dataclass_fields__"):
        for one in fields(value):
            m = one.metadata
            own = (
                max(m.get("minimum", -np.inf), m.get("above", -np.inf)),
                min(m.get("maximum", np.inf), m.get("below", np.inf)),
                m.get("typical"),
            )
            result.update(_metadata_of(getattr(value, one.name), f"{prefix}{one.name}.", own))
    elif isinstance(value, tuple):
        for i, inner in enumerate(value):
            result.update(_metadata_of(inner, f"{prefix}{i}.", inherited))
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            shown = int(key) if isinstance(key, float) and key == int(key) else key
            result.update(_metadata_of(inner, f"{prefix}{shown}.", inherited))
    return {path: entry for path, entry in result.items() if path in flatten(value, prefix)}


@dataclass(frozen=True)
class DistanceTerm(Effect):
    """An effect that adds metres to the measured distance."""

    @abstractmethod
    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        """Return the term in metres at the distance and amplitude that the optics deliver.

        NaN where it makes a measurement impossible.
        """

    def depends_on(self) -> frozenset[Dependency]:
        """Return what the term depends on; never less than what it does."""
        return frozenset({"settings"})

    def simulate(self, signal: Signal, context: Context) -> Signal:
        term = self.term(signal.distance, signal.amplitude, context)
        return replace(signal, offset=signal.offset + term)

    def correct(self, signal: Signal, context: Context) -> Signal:
        """Solve distance + term(distance) = measured by iteration, to 1e-9 m."""
        distance = solve_terms(signal.distance, lambda d: self.term(d, signal.amplitude, context), context)
        return replace(signal, distance=distance)


def solve_terms(
    measured: Image, term: Callable[[Image], Image | float], context: Context, *, tolerance: float = 1e-9
) -> Image:
    """Return d with d + term(d) = measured by fixed-point iteration, modulo L for a wrapping camera.

    The terms of these cameras change by far less than a metre per metre, so that the iteration
    contracts (the cyclic error, the steepest, by about 0.07 a step).
    """
    wraps = context.camera.sensor.wraps
    distance = measured
    for _ in range(60):
        previous = distance
        distance = measured - term(previous)
        if wraps:
            distance = wrap(distance, context.ambiguity)
        step = np.abs(distance - previous)
        if wraps:
            step = np.minimum(step, context.ambiguity - step)
        if not np.any(step > tolerance):
            break
    return distance


@dataclass(frozen=True)
class ComplexEffect(Effect):
    """A linear effect on the complex image S = A exp(i 2 pi d / L)."""

    @abstractmethod
    def apply(self, phasor: Image, context: Context) -> Image:
        """Return the complex image with the effect."""

    def invert(self, phasor: Image, context: Context) -> Image:
        """Return the complex image without the effect (default: unchanged)."""
        return phasor

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        """Return dS_out / d(parameter) by dotted path."""
        return {}

    def simulate(self, signal: Signal, context: Context) -> Signal:
        phasor = self.apply(to_phasor(signal.distance, signal.amplitude, context.ambiguity), context)
        return from_phasor(phasor, signal, context)

    def correct(self, signal: Signal, context: Context) -> Signal:
        if type(self).invert is ComplexEffect.invert:
            return signal
        phasor = self.invert(to_phasor(signal.distance, signal.amplitude, context.ambiguity), context)
        return from_phasor(phasor, signal, context)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        before = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        after = self.apply(before, context)
        return {
            path: phasor_derivative(after, change, context.ambiguity)
            for path, change in self.phasor_columns(before, context).items()
        }


def from_phasor(phasor: Image, signal: Signal, context: Context) -> Signal:
    """Return the signal of a complex image; the distance in the period nearest the one before."""
    distance = phase_distance(phasor, context.ambiguity)
    distance = nearest_period(distance, signal.distance, context.ambiguity)
    amplitude = np.abs(phasor).astype(signal.amplitude.dtype, copy=False)
    return replace(signal, distance=distance, amplitude=amplitude)


def phasor_derivative(phasor: Image, change: Image, ambiguity: float) -> Column:
    """Return the derivatives of distance and amplitude for a change of the complex image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(phasor == 0, 0, change / phasor)
    return relative.imag * (ambiguity / (2 * np.pi)), relative.real * np.abs(phasor)


# --- rows per integration time ------------------------------------------------------------------


def row_weights(
    rows: Mapping[float, Any], integration_time: Callable[[], float]
) -> list[tuple[float, float]]:
    """Return (key, weight) of the rows that hold at an integration time.

    An exact key is used; between two keys the terms in metres are interpolated linearly; outside them
    the nearest row is used; a single row serves every setting (and needs no integration time).
    """
    keys = sorted(rows)
    if len(keys) == 1:
        return [(keys[0], 1.0)]
    t = integration_time()
    if t <= keys[0]:
        return [(keys[0], 1.0)]
    if t >= keys[-1]:
        return [(keys[-1], 1.0)]
    upper = next(i for i, key in enumerate(keys) if key >= t)
    if keys[upper] == t:
        return [(t, 1.0)]
    share = (t - keys[upper - 1]) / (keys[upper] - keys[upper - 1])
    return [(keys[upper - 1], 1.0 - share), (keys[upper], share)]


def outside_rows(rows: Mapping[float, Any], integration_time: float | None) -> bool:
    """Return whether an integration time lies outside the rows (flag 8), never for a single row."""
    if len(rows) == 1 or integration_time is None:
        return False
    return not min(rows) <= integration_time <= max(rows)


def combine_rows(
    rows: Mapping[float, Any], context: Context, term: Callable[[Any], Image | float]
) -> Image | float:
    """Return the interpolated term in metres of the rows that hold at the frame's integration time."""
    weights = row_weights(rows, lambda: context.integration_time)
    total: Image | float = 0.0
    for key, weight in weights:
        total = total + weight * term(rows[key])
    return total


def row_name(key: float) -> str:
    """Return a row's key as it stands in a dotted path."""
    return str(int(key)) if key == int(key) else str(key)


def need_rows(rows: Mapping[float, Any], name: str) -> None:
    """Raise ValueError for an empty group of rows."""
    if not rows:
        raise ValueError(f"{name} is empty: give one row, by integration time")


def require_geometry(context: Context, name: str) -> Geometry:
    """Return the scene's geometry, or raise `InputError` where there is none (only a simulation has it)."""
    if context.geometry is None:
        raise InputError(f"{name} needs the scene's geometry", remedy="simulate a scene file")
    return context.geometry
