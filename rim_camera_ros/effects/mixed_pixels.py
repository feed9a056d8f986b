"""Two surfaces in one pixel (Kahlmann 2007, sec. 3.3.10, fig. 3.58)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import ComplexEffect, Context, Image, Undo
from rim_camera_ros.parameters import quantity

#: Below this sigma in pixels a sampled Gaussian is one pixel, to the last digit.
_POINT = 0.02


@dataclass(frozen=True)
class MixedPixels(ComplexEffect):
    """Gaussian blur of the complex image; at the sensor's edge the image is continued by reflection."""

    name = "mixed_pixels"
    title = "two surfaces in one pixel"
    observable = "a distance step in view, at several places relative to the pixels"
    refuted_by = "edges at which no pixel lies between the two surfaces"
    undo: ClassVar[Undo] = "none"

    blur: float = quantity("px", "sigma of the Gaussian", minimum=0.0, maximum=20.0, typical=0.5)

    def apply(self, phasor: Image, context: Context) -> Image:
        if self.blur < _POINT:
            return phasor
        from scipy import ndimage  # takes a quarter of the time in which a node starts

        result = np.empty_like(phasor)
        for name in ("real", "imag"):
            blurred = ndimage.gaussian_filter(getattr(phasor, name), self.blur, truncate=8.0)
            setattr(result, name, blurred)
        return result

    def phasor_columns(self, phasor: Image, context: Context) -> dict[str, Image]:
        """By the heat equation, of the sampled kernel: d/d sigma of exp(-k^2 / 2 sigma^2) / sum."""
        if self.blur < _POINT:
            return {"blur": np.zeros_like(phasor)}
        from scipy import ndimage

        reach = int(8.0 * self.blur + 0.5)
        k = np.arange(-reach, reach + 1, dtype=float)
        kernel = np.exp(-0.5 * (k / self.blur) ** 2)
        kernel /= kernel.sum()
        slope = kernel * (k**2 - (kernel * k**2).sum()) / self.blur**3

        def filtered(image: Image, rows: Image, columns: Image) -> Image:
            return ndimage.convolve1d(ndimage.convolve1d(image, rows, axis=0), columns, axis=1)

        result = np.empty_like(phasor)
        for name in ("real", "imag"):
            part = getattr(phasor, name)
            setattr(result, name, filtered(part, slope, kernel) + filtered(part, kernel, slope))
        return {"blur": result}

    def sentence(self) -> str:
        return (
            f"mixed pixels: the light of each point is blurred over {self.blur:.2g} px (sigma); "
            "pixels at edges measure a distance between the two surfaces"
        )

    @classmethod
    def example(cls, camera: Camera) -> MixedPixels:
        return cls(blur=0.4)
