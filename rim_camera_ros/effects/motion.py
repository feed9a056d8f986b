"""Motion while the four samples are taken one after the other (Kahlmann 2007, sec. 2.3.1, 1-tap)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Effect, Undo
from rim_camera_ros.effects.candidate import (
    Candidate,
    Coefficients,
    Facts,
    effect_block,
    linear,
    together,
    with_effect,
)
from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn
from rim_camera_ros.effects.signal import Column, Context, Image, Signal, from_phasor, phasor_derivative
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor

#: Least time between samples [s] at which the fit of a moving camera begins.
_SHORTEST = 1e-4


@dataclass(frozen=True)
class Motion(Effect):
    """Sample k (0..3) is taken at stamp + (k - 1.5) * sample_interval.

    Samples are c_k = Re(S(t_k) exp(-i k pi / 2)) + unmodulated |S(t_k)|, the offset B of eq. 2.5. The SR-3000
    subtracts B, the SR-2 does not (sec. 2.3.1), and while the camera moves it no longer cancels in c_0 - c_2
    and c_1 - c_3. What the earlier effects made of S is carried along as a factor per pixel.
    """

    name = "motion"
    title = "motion between the four samples"
    observable = "a moving camera (camera_motion) before edges or oblique surfaces"
    refuted_by = "errors that stay when the camera rests"
    undo: ClassVar[Undo] = "none"
    demodulates = True

    lacking = "the scene states no camera motion"
    planned = False
    shows_on_a_wall = False

    sample_interval: float = quantity("s", "time between two samples", minimum=0.0, typical=0.005)
    unmodulated: float | None = quantity(
        "-",
        "unmodulated over modulated light, where the camera does not subtract it",
        default=None,
        minimum=0.0,
        typical=1.0,
    )

    def _sampled(self, signal: Signal, context: Context, interval: float, offset: float) -> Image:
        if context.geometry_at is None:
            raise InputError("motion needs the scene's geometry", remedy="simulate a scene file")
        here = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        geometry, amplitude = context.geometry_at(0.0)
        ideal = to_phasor(geometry.distance, amplitude, context.ambiguity)
        factor = np.divide(here, ideal, out=np.ones_like(here), where=ideal != 0)
        parts = []
        for k in range(4):
            geometry, amplitude = context.geometry_at((k - 1.5) * interval)
            moved = factor * to_phasor(geometry.distance, amplitude, context.ambiguity)
            parts.append(np.real(moved * (-1j) ** k) + offset * np.abs(moved))
        result: Image = ((parts[0] - parts[2]) + 1j * (parts[1] - parts[3])) / 2
        return result

    def simulate(self, signal: Signal, context: Context) -> Signal:
        if context.geometry_at is None or not context.moving:
            return signal
        return from_phasor(self._now(signal, context), signal, context)

    def _now(self, signal: Signal, context: Context) -> Image:
        return self._sampled(signal, context, self.sample_interval, self.unmodulated or 0.0)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        """Central difference over 10 us: the scene is a function of time only by its rays."""
        paths = ["sample_interval", *(["unmodulated"] if self.unmodulated is not None else [])]
        if not context.moving:
            zero = np.zeros_like(signal.distance)
            return dict.fromkeys(paths, (zero, zero))
        step, offset, interval = 1e-5, self.unmodulated or 0.0, self.sample_interval
        after = self._sampled(signal, context, interval + step, offset)
        before = self._sampled(signal, context, max(interval - step, 0.0), offset)
        changes = [(after - before) / (step + min(step, interval))]
        middle = self._now(signal, context)
        if self.unmodulated is not None:
            changes.append(self._sampled(signal, context, interval, offset + 1.0) - middle)
        return {
            path: phasor_derivative(middle, change, context.ambiguity)
            for path, change in zip(paths, changes, strict=True)
        }

    def sentence(self) -> str:
        rest = (
            f"; {self.unmodulated:.2g} of unmodulated light to each of modulated stays in them"
            if self.unmodulated
            else ""
        )
        return (
            f"motion: the four samples are taken {self.sample_interval * 1e3:.2g} ms apart{rest}; while the "
            "camera moves, edges and oblique surfaces are measured wrong"
        )

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        """Linear in the interval, and in its product with the share of unmodulated light."""
        if not facts.moves:
            return []
        prior = {"sample_interval": 0.003}
        alone = effect_block(cls(sample_interval=0.0), prior, label="@modulated")
        both = effect_block(cls(sample_interval=0.0, unmodulated=1.0), prior, label="@unmodulated")

        def build(other: Camera, values: Coefficients) -> Camera:
            product = max(values[both.regressors[0].label], 0.0)
            interval = max(values[alone.regressors[0].label] + product, _SHORTEST)
            return with_effect(other, Motion(sample_interval=interval, unmodulated=product / interval))

        positive = (both.regressors[0].label,)
        unmodulated = Candidate(cls.name, "unmodulated", together(alone, both), build, positive)
        return [linear(cls(sample_interval=0.0), prior), unmodulated]

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        """Smooth factors, and a time that differs from row to row, as with a rolling shutter."""
        yield from super().discrepancy(change)
        context = change.reading.context
        assert context.geometry_at is not None
        (before, light), (after, more) = context.geometry_at(-0.0005), context.geometry_at(0.0005)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where((light > 0) & (more > 0), np.log(more / light), 0.0)
        turned = 2 * np.pi / context.ambiguity * np.nan_to_num(after.distance - before.distance)
        distance, amplitude = change.reading.light_change(None, np.nan_to_num(relative) + 1j * turned)
        for factor in (np.ones(1), *change.factors[:2]):
            yield distance * factor, amplitude * factor

    @classmethod
    def example(cls, camera: Camera) -> Motion:
        return cls(sample_interval=0.004, unmodulated=0.7)
