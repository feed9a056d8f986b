"""Frames of a gated camera: the light of the chain through each gate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.gated.estimation import GateEstimator
from rim_camera_ros.gated.gates import GatedShutter
from rim_camera_ros.pipeline.pulsed import PulsedSimulation
from rim_camera_ros.pipeline.simulate import Exposure

Image = NDArray[Any]

#: Number of distances over a period at which the shares of the gates are sampled, and the part of their
#: Fourier series that is dropped.
_PLACES, _LEFT = 4096, 1e-6
_FULL = 65535


@dataclass
class GatedSimulation(PulsedSimulation):
    """Makes the image of every gate and evaluates them as the device would.

    The amplitude is the light of the pulse in counts, as if a gate transmitted all of it. The image of the
    role ``gates`` (H, W, gates), uint16, has the counts of all gates, black level included, with 0 for
    negative ones; a pixel that is full in one of them saturates.
    """

    @cached_property
    def shutter(self) -> GatedShutter:
        """Pulse and gates of the camera."""
        result: GatedShutter = self.camera.measurement.shutter(self.camera)
        return result

    @cached_property
    def _series(self) -> Image:
        """Fourier series (gates, k) of the shares over the distance, without negligible terms."""
        at = np.arange(_PLACES) * (self.shutter.ambiguity / _PLACES)
        series = np.fft.rfft(self.shutter.shares(at), axis=1) / _PLACES
        series[:, 1:] *= 2.0
        last = np.flatnonzero(np.abs(series).max(axis=0) > _LEFT)[-1]
        return np.ascontiguousarray(series[:, : last + 1])

    @cached_property
    def _estimator(self) -> GateEstimator:
        result: GateEstimator = self.camera.measurement.estimator(self.camera)
        return result

    def light_of_gates(self, signal: Signal, exposure: Exposure) -> Image:
        """Return the light of the pulse through each gate (gates, H, W) in counts, without noise."""
        arrivals = self.arrivals(signal, exposure, harmonics=self._series.shape[1] - 1)
        light: Image = np.tensordot(self._series, arrivals.conj(), axes=1).real
        return np.maximum(light, 0.0, out=light)

    def measured(
        self, signal: Signal, context: Context, exposure: Exposure
    ) -> tuple[Image, Image, Mapping[str, Image]]:
        """Return the estimates of the images of the gates."""
        light = self.light_of_gates(signal, exposure)
        impossible = np.isnan(light[0])
        light[:, impossible] = 0.0
        images = light + self.camera.background * self.shutter.windows[:, None, None]
        if self.noise:
            images = self._rng.poisson(images) + self.shutter.read_noise * self._rng.standard_normal(
                images.shape
            )
        # read-out noise may give values below the black level; the response only applies to the light
        dark, level = np.minimum(images, 0.0), self.shutter.black_level
        images = np.clip(self._chain.published(np.maximum(images, 0.0)) + dark + level, 0.0, _FULL)
        if self.quantised:
            images = np.rint(images)
        found = self._estimator.estimate(images.reshape(len(images), -1) - level)
        shape = self.camera.shape
        distance, amplitude = found.distance.reshape(shape), found.amplitude.reshape(shape)
        distance[impossible] = np.nan
        full = min(self.camera.sensor.saturation, _FULL)
        amplitude[(images >= full).any(axis=0)] = self.camera.sensor.saturation
        kind = np.uint16 if self.quantised else np.float32
        gates = np.ascontiguousarray(np.moveaxis(images, 0, -1), kind)
        return distance, amplitude, {"gates": gates}
