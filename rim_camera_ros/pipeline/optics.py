"""Undoing the effects of the optics on the light: stray light, wrapping, the emitter beside the lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.chain import Chain
from rim_camera_ros.effects import AdditionalLight, EmitterPath, InternalReference, StrayLight
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.pipeline import kernels

Image = NDArray[Any]


@dataclass
class Light:
    """Light as it came through the lens: distance [m], amplitude [counts], all (H, W).

    ``gain``: ratio of the amplitudes before and after stray light is undone, by which the noise of a distance
    grows; ``image``: the complex image (H, 2, W). Both are None without stray light.
    """

    distance: Image
    amplitude: Image
    gain: Image | None = None
    image: Image | None = None


class OpticsUndo:
    """Undoes stray light, folds the distance into [0, L) and undoes the emitter's offset for one camera."""

    def __init__(self, camera: Camera, dtype: Any) -> None:
        scattering, emitter = effect_of(camera, StrayLight), effect_of(camera, EmitterPath)
        fast = [StrayLight, EmitterPath, InternalReference]
        #: light to subtract from the complex image in which stray light is undone
        self._added = None if scattering is None else effect_of(camera, AdditionalLight)
        self._added_image, self._added_at = np.zeros(0), np.nan
        if self._added is not None:
            fast.append(AdditionalLight)
        #: the nearest to the sensor first
        self._others = [
            effect
            for effect in reversed(Chain.of(camera.effects.values()).light)
            if effect.undo != "none" and effect.shows_in == "distance" and not isinstance(effect, tuple(fast))
        ]
        self._dtype = np.dtype(dtype)
        number = self._dtype.type
        self._ambiguity = number(camera.sensor.ambiguity)
        self._wave = number(2 * np.pi / camera.sensor.ambiguity)
        self._wraps = camera.sensor.wraps
        self._spreading = scattering.operator(camera.shape, self._dtype) if scattering is not None else None
        self._emitter = emitter
        self._square = number(0)
        if emitter is not None:
            ray_dot_emitter = camera.rays @ np.array(emitter.position)
            self._along = (-2 * ray_dot_emitter).astype(self._dtype)
            self._square = number(sum(e * e for e in emitter.position))
        self._work = np.empty(camera.shape, self._dtype)
        self._image = np.empty((camera.shape[0], 2, camera.shape[1]), self._dtype)

    @property
    def spreads(self) -> bool:
        """Whether there is stray light to undo."""
        return self._spreading is not None

    def undo(
        self,
        delivered: Image,
        amplitude: Image,
        context: Context,
        *,
        guess: Image | None = None,
        quick: bool = False,
    ) -> Light:
        """Return the light for the delivered distance [m], which is overwritten, and amplitude [counts].

        Effects on the light without a fast method here (those of other packages) are undone first.

        ``guess``: a complex image near the result. With ``quick`` narrow halos and ghosts are not undone.
        """
        for other in self._others:
            found = other.correct(Signal(delivered, amplitude), context)
            delivered[...], amplitude = found.distance, found.amplitude.astype(amplitude.dtype, copy=False)
        light = Light(delivered, amplitude)
        if self._spreading is not None and self._dtype == np.float32 and kernels.LIBRARY is not None:
            self._undo_all(light, context, guess, quick=quick)
            return light
        if self._spreading is not None:
            self._undo_spreading(light, context, guess, quick=quick)
        if self._wraps:
            self._fold(light.distance)
        if self._emitter is not None:
            self._undo_emitter(light.distance)
        return light

    def _fold(self, distance: Image) -> None:
        """Take distances [m] modulo the ambiguity."""
        outside = distance >= self._ambiguity
        outside |= distance < 0
        # most frames lie within the first period
        if outside.any():
            beyond = distance[outside]
            beyond -= np.floor(beyond * (1 / self._ambiguity)) * self._ambiguity
            # values that rounding moved to the end of the period
            beyond[(beyond >= self._ambiguity) | (beyond < 0)] = 0
            distance[outside] = beyond

    def _solved(self, guess: Image | None, *, quick: bool) -> Image:
        """Return `_image` without stray light, a new array."""
        assert self._spreading is not None
        if quick:
            return self._spreading.first_order(self._image)
        return self._spreading.solve(self._image, guess=guess)

    def _subtract_added(self, context: Context) -> None:
        """Subtract the light that does not come from the scene from `_image`, where that is not dark."""
        if self._added is None:
            return
        if self._added_at != context.integration_time:
            light = self._added.light(context)
            self._added_image = np.stack([light.real, light.imag], axis=1).astype(self._dtype)
            self._added_at = context.integration_time
        dark = ~self._image.any(axis=1)
        self._image -= self._added_image
        if dark.any():
            self._image[:, 0][dark] = self._image[:, 1][dark] = 0

    def _undo_all(self, light: Light, context: Context, guess: Image | None, *, quick: bool) -> None:
        """Do what `undo` does, in two passes over the pixels."""
        assert self._spreading is not None
        ambiguity = float(self._ambiguity)
        before = light.amplitude
        kernels.to_image(light.distance, before, ambiguity=ambiguity, image=self._image)
        self._subtract_added(context)
        light.image = self._solved(guess, quick=quick)
        light.amplitude, light.gain = kernels.from_image(
            light.image,
            light.distance,
            before,
            ambiguity=ambiguity,
            wraps=self._wraps,
            direct=self._spreading.direct,
            along=None if self._emitter is None else self._along,
            square=float(self._square),
        )

    def _undo_spreading(self, light: Light, context: Context, guess: Image | None, *, quick: bool) -> None:
        assert self._spreading is not None
        amplitude = light.amplitude
        phase = np.multiply(light.distance, self._wave, out=self._work)
        dark = ~np.isfinite(phase)
        any_dark = bool(dark.any())
        if any_dark:
            # no light where there is no measurement
            phase[dark] = 0
            amplitude = amplitude.copy()
            amplitude[dark] = 0
        cv2.polarToCart(amplitude, phase, self._image[:, 0], self._image[:, 1])
        self._subtract_added(context)
        light.image = solved = self._solved(guess, quick=quick)
        real, imaginary = solved[:, 0], solved[:, 1]
        direct = np.arctan2(imaginary, real)
        if self._wraps:
            # the distance is taken into [0, L) later
            np.multiply(direct, 1 / self._wave, out=light.distance)
        else:
            direct -= phase
            direct -= np.rint(direct * self._dtype.type(0.5 / np.pi)) * self._dtype.type(2 * np.pi)
            direct *= 1 / self._wave
            light.distance += direct
        if any_dark:
            light.distance[dark] = np.nan
        square = np.multiply(solved, solved, out=self._image)
        light.amplitude = np.add(square[:, 0], square[:, 1], out=direct)
        np.sqrt(light.amplitude, out=light.amplitude)
        # the noise does not change, but grows relative to the remaining light
        light.gain = cv2.divide(amplitude, light.amplitude, scale=1.0 / self._spreading.direct)

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
