"""Offset per pixel (Kahlmann 2007, sec. 3.3.9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Dependency, DistanceTerm
from rim_camera_ros.effects.signal import Context, Image
from rim_camera_ros.parameters import ArrayFile, quantity


@dataclass(frozen=True)
class FixedPatternOffset(DistanceTerm):
    """+ map(v, u). The thesis stores the correction, which is the negative."""

    name = "fixed_pattern_offset"
    title = "offset per pixel"
    observable = "a wall or board at known poses that covers every pixel several times"
    refuted_by = "a residual map that changes from pose to pose"

    estimated = "pixels"
    needs_all_pixels = True
    pointwise = True

    map: ArrayFile = quantity("m", "float32 (height, width) .npy beside the camera file")

    def check(self, camera: Camera) -> None:
        if self.map.values.shape != camera.shape:
            raise ValueError(
                f"map '{self.map.file}' has shape {self.map.values.shape}, "
                f"expected {camera.shape} (height, width)"
            )

    def depends_on(self) -> frozenset[Dependency]:
        return frozenset({"pixel"})

    def term(self, distance: Image, amplitude: Image, context: Context) -> Image | float:
        return context.inside(self.map.values).astype(distance.dtype, copy=False)

    def sentence(self) -> str:
        rms, mean = float(np.std(self.map.values)) * 1e3, float(np.mean(self.map.values)) * 1e3
        return f"fixed pattern: every pixel has an offset of its own, {rms:.1f} mm RMS around {mean:+.1f} mm"

    def resampled(self, factor: float, step: int | None) -> Self:
        if step is None:
            return self
        picked = self.map.values[step // 2 :: step, step // 2 :: step]
        return replace(self, map=ArrayFile(self.map.file, np.ascontiguousarray(picked)))

    @classmethod
    def example(cls, camera: Camera) -> FixedPatternOffset:
        v, u = np.mgrid[: camera.sensor.height, : camera.sensor.width]
        smooth = 0.006 * u / camera.sensor.width - 0.011 * (v / camera.sensor.height) ** 2
        white = 0.0015 * np.random.default_rng(7).standard_normal(camera.shape)
        return cls(map=ArrayFile("fixed_pattern.npy", (smooth + white).astype(np.float32)))
