"""What an effect is: one frozen dataclass of parameters that can simulate, correct, and be fitted.

How effects combine (see `rim_camera_ros.effects.ORDER`): scene and optics act on the complex image, deliver
a distance and an amplitude per pixel; every other term is evaluated at these, and all terms add up.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.physics import Physics
from rim_camera_ros.effects.signal import Column, Context, Image, Signal, from_phasor, phasor_derivative
from rim_camera_ros.parameters import flatten, with_values
from rim_camera_ros.phasor import to_phasor, wrap, wrap_residual

if TYPE_CHECKING:
    from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn
    from rim_camera_ros.effects.graph import Graph

#: What a term may depend on; terms of one kind are folded into tables by the correction.
Dependency = Literal["distance", "amplitude", "pixel", "incidence", "frame", "settings"]
#: How well one frame suffices to undo an effect.
Undo = Literal["exact", "planes", "partial", "none"]


@dataclass(frozen=True)
class Effect(Physics):
    """Base of all effects; a subclass holds the effect's parameters, its behaviour, and its properties."""

    #: how well one frame suffices to undo it
    undo: ClassVar[Undo] = "exact"
    #: whether it keeps a state in the context's memory, so that frames must come in their order
    remembers: ClassVar[bool] = False
    #: whether its correction depends on the frames before
    follows_frames: ClassVar[bool] = False
    #: whether the state holds for a geometry, whichever the frame
    remembers_geometry: ClassVar[bool] = False
    #: whether it has a mean in the pixels of the scene that can be predicted
    predictable: ClassVar[bool] = True
    #: whether the light that it delivers stays the same while the scene does
    steady: ClassVar[bool] = False
    #: whether it settles after power-on
    settles: ClassVar[bool] = False
    #: whether it is a single number as long as the setting is the same
    constant_in_setting: ClassVar[bool] = False
    #: whether it is caused by saturated pixels
    from_saturated: ClassVar[bool] = False
    #: whether its form has a model discrepancy, by smooth factors over array, light and distance
    has_discrepancy: ClassVar[bool] = True
    #: whether the data determine the columns of its discrepancy also where it acts most
    discrepancy_is_determined: ClassVar[bool] = True
    #: whether it is a drift that an internal reference also measures
    drifts: ClassVar[bool] = False
    #: names of parameters in pixels, and per pixel
    in_pixels: ClassVar[frozenset[str]] = frozenset()
    per_pixel: ClassVar[frozenset[str]] = frozenset()
    #: names of parameters that are widths or lags
    shapes: ClassVar[frozenset[str]] = frozenset()
    #: whether it depends on the distance itself, not only on the distance modulo the ambiguity range
    absolute: ClassVar[bool] = False

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

    def sensor_sigmas(self) -> dict[str, float]:
        """Return by name the 1-sigma of errors of sensors on whose readings the effect depends."""
        return {}

    def sensor_columns(self, context: Context) -> dict[str, Column]:
        """Return the derivatives of measured distance and published amplitude by each of these errors."""
        return {}

    @abstractmethod
    def sentence(self) -> str:
        """Describe the effect in words, with numbers."""

    def check(self, camera: Camera) -> None:
        """Raise ValueError where the parameters do not fit the camera (shapes, regions)."""

    @classmethod
    @abstractmethod
    def example(cls, camera: Camera) -> Effect:
        """Return the effect at a plausible strength, for demonstrations and tests."""

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the allowed range of each parameter by dotted path."""
        return {path: (low, high) for path, (low, high, _) in self._metadata().items()}

    def priors(self) -> dict[str, float]:
        """Return the free parameters by dotted path with the 1-sigma of a weak prior about their values.

        The prior is as wide as the value itself, or as the usual size of such effects.
        """
        return {path: size for path, (_, _, size) in self._metadata().items() if size is not None}

    @classmethod
    def reach(cls, path: str, start: float, shape: tuple[int, int]) -> tuple[float, float]:
        """Return how far a fit may move a parameter at a dotted path that starts at a value.

        Widths and lags may move within a factor of five: readings are far from linear in them. Widths in
        pixels are limited to that of the array, of ``shape`` (H, W): a wider halo spreads the same light over
        all pixels, and only a quotient of its strength and width is identifiable.
        """
        if not cls.is_shape(path):
            return -np.inf, np.inf
        most = 5.0 * abs(start) + 1e-9
        if not cls.in_pixels.isdisjoint(path.split(".")):
            most = max(abs(start), min(most, float(max(shape))))
        return 0.2 * abs(start), most

    @classmethod
    def is_shape(cls, path: str) -> bool:
        """Return whether the parameter at a dotted path is a width or a lag."""
        return not cls.shapes.isdisjoint(path.split("."))

    def greatest(self, darkest: Sequence[tuple[float, float]]) -> dict[str, float]:
        """Return by dotted path the greatest values that amplitudes in use allow, where they limit them.

        ``darkest`` are the integration time and the least amplitude [counts] of each station.
        """
        return {}

    @classmethod
    def longest_step(cls, path: str, shape: tuple[int, int]) -> float:
        """Return how far a parameter, by dotted path, may go in one step of a fit; ``shape`` (H, W)."""
        return np.inf

    def own_covariates(self) -> frozenset[str]:
        """Return the covariates on which it depends; none where it acts on the light."""
        return frozenset()

    def rows(self) -> frozenset[float]:
        """Return the integration times for which it has rows of parameters."""
        return frozenset()

    @property
    def unmodulated_light(self) -> float:
        """Counts of unmodulated light that it adds, which add noise only."""
        return 0.0

    def rate(self, uptime: float) -> float:
        """Return the drift in metres per second at an uptime in seconds."""
        return 0.0

    @property
    def limit(self) -> str | None:
        """The name of the effect to which this one reduces, where its parameters have reached that limit."""
        return None

    def lean(self) -> Effect:
        """Return the effect without parts that have no influence; the effect itself where it has none."""
        return self

    @classmethod
    def resampled_number(cls, path: str, value: float, factor: float) -> float:
        """Return a parameter, by dotted path, for ``factor`` times as many pixels along each axis."""
        names = set(path.split("."))
        if names & cls.per_pixel:
            return value / factor
        return value * factor if names & cls.in_pixels else value

    def resampled(self, factor: float, step: int | None) -> Self:
        """Return the effect for ``factor`` times as many pixels along each axis, within its bounds.

        With a ``step``, every such pixel is picked, from pixel ``step // 2`` on.
        """
        bounds = self.bounds()
        numbers = {
            path: float(np.clip(self.resampled_number(path, value, factor), *bounds[path]))
            for path, value in flatten(self).items()
            if not (self.in_pixels | self.per_pixel).isdisjoint(path.split("."))
        }
        return with_values(self, numbers) if numbers else self

    def finest(self) -> Effect:
        """Return the effect in its most exact form, which takes longest to compute."""
        return self

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        """Yield its model discrepancy: derivatives of distance [m] and amplitude [counts] (H, W).

        These are smooth factors on its contribution (Kennedy and O'Hagan 2001).
        """
        for factor in (None, *change.factors):
            if factor is not None:
                yield change.distance * factor, None
            if change.amplitude is not None:
                nothing = np.zeros(change.distance.shape)
                yield nothing, change.amplitude if factor is None else change.amplitude * factor

    def graph(self, camera: Camera) -> Graph | None:
        """Return it as a curve over its covariate, for reports; None where it is no curve."""
        return None

    def _metadata(self) -> dict[str, tuple[float, float, float | None]]:
        return _metadata_of(self, "", (-np.inf, np.inf, None))


def _metadata_of(
    value: Any, prefix: str, inherited: tuple[float, float, float | None]
) -> dict[str, tuple[float, float, float | None]]:
    if isinstance(value, float):
        return {prefix[:-1]: inherited}
    result: dict[str, tuple[float, float, float | None]] = {}
    if hasattr(value, "__dataclass_fields__"):
        for field in fields(value):
            m = field.metadata
            own = (
                max(m.get("minimum", -np.inf), m.get("above", -np.inf)),
                min(m.get("maximum", np.inf), m.get("below", np.inf)),
                m.get("typical"),
            )
            result.update(_metadata_of(getattr(value, field.name), f"{prefix}{field.name}.", own))
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

    has_discrepancy = False

    @abstractmethod
    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        """Return the term in metres at the distance and amplitude that the optics deliver.

        NaN where it makes a measurement impossible.
        """

    def depends_on(self) -> frozenset[Dependency]:
        """Return the kinds of quantities on which the term depends, or a superset of them."""
        return frozenset({"settings"})

    #: whether its dependence on the pixel is a phase alone: it has `phase_shift` and `shifted`
    has_phase: ClassVar[bool] = False

    def distance_knots(self) -> tuple[float, ...]:
        """Return the knots of distance [m] between which it is linear, empty where it is not."""
        return ()

    def line_terms(self, saturated: NDArray[np.bool_]) -> tuple[Image, Image] | None:
        """Return the changes of all pixels of rows (H,) and of columns (W,) [m], if it acts by such lines.

        Saturated pixels themselves have no distance.
        """
        return None

    def own_covariates(self) -> frozenset[str]:
        return frozenset(self.depends_on())

    def graph(self, camera: Camera) -> Graph | None:
        """Return the term over distance or over amplitude where it depends on one of them alone."""
        from rim_camera_ros.effects.graph import over_amplitude, over_distance

        if self.depends_on() == {"distance"}:
            return over_distance(self, camera)
        return over_amplitude(self, camera) if self.depends_on() == {"amplitude"} else None

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

    Terms change by far less than a metre per metre: it contracts (the cyclic error by about 0.07 a step).
    """
    wraps = context.camera.sensor.wraps
    distance = measured
    for _ in range(60):
        previous = distance
        distance = measured - term(previous)
        if wraps:
            distance = wrap(distance, context.ambiguity)
        step = distance - previous
        step = wrap_residual(step, context.ambiguity) if wraps else step
        if not np.any(np.abs(step) > tolerance):
            break
    return distance


@dataclass(frozen=True)
class ComplexEffect(Effect):
    """A linear effect on the complex image S = A exp(i 2 pi d / L)."""

    @property
    def direct(self) -> float:
        """Share of the light of a pixel that arrives in the pixel itself or next to it."""
        return 1.0

    @property
    def margin(self) -> int | None:
        """Dark pixels around a part of the array with which `apply` needs no others (None: needs all)."""
        return None

    @property
    def has_inverse(self) -> bool:
        """Whether `invert` undoes it."""
        return type(self).invert is not ComplexEffect.invert

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
        if not self.has_inverse:
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


@dataclass(frozen=True)
class ResponseEffect(Effect):
    """The response by which the electronics publish the amplitude, one at most; distances do not change."""

    shows_in = "amplitude"
    is_response = True
    has_discrepancy = False

    @abstractmethod
    def compressed(self, amplitude: Image) -> Image:
        """Return the published amplitude in counts."""

    @abstractmethod
    def expanded(self, published: Image) -> Image:
        """Return the amplitude in counts of a published one; infinite where no light is so bright."""

    @abstractmethod
    def slope(self, amplitude: Image) -> Image:
        """Return the derivative of the published amplitude by the amplitude."""

    def simulate(self, signal: Signal, context: Context) -> Signal:
        return replace(signal, published=self.compressed(signal.amplitude))

    def correct(self, signal: Signal, context: Context) -> Signal:
        return replace(signal, amplitude=self.expanded(signal.published_amplitude), published=None)


def effect_of[E: Effect](camera: Camera, kind: type[E]) -> E | None:
    """Return the camera's effect of a kind, None where it has none."""
    return next((effect for effect in camera.effects.values() if isinstance(effect, kind)), None)


def response_of(camera: Camera) -> ResponseEffect | None:
    """Return the camera's amplitude response, None where it publishes the light unchanged."""
    return next((effect for effect in camera.effects.values() if isinstance(effect, ResponseEffect)), None)
