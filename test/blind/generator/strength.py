"""How large a left-out effect is, and the amount at which it is as large as wanted."""

from dataclasses import dataclass

import numpy as np

from .base import LeftOut
from .sensor import Array
from .world import Hidden, World

WELL_LIT = 120.0
"""Counts from which on a pixel belongs to the statistics of strength; below, sigma is above 33 mm."""


@dataclass
class Size:
    """An effect [m] per exposure and pixel, the single-frame sigma [m] there, and where both are defined.

    `lit` is the part of `valid` where the amplitude is at least `WELL_LIT`; RMS and median are over it.
    """

    metres: Array
    sigma: Array
    valid: "np.ndarray"
    lit: "np.ndarray"

    @property
    def strength(self) -> float:
        """RMS of the effect over the median single-frame sigma."""
        return self.rms / self.median_sigma

    @property
    def strength_local(self) -> float:
        """RMS of effect over its own pixel's sigma."""
        return float(np.sqrt(np.mean((self.metres[self.lit] / self.sigma[self.lit]) ** 2)))

    @property
    def rms(self) -> float:
        """RMS of the effect, metres."""
        return float(np.sqrt(np.mean(self.metres[self.lit] ** 2)))

    @property
    def median_sigma(self) -> float:
        """Median single-frame sigma, metres."""
        return float(np.median(self.sigma[self.lit]))

    def per_pixel(self) -> Array:
        """RMS over exposures of effect over sigma, (height, width); 0 where never valid."""
        squares = np.where(self.valid, (self.metres / self.sigma) ** 2, 0.0).sum(axis=0)
        return np.sqrt(squares / np.maximum(self.valid.sum(axis=0), 1)).astype(np.float32)


def size_of(world: World, hidden: Hidden) -> Size:
    """The effect of everything in `hidden` together: noise-free with it minus without it.

    Raises
    ------
    ValueError: nothing in the recording is lit well enough.
    """
    without, with_it = world.measure([]), world.measure(hidden)
    metres = with_it.distance
    for effect, amount in hidden:
        metres = effect.convert(metres, amount)
    metres = metres - without.distance
    amplitude = np.maximum(with_it.amplitude, 1.0)
    kinds = {effect.kind for effect, _ in hidden}
    if kinds == {"amplitude"}:
        # counts over sigma_A, in metres: sigma_A = (2 pi / L) A sigma
        change = with_it.published - without.published
        metres = change * world.camera.sensor.ambiguity / (2.0 * np.pi * amplitude)
    elif kinds == {"noise"}:
        metres = np.sqrt(with_it.extra_variance)
    valid = without.valid & with_it.valid
    lit = valid & (without.amplitude >= WELL_LIT)
    if not lit.any():
        raise ValueError("no pixel is lit well enough for a strength; take another seed")
    return Size(metres, world.camera.sigma(amplitude), valid, lit)


def amount_for(world: World, effect: LeftOut, strength: float, *, tolerance: float = 0.01) -> float:
    """The amount with which the effect alone has this strength, by a bracketed secant on logarithms.

    Where physics has a ceiling (`effect.largest`), the amount there if it is not enough.
    """
    low, high = 0.0, float(effect.largest)
    known: list[tuple[float, float]] = []
    amount = min(effect.start, high)
    for _ in range(14):
        reached = size_of(world, [(effect, amount)]).strength
        if abs(reached / strength - 1.0) < tolerance:
            return amount
        if reached < strength:
            if amount >= effect.largest:
                return amount
            low = amount
        else:
            high = amount
        known.append((amount, max(reached, 1e-9)))
        slope = 1.0
        if len(known) > 1 and known[-1][0] != known[-2][0]:
            (a0, s0), (a1, s1) = known[-2:]
            slope = float(np.clip(np.log(s1 / s0) / np.log(a1 / a0), 0.25, 4.0))
        following = amount * float(np.clip((strength / known[-1][1]) ** (1.0 / slope), 0.02, 20.0))
        if not low < following < high:
            following = high if np.isfinite(high) and high == effect.largest else 0.5 * (low + high)
        amount = following
    return amount
