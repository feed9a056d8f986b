"""Undoing what the optics did to the light: stray light, wrapping, the emitter beside the lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.scattering import Scattering

Image = NDArray[Any]


@dataclass
class Light:
    """Light as it came through the lens: distance [m], amplitude [counts], all (H, W).

    ``gain``: amplitude before over after undoing stray light, by which the noise of a distance grows;
    ``image``: the complex image (H, 2, W). Both None where there is no stray light.
    """

    distance: Image
    amplitude: Image
    gain: Image | None = None
    image: Image | None = None


class OpticsUndo:
    """Undoes stray light, folds the distance into [0, L) and undoes the emitter's offset for one camera."""

    def __init__(
        self, camera: Camera, scattering: Scattering | None, emitter: EmitterOffset | None, dtype: Any
    ) -> None:
        self._dtype = np.dtype(dtype)
        number = self._dtype.type
        self._ambiguity = number(camera.sensor.ambiguity)
        self._wave = number(2 * np.pi / camera.sensor.ambiguity)
        self._wraps = camera.sensor.wraps
        self._spreading = scattering.operator(camera.shape, self._dtype) if scattering is not None else None
        self._emitter = emitter
        if emitter is not None:
            ray_dot_emitter = camera.rays @ np.array(emitter.position)
            self._along = (-2 * ray_dot_emitter).astype(self._dtype)
            self._square = number(sum(e * e for e in emitter.position))
        self._cosine, self._sine, self._work = (np.empty(camera.shape, self._dtype) for _ in range(3))
        self._image = np.empty((camera.shape[0], 2, camera.shape[1]), self._dtype)

    @property
    def spreads(self) -> bool:
        """Whether there is stray light to undo."""
        return self._spreading is not None

    def undo(
        self, delivered: Image, amplitude: Image, *, guess: Image | None = None, quick: bool = False
    ) -> Light:
        """Return the light for the delivered distance [m], which is overwritten, and amplitude [counts].

        ``guess``: a complex image near the result. ``quick`` leaves narrow halos and ghosts alone.
        """
        light = Light(delivered, amplitude)
        if self._spreading is not None:
            self._undo_spreading(light, guess, quick=quick)
        if self._wraps:
            periods = np.multiply(light.distance, 1 / self._ambiguity, out=self._work)
            np.floor(periods, out=periods)
            # most frames lie within the first period
            if periods.any():
                periods *= self._ambiguity
                light.distance -= periods
        if self._emitter is not None:
            self._undo_emitter(light.distance)
        return light

    def _undo_spreading(self, light: Light, guess: Image | None, *, quick: bool) -> None:
        assert self._spreading is not None
        amplitude = light.amplitude
        phase = np.multiply(light.distance, self._wave, out=self._work)
        dark = ~np.isfinite(phase)
        if dark.any():
            # no light where nothing was measured
            phase[dark] = 0
            amplitude = amplitude.copy()
            amplitude[dark] = 0
        cosine, sine = np.cos(phase, out=self._cosine), np.sin(phase, out=self._sine)
        np.multiply(cosine, amplitude, out=self._image[:, 0])
        np.multiply(sine, amplitude, out=self._image[:, 1])
        if quick:
            solved = self._spreading.first_order(self._image)
        else:
            solved = self._spreading.solve(self._image, guess=guess)
        light.image = solved
        # the angle between direct and delivered light, so that the distance keeps its period
        real, imaginary = solved[:, 0] * cosine, solved[:, 1] * cosine
        real += np.multiply(solved[:, 1], sine, out=self._work)
        imaginary -= np.multiply(solved[:, 0], sine, out=self._work)
        turned = np.arctan2(imaginary, real, out=self._work)
        turned *= 1 / self._wave
        light.distance += turned
        real *= real
        imaginary *= imaginary
        real += imaginary
        light.amplitude = np.sqrt(real, out=real)
        # noise stays where it is, but is the greater against what is left of the light
        light.gain = np.divide(amplitude, light.amplitude, out=imaginary)
        light.gain *= self._dtype.type(1.0 / self._spreading.direct)

    def _undo_emitter(self, half_path: Image) -> None:
        """Solve |P| + |P - e| = 2 d for |P| = (4 d^2 - |e|^2) / (4 d - 2 ray . e); NaN without a solution."""
        number = self._dtype.type
        short = half_path <= np.sqrt(self._square) / number(2)
        below = np.multiply(half_path, number(4), out=self._work)
        half_path *= below
        half_path -= self._square
        below += self._along
        half_path /= below
        if short.any():
            half_path[short] = np.nan
