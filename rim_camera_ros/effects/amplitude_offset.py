"""Amplitude-dependent distance (Kahlmann 2007, sec. 3.3.5, eqs. 3.6, 3.7, table 3.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.candidate import (
    TERM_SIZE,
    Candidate,
    Coefficients,
    Facts,
    effect_block,
    with_effect,
)
from rim_camera_ros.effects.graph import Graph, Line, amplitudes_of, millimetres
from rim_camera_ros.effects.rows import combine_rows, need_rows, row_name, row_weights
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class Hyperbola:
    """a / (A - b)."""

    a: float = quantity("m*counts", "strength", typical=250.0)
    b: float = quantity("counts", "pole", typical=10.0)


@dataclass(frozen=True)
class AmplitudeOffset(DistanceTerm):
    """+ a / (A - b), by rows per integration time; no measurement where A <= b + 1 count."""

    has_discrepancy = True
    name = "amplitude_offset"
    title = "amplitude-dependent distance"
    observable = "patches of different reflectivity side by side on one plane (a grey wedge)"
    refuted_by = "dark and bright patches of one plane at the same distance"

    pointwise = True
    drawn_over = ("amplitude",)
    everywhere = True

    hyperbola: Mapping[float, Hyperbola] = quantity("-", "by integration time")

    def __post_init__(self) -> None:
        need_rows(self.hyperbola, "hyperbola")

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"amplitude", "settings"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        def row(hyperbola: Hyperbola) -> Image:
            usable = amplitude > hyperbola.b + 1.0
            return np.where(usable, hyperbola.a / np.where(usable, amplitude - hyperbola.b, 1.0), np.nan)

        return combine_rows(self.hyperbola, context, row)

    def slope(self, amplitude: Image, context: Context) -> Image | float:
        """Return d term / d A in m/count (NaN where there is no measurement)."""

        def row(hyperbola: Hyperbola) -> Image:
            usable = amplitude > hyperbola.b + 1.0
            return np.where(
                usable, -hyperbola.a / np.where(usable, amplitude - hyperbola.b, 1.0) ** 2, np.nan
            )

        return combine_rows(self.hyperbola, context, row)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        result: dict[str, Column] = {}
        weights = dict(row_weights(self.hyperbola, lambda: context.integration_time))
        for key, hyperbola in self.hyperbola.items():
            weight = weights.get(key, 0.0)
            usable = signal.amplitude > hyperbola.b + 1.0
            safe = np.where(usable, signal.amplitude - hyperbola.b, 1.0)
            prefix = f"hyperbola.{row_name(key)}"
            result[f"{prefix}.a"] = (np.where(usable, weight / safe, np.nan), 0.0)
            result[f"{prefix}.b"] = (np.where(usable, weight * hyperbola.a / safe**2, np.nan), 0.0)
        return result

    def sentence(self) -> str:
        parts = []
        rows = sorted(self.hyperbola.items())
        near = all(hyperbola.a < 0 for _, hyperbola in rows)
        for key, hyperbola in rows:
            # of a negative pole, too, at an amplitude that a pixel can have
            at = max(hyperbola.b, 0.0) + max(2.0, abs(hyperbola.a) / 0.05)
            size = hyperbola.a / (at - hyperbola.b) * (-1e3 if near else 1e3)
            parts.append(f"{size:.0f} mm at {at:.0f} counts (setting {row_name(key)})")
        where = "near" if near else "far"
        return f"amplitude-dependent distance: dark surfaces are measured too {where}, by " + ", ".join(parts)

    def rows(self) -> frozenset[float]:
        return frozenset(self.hyperbola)

    def priors(self) -> dict[str, float]:
        result = {}
        for key, hyperbola in self.hyperbola.items():
            result[f"hyperbola.{row_name(key)}.a"] = max(abs(hyperbola.a), 1e-3)
            result[f"hyperbola.{row_name(key)}.b"] = max(abs(hyperbola.b), 0.02 * abs(hyperbola.a))
        return result

    @classmethod
    def reach(cls, path: str, start: float, shape: tuple[int, int]) -> tuple[float, float]:
        limit = 10 * abs(start) + 5.0
        return (-limit, limit) if path.endswith(".b") else (-np.inf, np.inf)

    def greatest(self, darkest: Sequence[tuple[float, float]]) -> dict[str, float]:
        """The pole of each row must lie below the amplitudes in use."""
        lowest: dict[float, float] = {}
        for t, level in darkest:
            key = min(self.hyperbola, key=lambda row: abs(row - t))
            lowest[key] = min(lowest.get(key, np.inf), level)
        return {
            f"hyperbola.{row_name(key)}.b": max(0.9 * level, self.hyperbola[key].b, -self.hyperbola[key].b)
            for key, level in lowest.items()
        }

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        """A / (A - b) ~ a / A + a b / A^2, per integration time."""
        return [_variant(facts, curved=curved) for curved in (False, True)]

    def graph(self, camera: Camera) -> Graph:
        x = amplitudes_of(camera)
        lines = []
        for key, hyperbola in self.hyperbola.items():
            lit = x[x > hyperbola.b + 1]
            value = millimetres(camera, np.ones_like(lit), lit, integration_time=key)
            lines.append(Line(lit, value, f"setting {row_name(key)}"))
        return Graph("amplitude", "amplitude [counts]", "error [mm]", tuple(lines), log=True)

    @classmethod
    def example(cls, camera: Camera) -> AmplitudeOffset:
        rows = {16.0: Hyperbola(85.71, 0.995), 60.0: Hyperbola(237.0, 15.71), 100.0: Hyperbola(383.3, 4.036)}
        return cls(hyperbola=MappingProxyType(rows))


def _variant(facts: Facts, *, curved: bool) -> Candidate:
    base = AmplitudeOffset(
        hyperbola=MappingProxyType({t: Hyperbola(1.0, 0.0) for t in facts.integration_times})
    )
    size = TERM_SIZE * max(facts.amplitude, 1.0)
    priors: dict[str, float] = {}
    for t in facts.integration_times:
        priors[f"hyperbola.{row_name(t)}.a"] = size
        if curved:
            priors[f"hyperbola.{row_name(t)}.b"] = size * 0.2 * facts.amplitude
    variant = "a,b" if curved else "a"
    block = effect_block(base, priors, label=f"@{variant}")
    labels = dict(zip(priors, (regressor.label for regressor in block.regressors), strict=True))

    def build(camera: Camera, values: Coefficients) -> Camera:
        rows = {}
        lowest = max(camera.sensor.amplitude_threshold, 0.02 * facts.amplitude)
        for t in facts.integration_times:
            a = values[labels[f"hyperbola.{row_name(t)}.a"]]
            square = values[labels[f"hyperbola.{row_name(t)}.b"]] if curved else 0.0
            b = float(np.clip(square / a, -0.5 * lowest, 0.5 * lowest)) if abs(a) > 1e-9 else 0.0
            rows[t] = Hyperbola(float(a), b)
        return with_effect(camera, AmplitudeOffset(hyperbola=MappingProxyType(rows)))

    return Candidate(AmplitudeOffset.name, variant, block, build)
