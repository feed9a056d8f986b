"""Gates that open later or longer than the camera file says (Kahlmann 2007, sec. 2.3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.signal import Column, Context, Image, Signal
from rim_camera_ros.gated.estimation import GateEstimator
from rim_camera_ros.gated.gates import Gate, GatedShutter
from rim_camera_ros.parameters import quantity

#: Places of the table over the ambiguity range; light in counts at which the gates are evaluated.
_PLACES, _LIGHT = 2048, 1e4
#: Step in seconds of the numerical derivatives.
_STEP = 1e-11


@dataclass(frozen=True)
class GateTiming(DistanceTerm):
    """+ D(g'(d)) - d, where g' are the shares of the true gates and D evaluates them as the stated ones.

    A true gate opens ``delay`` later and is open ``width`` longer than the one that ``measurement`` states.
    All gates later by t measure c t / 2 too short; one of them bends the distances over the range.
    """

    name = "gate_timing"
    title = "gates that open at other times than stated"
    observable = "known distances over the whole range of the gates"
    refuted_by = "residuals that change with anything but the distance"

    delay: tuple[float, ...] = quantity(
        "s", "by which each gate opens late", minimum=-1e-7, maximum=1e-7, typical=5e-10
    )
    width: tuple[float, ...] = quantity(
        "s", "by which each gate is open longer", minimum=-1e-7, maximum=1e-7, typical=5e-10
    )

    def check(self, camera: Camera) -> None:
        """Raise ValueError where the camera has no gates, or others in number."""
        gates = getattr(camera.measurement, "gates", None)
        if gates is None:
            raise ValueError("this camera has no gates: see measurement")
        if not len(gates) == len(self.delay) == len(self.width):
            raise ValueError(f"give {len(gates)} numbers for delay and for width, one for each gate")

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"distance"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        if not any(self.delay) and not any(self.width):
            return np.zeros_like(distance)
        shutter, background = _stated(context)
        return _at(distance, shutter, _table(shutter, background, self.delay, self.width))

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        """Central differences: the distances by the gates have no simple closed form."""
        shutter, background = _stated(context)
        result: dict[str, Column] = {}
        for name in ("delay", "width"):
            for i in range(len(self.delay)):
                two = []
                for step in (_STEP, -_STEP):
                    values = {"delay": list(self.delay), "width": list(self.width)}
                    values[name][i] += step
                    two.append(_table(shutter, background, tuple(values["delay"]), tuple(values["width"])))
                change = (two[0] - two[1]) / (2.0 * _STEP)
                result[f"{name}.{i}"] = (_at(np.asarray(signal.distance), shutter, change), 0.0)
        return result

    def sentence(self) -> str:
        parts = [
            f"gate {i} opens {late * 1e12:+.0f} ps late and stays open {longer * 1e12:+.0f} ps longer"
            for i, (late, longer) in enumerate(zip(self.delay, self.width, strict=True))
            if late or longer
        ]
        return "gate timing: " + ("; ".join(parts) or "as stated")

    @classmethod
    def example(cls, camera: Camera) -> GateTiming:
        count = len(camera.measurement.gates)
        return cls(delay=(0.0, 3e-10, *[0.0] * (count - 2)), width=(1e-10, *[0.0] * (count - 1)))


def _stated(context: Context) -> tuple[GatedShutter, float]:
    camera = context.camera
    shutter: GatedShutter = camera.measurement.shutter(camera)
    return shutter, camera.background


def _at(distance: Image, shutter: GatedShutter, table: Image) -> Image:
    """Return a table over the ambiguity range at distances [m]."""
    grid = np.arange(_PLACES) * (shutter.ambiguity / _PLACES)
    found = np.interp(np.mod(distance, shutter.ambiguity), grid, table)
    return np.asarray(found, distance.dtype)


@lru_cache(maxsize=256)
def _table(
    shutter: GatedShutter, background: float, delay: tuple[float, ...], width: tuple[float, ...]
) -> Image:
    """Return D(g'(d)) - d [m] over the ambiguity range, held constant where the gates determine nothing."""
    true = GatedShutter(
        gates=tuple(
            Gate(delay=gate.delay + late, width=gate.width + longer)
            for gate, late, longer in zip(shutter.gates, delay, width, strict=True)
        ),
        pulse_width=shutter.pulse_width,
        rise_time=shutter.rise_time,
        read_noise=shutter.read_noise,
        black_level=shutter.black_level,
        pulse_rate=shutter.pulse_rate,
    )
    grid = np.arange(_PLACES) * (shutter.ambiguity / _PLACES)
    light = _LIGHT * true.shares(grid) + background * true.windows[:, None]
    found = _estimator(shutter, background).estimate(light).distance - grid
    # where a neighbour's light is seen, this distance is not determined
    known = np.isfinite(found) & (np.abs(found) < 0.25 * shutter.ambiguity)
    if not known.any():
        return np.zeros(_PLACES)
    return np.asarray(np.interp(grid, grid[known], found[known]))


@lru_cache(maxsize=16)
def _estimator(shutter: GatedShutter, background: float) -> GateEstimator:
    return GateEstimator(shutter, background=background)
