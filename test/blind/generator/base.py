"""What a left-out effect can do to the image."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .sensor import Array

if TYPE_CHECKING:
    from .world import World

FORMS = ("tuning", "scoring")


@dataclass
class State:
    """Noise-free distance [m] and amplitude [counts] delivered by scene and optics, (n, height, width)."""

    distance: Array
    amplitude: Array


class LeftOut:
    """One left-out effect in one of its two forms, with the parameters that were drawn for it.

    A subclass overrides what it needs; `amount` is the one number by which its strength is set, in the unit
    that the subclass states.
    """

    name: ClassVar[str]
    stage: ClassVar[int] = 9
    """Order in which effects on the complex image act: scene, optics, sensor."""
    acts_on_image: ClassVar[bool] = False
    per_frame: ClassVar[bool] = False
    kind: ClassVar[str] = "distance"
    """What strength refers to: `distance`, `amplitude` or `noise`."""
    start: ClassVar[float] = 0.01
    largest: float = np.inf
    covariates: ClassVar[tuple[str, ...]] = ()
    """For physics outside the vocabulary: the covariates it depends on."""

    def __init__(self, world: "World", form: str, rng: np.random.Generator) -> None:
        self.world, self.form = world, form
        self.drawn: dict[str, Any] = {}
        self.draw(rng)

    @property
    def tuning(self) -> bool:
        """True for the form on which thresholds are tuned."""
        return self.form == "tuning"

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the form's parameters into `drawn`."""

    def image(self, light: "np.ndarray", amount: float) -> "np.ndarray":
        """The complex image after the effect."""
        return light

    def metres(self, state: State, amount: float) -> Array | float:
        """The term in metres at the noise-free state."""
        return 0.0

    def published(self, amplitude: Array, amount: float) -> Array:
        """The published amplitude, counts."""
        return amplitude

    def extra_variance(self, state: State, amount: float) -> Array | float:
        """Additional variance of one distance, m^2."""
        return 0.0

    def convert(self, distance: Array, amount: float) -> Array:
        """What the converter makes of the noisy distance, metres."""
        return distance

    def exposure(self, values: Array) -> Array:
        """One value per exposure, for broadcasting over the image."""
        return np.asarray(values, float)[:, None, None]
