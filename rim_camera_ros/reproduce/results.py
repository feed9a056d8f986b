"""Results of an experiment of the reproduction: rows compared with printed numbers, pictures, tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rim_camera_ros.reports.figures import Map, Panel

#: Share of the printed number, and number of standard deviations of ours, by which a row may deviate.
SHARE, SIGMAS = 0.1, 2.0


@dataclass(frozen=True)
class Printed:
    """A printed value of the thesis: a number (``low`` = ``high``), a range, or a bound (other end infinite).

    ``text``: as printed.
    """

    low: float
    high: float
    text: str

    @classmethod
    def number(cls, value: float, text: str | None = None) -> Printed:
        """Return a single number; ``text`` defaults to the number itself."""
        return cls(value, value, f"{value:g}" if text is None else text)

    def deviation(self, ours: float) -> float:
        """Return ours - printed; for a range the difference from its nearer end, 0 inside."""
        if ours < self.low:
            return ours - self.low
        return max(ours - self.high, 0.0)


@dataclass(frozen=True)
class Row:
    """One printed number and the result of the simulated experiment, both in ``unit``.

    ``ours`` is None where the number cannot be reproduced; then ``how`` states the reason. ``sigma``: 1-sigma
    of ours by the noise of the simulated measurements, None where there is none or it was not estimated.
    ``digits``: number of decimals that are shown. ``how``: description of simulation and reduction. ``why``:
    reason of a deviation, empty where none needs an explanation.
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
        """Largest deviation in ``unit``: a tenth of the printed number, or twice the sigma of ours.

        The greater of the two counts. For a range or a bound the end nearer to ours is used.
        """
        near = (
            self.printed.low if self.ours is not None and self.ours < self.printed.low else self.printed.high
        )
        share = SHARE * abs(near) if math.isfinite(near) else 0.0
        return max(share, SIGMAS * (self.sigma or 0.0))

    @property
    def within_tolerance(self) -> bool | None:
        """Whether ours deviates by no more than `tolerance`; None where it was not reproduced."""
        if self.deviation is None:
            return None
        return bool(abs(self.deviation) <= self.tolerance * (1 + 1e-9))


@dataclass(frozen=True)
class Picture:
    """Curves or maps in the manner of a figure of the thesis; ``name`` becomes the name of the file.

    Either ``panels`` or ``maps`` are given; ``unit``: that of the maps.
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
    """All results of one experiment."""

    rows: tuple[Row, ...]
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = field(default=())
