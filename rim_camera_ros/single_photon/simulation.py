"""Frames of an array of single-photon diodes: the light of the chain, counted photon by photon."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.pipeline.pulsed import PulsedSimulation
from rim_camera_ros.pipeline.simulate import Exposure
from rim_camera_ros.single_photon.detector import SinglePhotonDetector
from rim_camera_ros.single_photon.estimation import PulseEstimator
from rim_camera_ros.single_photon.first_photon import detection_probabilities, draw_histogram

Image = NDArray[Any]

#: Harmonics are dropped where pulse and jitter reduce them to less than this share.
_WEAKEST = 1e-9
#: Most counts of a bin in a published histogram.
_FULL = 65535


@dataclass
class SinglePhotonSimulation(PulsedSimulation):
    """Draws the histogram of every pixel and evaluates it as the device would.

    The amplitude is the number of signal photons of an exposure without pile-up. The image of the role
    ``histogram`` (H, W, bins), uint16, has the counts; a pixel with more than 65535 in a bin saturates.
    """

    @cached_property
    def detector(self) -> SinglePhotonDetector:
        """Pulse, diodes and clock of the camera."""
        result: SinglePhotonDetector = self.camera.measurement.detector(self.camera)
        return result

    @cached_property
    def _transfer(self) -> Image:
        transfer = self.detector.transfer(np.arange(self.detector.bins // 2 + 1))
        return transfer[: int(np.flatnonzero(np.abs(transfer) > _WEAKEST)[-1]) + 1]

    @cached_property
    def _estimator(self) -> PulseEstimator:
        return PulseEstimator(self.detector)

    def photons(self, signal: Signal, exposure: Exposure) -> Image:
        """Return the expected signal photons (bins, H, W) of an exposure without pile-up."""
        series = self.arrivals(signal, exposure, harmonics=len(self._transfer) - 1)
        bins = self.detector.bins
        result: Image = np.fft.irfft(series * self._transfer[:, None, None], bins, axis=0)
        # without the dropped harmonics values may be slightly negative
        return np.maximum(result, 0.0, out=result)

    def measured(
        self, signal: Signal, context: Context, exposure: Exposure
    ) -> tuple[Image, Image, Mapping[str, Image]]:
        """Return the estimates of drawn histograms, or of expected ones without ``noise``."""
        detector, shape = self.detector, self.camera.shape
        seconds = self.camera.sensor.exposure_seconds(context.integration_time)
        cycles = detector.cycles(seconds)
        photons = self.photons(signal, exposure).reshape(detector.bins, -1)
        impossible = np.isnan(photons[0])
        photons[:, impossible] = 0.0
        rates = detector.detected(
            photons,
            background=self.camera.measurement.unmodulated(self.camera),
            exposure=seconds,
            temperature=context.settings.body_temperature,
        )
        missed = detector.missed_cycles
        if self.noise:
            histogram = draw_histogram(rates, cycles=cycles, missed=missed, rng=self._rng)
        else:
            share = detection_probabilities(rates)
            histogram = share * (cycles / (1.0 + missed * share.sum(axis=0)))
        found = self._estimator.estimate(histogram, cycles=cycles)
        distance = found.distance.astype(float)
        distance[impossible] = np.nan
        amplitude = self._chain.published(found.signal.astype(float))
        amplitude[histogram.max(axis=0) > _FULL] = self.camera.sensor.saturation
        counts = np.minimum(histogram, _FULL).T.reshape(*shape, -1)
        images = {"histogram": np.ascontiguousarray(counts, np.uint16 if self.noise else np.float32)}
        return distance.reshape(shape), amplitude.reshape(shape), images
