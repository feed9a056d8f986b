"""LEDs beside the lens (Kahlmann 2007, sec. 3.3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import (
    Block,
    Candidate,
    Coefficients,
    Facts,
    Reading,
    Regressor,
    effect_block,
    linear,
    together,
    with_effect,
)
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.parameters import quantity

#: Where variants begin [m]: LEDs stand about so far beside a lens, to one side of it or above.
_PLACES = ((0.03, 0.0, 0.0), (0.0, 0.03, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0))
#: 1-sigma [m] of how far from there.
_MOVED = 0.03


@dataclass(frozen=True)
class EmitterOffset(Effect):
    """The light travels from the emitter at e to the point P and back: d = (|P| + |P - e|) / 2.

    distance^2 in the radiometry becomes |P - e|^2.
    """

    name = "emitter_offset"
    title = "emitter beside the lens"
    observable = "near surfaces (below 1 m) at several distances and directions"
    refuted_by = "a distance error that does not decrease with distance as 1 / d beyond its constant part"
    pointwise = True
    absolute = True

    steady = True
    discrepancy_is_determined = False

    position: tuple[float, float, float] = quantity("m", "e in the optical frame", typical=0.03)

    def _paths(self, length: Image, context: Context) -> tuple[Image, Image]:
        """Return P - e (H, W, 3) and its length for points at ``length`` along the rays."""
        beside = length[..., None] * context.rays - np.array(self.position)
        return beside, np.linalg.norm(beside, axis=-1)

    def simulate(self, signal: Signal, context: Context) -> Signal:
        length = signal.distance
        _, out = self._paths(length, context)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(out > 0, (length / out) ** 2, 1.0)
        factor = np.where(np.isfinite(factor), factor, 1.0)
        return replace(signal, distance=(length + out) / 2, amplitude=signal.amplitude * factor)

    def correct(self, signal: Signal, context: Context) -> Signal:
        """Solve |P| + |P - e| = 2 d in closed form: |P| = (4 d^2 - |e|^2) / (4 d - 2 ray . e)."""
        length = self.length(signal.distance, context.rays @ np.array(self.position))
        _, out = self._paths(length, context)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(length > 0, (out / length) ** 2, 1.0)
        factor = np.where(np.isfinite(factor), factor, 1.0)
        return replace(signal, distance=length, amplitude=signal.amplitude * factor)

    def length(self, half_path: Image, ray_dot_emitter: Image) -> Image:
        """Return |P| in metres for half the path; NaN where no point has so short a path."""
        square = sum(e * e for e in self.position)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = (4 * half_path**2 - square) / (4 * half_path - 2 * ray_dot_emitter)
            return np.where(half_path * 2 > np.sqrt(square), result, np.nan).astype(half_path.dtype)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        length = signal.distance
        beside, out = self._paths(length, context)
        result: dict[str, Column] = {}
        for i in range(3):
            with np.errstate(divide="ignore", invalid="ignore"):
                by_out = -beside[..., i] / out
                by_amplitude = -2 * signal.amplitude * length**2 / out**3 * by_out
            result[f"position.{i}"] = (by_out / 2, np.where(np.isfinite(by_amplitude), by_amplitude, 0.0))
        return result

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        """At the lens, and at several places beside it.

        To first order an emitter is an offset of each pixel, -ray . e / 2, which the fixed pattern absorbs. A
        linearisation at e = 0 does not contain the rest, (|e|^2 - (ray . e)^2) / (4 d).
        """
        base = cls(position=(0.0, 0.0, 0.0))
        at_lens = linear(base, {"position.0": 0.05, "position.1": 0.05, "position.2": 0.05})
        return [at_lens, *(_beside(cls(position)) for position in _PLACES)]

    def sentence(self) -> str:
        beside = float(np.linalg.norm(self.position)) * 1e3
        return (
            f"emitter offset: the light leaves {beside:.0f} mm from the lens; "
            "near and oblique surfaces are measured along another path than back"
        )

    @classmethod
    def example(cls, camera: Camera) -> EmitterOffset:
        return cls(position=(0.02, -0.035, 0.004))


def _beside(start: EmitterOffset) -> Candidate:
    """The whole effect of an emitter at a place, with a prior of 1, and the derivatives there."""
    name, place = start.name, start.position
    variant = f"{1e3 * place[0]:g}, {1e3 * place[1]:g} mm"
    share = f"effects.{name}.share@{variant}"
    moved = effect_block(
        start, dict.fromkeys((f"position.{i}" for i in range(3)), _MOVED), label=f"@{variant}"
    )

    def whole(reading: Reading) -> list[tuple[Image, Image]]:
        before = reading.before_effect(name)
        after = start.simulate(before, reading.context)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(before.amplitude > 0, np.log(after.amplitude / before.amplitude), 0.0)
        turned = 2 * np.pi / reading.context.ambiguity * (after.distance - before.distance)
        return [reading.light_change(name, np.nan_to_num(relative) + 1j * np.nan_to_num(turned))]

    def build(camera: Camera, values: Coefficients) -> Camera:
        x, y, z = (
            values[share] * e + values[regressor.label]
            for e, regressor in zip(place, moved.regressors, strict=True)
        )
        return with_effect(camera, EmitterOffset(position=(float(x), float(y), float(z))))

    block = together(Block((Regressor(share, name, 1.0),), whole, pointwise=True), moved)
    return Candidate(name, variant, block, build)
