"""Drift after power-on (Kahlmann 2007, secs. 3.3.7, 4.3.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.candidate import TERM_SIZE, Candidate, Facts, linear
from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn
from rim_camera_ros.effects.graph import POINTS, Graph, Line
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity

#: Time constants of the model discrepancy of a drift, relative to those of its exponentials: bodies and
#: boards warm up at several rates.
_RATES = (0.25, 0.5, 2.0, 4.0)


@dataclass(frozen=True)
class Exponential:
    """amplitude * exp(-uptime / time_constant)."""

    amplitude: float = quantity("m", "at power-on", typical=0.05)
    time_constant: float = quantity("s", "decay", above=0.0, typical=200.0)


@dataclass(frozen=True)
class WarmUpDrift(DistanceTerm):
    """+ sum of amplitude * exp(-uptime / time_constant); without uptime off, which is said."""

    name = "warm_up_drift"
    title = "drift after power-on"
    observable = "a fixed scene from power-on until it is stable (SR-3000 6 min, SR-2 12 min), with uptime"
    refuted_by = "a drift that does not start at power-on"

    pointwise = True
    lacking = "the recordings state no uptime, or a constant one"
    in_time = True
    from_one_pose = True
    everywhere = True
    drifts = True
    settles = True
    has_discrepancy = True
    drawn_over = ("uptime", "time")
    shapes = frozenset({"time_constant"})

    terms: tuple[Exponential, ...] = quantity("-", "sum of exponentials", most=16)

    def __post_init__(self) -> None:
        if not self.terms:
            raise ValueError("terms is empty: give at least one")

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        uptime = context.settings.uptime
        if uptime is None:
            context.notes.add("warm_up_drift is off: the recording states no uptime")
            return 0.0
        return float(sum(term.amplitude * np.exp(-uptime / term.time_constant) for term in self.terms))

    def rate(self, uptime: float) -> float:
        """Return the drift in metres per second at an uptime in seconds."""
        return float(
            sum(
                -term.amplitude / term.time_constant * np.exp(-uptime / term.time_constant)
                for term in self.terms
            )
        )

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        uptime = context.settings.uptime
        ones = np.ones_like(signal.distance)
        result: dict[str, Column] = {}
        for i, term in enumerate(self.terms):
            decay = 0.0 if uptime is None else float(np.exp(-uptime / term.time_constant))
            by_constant = 0.0 if uptime is None else term.amplitude * decay * uptime / term.time_constant**2
            result[f"terms.{i}.amplitude"] = (ones * decay, 0.0)
            result[f"terms.{i}.time_constant"] = (ones * by_constant, 0.0)
        return result

    def sentence(self) -> str:
        parts = [
            f"{term.amplitude * 1e3:+.0f} mm decaying over {term.time_constant:.0f} s" for term in self.terms
        ]
        return "warm-up: after power-on distances drift by " + " and ".join(parts)

    def own_covariates(self) -> frozenset[str]:
        return frozenset({"settings", "time"})

    def priors(self) -> dict[str, float]:
        result = {}
        for i, term in enumerate(self.terms):
            result[f"terms.{i}.amplitude"] = max(abs(term.amplitude), 0.02)
            result[f"terms.{i}.time_constant"] = 0.5 * term.time_constant
        return result

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        if facts.uptime is None or facts.uptime[1] - facts.uptime[0] < 1.0:
            return []
        grid = [t for t in (15.0, 40.0, 100.0, 250.0, 600.0, 1500.0) if t > facts.uptime[0] / 6]
        size = {"terms.0.amplitude": TERM_SIZE}
        found = [linear(cls(terms=(Exponential(0.0, t),)), size, f"{t:g} s") for t in grid]
        size["terms.1.amplitude"] = TERM_SIZE
        for slow, fast in ((600.0, 60.0), (250.0, 25.0)):
            base = cls(terms=(Exponential(0.0, fast), Exponential(0.0, slow)))
            found.append(linear(base, size, f"{fast:g}+{slow:g} s"))
        return found

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        uptime = change.reading.context.settings.uptime
        for term in self.terms:
            for rate in _RATES:
                decay = 0.0 if uptime is None else float(np.exp(-uptime / (rate * term.time_constant)))
                yield np.full(change.distance.shape, decay), None

    def graph(self, camera: Camera) -> Graph:
        x = np.linspace(0.0, 5 * max(term.time_constant for term in self.terms), POINTS)

        def value(warm_up_drift: WarmUpDrift) -> Image:
            return 1e3 * np.asarray(
                sum(t.amplitude * np.exp(-x / t.time_constant) for t in warm_up_drift.terms)
            )

        line = Line(x / 60, value)
        return Graph("warm-up", "time since power-on [min]", "error [mm]", (line,), compared=True)

    @classmethod
    def example(cls, camera: Camera) -> WarmUpDrift:
        return cls(terms=(Exponential(-0.07, 23.0), Exponential(-0.025, 140.0)))
