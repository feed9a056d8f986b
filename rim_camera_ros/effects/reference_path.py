"""Internal reference path (Kahlmann 2007, chapter 4, eqs. 4.1-4.6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Context, Effect, Signal, Undo
from rim_camera_ros.parameters import quantity


@dataclass(frozen=True)
class ReferencePath(Effect):
    """A path of known length that drifts like the external one, by 1 / scale of it.

    The reference measures nominal + drift / scale, drift being the sum of ``warm_up_drift`` and
    ``ambient_temperature``, in ``pixels`` (u0 v0 u1 v1, inclusive) or on the reference topic. The
    correction subtracts scale * (measured reference - nominal) (eqs. 4.4, 4.5) in place of those two
    terms where the frame has a reference, and falls back on them where it has not. Eq. 4.6 prints the
    linearity correction of the reference as a factor; it is additive, and constant up to the drift.
    """

    name = "reference_path"
    title = "internal reference path"
    observable = "a fixed scene while the camera warms up, with the reference recorded"
    refuted_by = "a reference that does not follow the drift of the scene"
    undo: ClassVar[Undo] = "partial"

    nominal: float = quantity("m", "length of the path", minimum=0.0)
    scale: float = quantity("-", "external drift over the reference's", default=1.0, above=0.0, typical=0.2)
    pixels: tuple[int, int, int, int] | None = quantity("px", "u0 v0 u1 v1, inclusive", default=None)

    def check(self, camera: Camera) -> None:
        if self.pixels is None:
            return
        u0, v0, u1, v1 = self.pixels
        if not (0 <= u0 <= u1 < camera.sensor.width and 0 <= v0 <= v1 < camera.sensor.height):
            raise ValueError(
                f"pixels {list(self.pixels)} do not lie within {camera.shape[1]} x {camera.shape[0]}"
            )

    def region(self) -> tuple[slice, slice] | None:
        """Return the rows and columns of the reference pixels."""
        if self.pixels is None:
            return None
        u0, v0, u1, v1 = self.pixels
        return slice(v0, v1 + 1), slice(u0, u1 + 1)

    def reading(self, drift: float) -> float:
        """Return what the reference measures in metres, without noise, for a drift in metres."""
        return self.nominal + drift / self.scale

    def drift(self, reading: float) -> float:
        """Return the drift of the external path in metres for a reading in metres (eqs. 4.3-4.5)."""
        return self.scale * (reading - self.nominal)

    def simulate(self, signal: Signal, context: Context) -> Signal:
        """Leave the external path as it is; the simulator lays the reading into the reference's pixels."""
        return signal

    def sentence(self) -> str:
        return (
            f"reference path: {self.nominal:.3f} m inside the camera; the scene drifts {self.scale:.2g} "
            "times as much as it"
        )

    @classmethod
    def example(cls, camera: Camera) -> ReferencePath:
        w, h = camera.sensor.width, camera.sensor.height
        return cls(nominal=0.85, scale=0.9, pixels=(max(w - 3, 0), 0, w - 1, min(1, h - 1)))


def mean_reading(values: np.ndarray[tuple[int, ...], np.dtype[np.floating]]) -> float | None:
    """Return the mean of the reference pixels' valid distances in metres, None where none is valid."""
    valid = values[np.isfinite(values)]
    return float(valid.mean()) if valid.size else None
