"""Correction of cameras whose distances are evaluated from images that are linear in the light."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import StrayLight
from rim_camera_ros.effects.base import effect_of, response_of
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import CorrectedDistance, CorrectedFrame, RawFrame, Settings
from rim_camera_ros.pipeline.correct import Correction

Image = NDArray[Any]
#: Distance [m], amplitude [counts] and sigma [m], all (H, W), of images (n, H, W) at these settings.
Resolve = Callable[[Image, Settings], tuple[Image, Image, Image]]


class ResolvedCorrection(Correction):
    """Evaluates distance, amplitude and sigma anew where a frame contains the images they come from.

    ``role``: that of the images (H, W, ``count``), which are linear in the light; ``resolve`` evaluates them.
    Stray light is undone in each of these images. It cannot be undone in distance and amplitude alone, as
    light of another distance may be separable or not. ``black_level`` [counts] is subtracted first.
    ``responds``: the images are compressed as ``amplitude_nonlinearity`` says. Otherwise as `Correction`.
    """

    def __init__(
        self,
        camera: Camera,
        resolve: Resolve,
        *,
        role: str,
        count: int,
        black_level: float = 0.0,
        responds: bool = False,
        without: Iterable[str] = (),
        minimum_amplitude: float | None = None,
    ) -> None:
        given = frozenset(without)
        stray = effect_of(camera, StrayLight)
        apart = frozenset() if stray is None else frozenset({StrayLight.name})
        rest = {name: effect for name, effect in camera.effects.items() if name not in apart}
        # unknown names are refused, as for every camera
        super().__init__(
            replace(camera, effects=rest), without=given - apart, minimum_amplitude=minimum_amplitude
        )
        self._stray = None if given & apart else stray
        self._resolve, self._role, self._count = resolve, role, count
        self._black_level = black_level
        self._published = response_of(camera)
        undone = self._published is not None and self._published.name not in given
        self._response = self._published if responds and undone else None
        self.camera = camera

    def correct(self, frame: RawFrame) -> CorrectedFrame:
        """Return the corrected frame; `InputError` as `Correction.correct`, or for images of another size."""
        return super().correct(self._evaluated(frame))

    def correct_distance(self, frame: RawFrame) -> CorrectedDistance:
        """Return distance and amplitude as `correct` does."""
        return super().correct_distance(self._evaluated(frame))

    def _evaluated(self, frame: RawFrame) -> RawFrame:
        images = frame.images.get(self._role)
        if images is None:
            if self._stray is not None:
                self.notes.add(f"{self._stray.name} is not undone: that needs the {self._role} of each frame")
            return self._with_sigma(frame)
        expected = (*self.camera.shape, self._count)
        if images.shape != expected:
            raise InputError(
                f"the {self._role} is {_size(images.shape)}, but the camera file is for {_size(expected)}",
                remedy="give the camera file of this sensor, with its measurement",
            )
        planes = np.moveaxis(images, -1, 0)
        if self._black_level:
            planes = planes.astype(np.float32) - np.float32(self._black_level)
        if self._response is not None:
            # below the black level there is only noise
            lit = self._response.expanded(np.maximum(planes, 0).astype(np.float32))
            planes = np.where(planes > 0, lit, planes)
        if self._stray is not None:
            planes = _without_stray_light(planes.astype(np.float32), self._stray)
        distance, amplitude, sigma = self._resolve(planes, frame.settings)
        published = amplitude if self._published is None else self._published.compressed(amplitude)
        # pixels that the device marked as missing or saturated stay marked
        published = np.where(frame.amplitude >= self.camera.sensor.saturation, frame.amplitude, published)
        return replace(
            frame,
            distance=np.where(frame.distance > 0, distance, np.float32(np.nan)),
            amplitude=published.astype(np.float32, copy=False),
            sigma=sigma,
        )

    def _with_sigma(self, frame: RawFrame) -> RawFrame:
        """Return the frame with the noise of its distances, where it depends on more than the light."""
        metres = frame.distance.astype(np.float32)
        if frame.distance.dtype.kind != "f":
            metres *= np.float32(self.camera.sensor.lsb)
        light = self.camera.light_of(frame.amplitude.astype(np.float32))
        return replace(
            frame, sigma=self.camera.sigma_distance(light, distance=metres, settings=frame.settings)
        )


def _without_stray_light(planes: Image, stray: StrayLight) -> Image:
    """Undo scattering in images (n, H, W), two at a time as parts of a complex image."""
    operator = stray.operator(planes.shape[1:], np.float32)
    for first in range(0, len(planes) - 1, 2):
        pair = operator.solve(np.ascontiguousarray(planes[first : first + 2].transpose(1, 0, 2)))
        planes[first : first + 2] = pair.transpose(1, 0, 2)
    if len(planes) % 2:
        last = np.stack([planes[-1], np.zeros_like(planes[-1])], axis=1)
        planes[-1] = operator.solve(last)[:, 0]
    return planes


def _size(shape: tuple[int, ...]) -> str:
    """Return (H, W, n) in words."""
    count = shape[2] if len(shape) > 2 else 1
    return f"{shape[1]} x {shape[0]} px of {count} values"
