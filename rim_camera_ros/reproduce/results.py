"""What an experiment of the reproduction hands back: rows beside printed numbers, pictures, tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rim_camera_ros.reports.figures import Map, Panel

#: Share of a printed number, and standard deviations of ours, by which a row may deviate.
SHARE, SIGMAS = 0.1, 2.0


@dataclass(frozen=True)
class Printed:
    """What the thesis prints: a number (``low`` = ``high``), a range, or a bound (the other end infinite).

    ``text`` is how it stands there.
    """

    low: float
    high: float
    text: str

    @classmethod
    def number(cls, value: float, text: str | None = None) -> Printed:
        """Return a single number; ``text`` defaults to the number itself."""
        return cls(value, value, f"{value:g}" if text is None else text)

    def deviation(self, ours: float) -> float:
        """Return ours - printed; from a range the distance to its nearer end, 0 inside."""
        if ours < self.low:
            return ours - self.low
        return max(ours - self.high, 0.0)


@dataclass(frozen=True)
class Row:
    """One printed number and what the simulated experiment gives, both in ``unit``.

    ``ours`` is None where the number cannot be reproduced, and ``how`` then says why. ``sigma``: 1-sigma of
    ours from the noise of the simulated measurements, None where it has none or was not estimated.
    ``digits``: decimals that are shown. ``how``: what was simulated and how it was reduced. ``why``: reason
    of a deviation, empty where there is none to explain.
    """

    quantity: str
    source: str
    printed: Printed
    ours: float | None
    unit: str
    how: str
    digits: int = 1
    sigma: float | None = None
    why: str = ""

    @property
    def deviation(self) -> float | None:
        """Ours minus printed in ``unit``, see `Printed.deviation`."""
        if self.ours is None or not math.isfinite(self.ours):
            return None
        return self.printed.deviation(self.ours)

    @property
    def tolerance(self) -> float:
        """What ours may deviate in ``unit``: a tenth of what is printed, or twice its own sigma if greater.

        Of a range or a bound the end that is nearer to ours counts.
        """
        near = (
            self.printed.low if self.ours is not None and self.ours < self.printed.low else self.printed.high
        )
        share = SHARE * abs(near) if math.isfinite(near) else 0.0
        return max(share, SIGMAS * (self.sigma or 0.0))

    @property
    def within_tolerance(self) -> bool | None:
        """Whether ours is as near to what is printed as `tolerance`; None where it was not reproduced."""
        if self.deviation is None:
            return None
        return bool(abs(self.deviation) <= self.tolerance * (1 + 1e-9))


@dataclass(frozen=True)
class Picture:
    """Curves or maps in the manner of a figure of the thesis; ``name`` becomes the name of the file.

    Either ``panels`` or ``maps`` are given; ``unit`` is that of the maps.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...] = ()
    maps: tuple[Map, ...] = ()
    unit: str = ""
    columns: int = 3


@dataclass(frozen=True)
class Table:
    """Further numbers of an experiment, as text."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """Everything that one experiment gives."""

    rows: tuple[Row, ...]
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = field(default=())
