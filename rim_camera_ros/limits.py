"""Bounds of the numbers in camera and scene files: those of each parameter, and general ones by unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

#: Largest absolute value of a number by its unit: sums of squares of larger ones have no meaning.
_LARGEST = {"m": 1e6, "px": 1e5, "s": 1e9, "counts": 1e9, "rad": 1e6, "degC": 1e4, "Hz": 1e12}
_LARGEST_OF_OTHERS, _SMALLEST_POSITIVE = 1e12, 1e-9


@dataclass(frozen=True)
class Limits:
    """The bounds of a number, and whether the number may equal each of them."""

    low: float
    high: float
    with_low: bool = True
    with_high: bool = True


def limits(metadata: Mapping[str, Any]) -> Limits:
    """Return the bounds of the numbers of a field that `parameters.quantity` describes by ``metadata``."""
    minimum, above = metadata.get("minimum", -math.inf), metadata.get("above", -math.inf)
    maximum, below = metadata.get("maximum", math.inf), metadata.get("below", math.inf)
    largest = _LARGEST.get(metadata.get("unit", ""), _LARGEST_OF_OTHERS)
    low, high = max(minimum, above, -largest), min(maximum, below, largest)
    if low == above == 0:
        return Limits(_SMALLEST_POSITIVE, high, with_high=high < below)
    return Limits(low, high, with_low=low > above, with_high=high < below)


def fault_of(value: float, metadata: Mapping[str, Any]) -> str | None:
    """Return in words which bound a number violates, with its unit; None if it is within the bounds."""
    bounds = limits(metadata)
    if metadata.get("above") == 0 and value <= 0:
        words, bound = "greater than", 0.0
    elif value < bounds.low or (value == bounds.low and not bounds.with_low):
        words, bound = ("at least" if bounds.with_low else "greater than"), bounds.low
    elif value > bounds.high or (value == bounds.high and not bounds.with_high):
        words, bound = ("at most" if bounds.with_high else "less than"), bounds.high
    else:
        return None
    unit = metadata.get("unit", "")
    return f"must be {words} {bound:g}" + (f" {unit}" if unit and unit != "-" else "")
