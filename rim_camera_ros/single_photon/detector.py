"""The light pulse and the diode: expected detections of a pixel in each bin of the time since the pulse.

All rates are expected detections per cycle, that is per light pulse, in arrays (bins, pixels). Kahlmann 2007,
secs. 2.2.1 and 2.3.3, describes the sensors: pulse, jitter and dead time have its numbers as defaults. The
statistics of first photons are in `rim_camera_ros.single_photon.first_photon`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import SPEED_OF_LIGHT
from rim_camera_ros.single_photon.first_photon import detection_probabilities

Array = NDArray[Any]

#: Full width at half maximum over standard deviation of a Gaussian.
_FULL_WIDTH = 2.0 * math.sqrt(2.0 * math.log(2.0))
#: Afterpulses of afterpulses are added until they contribute less than this share.
_NEGLIGIBLE = 1e-9
#: Half width of the pulse in its standard deviations; its light beyond is neglected.
_REACH = 8.0


@dataclass(frozen=True, kw_only=True)
class PulseAndDiode:
    """Light pulse, diode and bins, without the rate of the pulses."""

    bins: int = quantity("-", "bins of the histogram over a cycle", default=128, minimum=8, maximum=4096)
    pulse_width: float = quantity(
        "s", "light pulse, full width at half maximum", default=150e-12, minimum=0.0, maximum=1e-6
    )
    jitter: float = quantity(
        "s", "1-sigma of the time of an avalanche", default=300e-12, minimum=1e-12, maximum=1e-6
    )
    dead_time: float = quantity(
        "s", "after an avalanche nothing is detected", default=40e-9, minimum=0.0, maximum=1e-6
    )
    dark_count_rate: float = quantity(
        "Hz", "avalanches without light at dark_count_temperature", default=350.0, minimum=0.0
    )
    dark_count_temperature: float = quantity("degC", "temperature of dark_count_rate", default=25.0)
    dark_count_doubling: float = quantity(
        "degC", "warming that doubles the dark counts", default=10.0, above=0.0
    )
    afterpulse_probability: float = quantity(
        "-", "of a further avalanche by trapped carriers", default=0.01, minimum=0.0, below=0.5
    )
    afterpulse_time_constant: float = quantity(
        "s", "decay of the trapped carriers", default=100e-9, above=0.0, maximum=1e-3
    )


@dataclass(frozen=True, kw_only=True)
class SinglePhotonDetector(PulseAndDiode):
    """Pulse, diode and clock of a direct time-of-flight pixel.

    A cycle begins with a light pulse and lasts until the next one. A pixel that is ready at the beginning of
    a cycle records the time of the first avalanche, in one of ``bins`` equal bins. It then misses all cycles
    that overlap its dead time, and is ready again at the beginning of the next one.
    """

    pulse_rate: float = quantity("Hz", "light pulses per second", default=50e6, minimum=1e3)

    @property
    def period(self) -> float:
        """Seconds of a cycle."""
        return 1.0 / self.pulse_rate

    @property
    def bin_width(self) -> float:
        """Seconds of a bin."""
        return self.period / self.bins

    @property
    def ambiguity(self) -> float:
        """Ambiguity range in metres: c / (2 pulse_rate)."""
        return SPEED_OF_LIGHT / (2.0 * self.pulse_rate)

    @property
    def time_sigma(self) -> float:
        """1-sigma in seconds of the time of one detected signal photon: pulse and jitter."""
        return math.hypot(self.pulse_width / _FULL_WIDTH, self.jitter)

    @property
    def missed_cycles(self) -> int:
        """Whole cycles that a pixel misses after a detection: the dead time in periods, rounded up."""
        return math.ceil(self.dead_time / self.period * (1 - 1e-12))

    def cycles(self, exposure: float) -> int:
        """Return the number of cycles in an exposure of so many seconds."""
        return round(exposure * self.pulse_rate)

    def dark_rate(self, temperature: float | None = None) -> float:
        """Return the dark counts in Hz at a temperature in degC (None: that of `dark_count_rate`).

        They double with every `dark_count_doubling`: thermal generation of carriers (sec. 2.2.1; the fall
        towards lower temperatures is fig. 2.34).
        """
        if temperature is None:
            return self.dark_count_rate
        warmer = temperature - self.dark_count_temperature
        return self.dark_count_rate * math.exp2(warmer / self.dark_count_doubling)

    def response(self, times: Array) -> Array:
        """Return the share (bins, pixels) of signal photons in each bin, for times of flight (pixels,) in s.

        A Gaussian of `time_sigma`, integrated over the bins and wrapped at the cycle's end; sums to 1.
        """
        from scipy.special import ndtr  # takes a good part of a node's start

        sigma, period = self.time_sigma, self.period
        start = np.mod(np.asarray(times, float), period)
        edges = np.arange(self.bins + 1)[:, None] * self.bin_width
        wraps = math.ceil(_REACH * sigma / period)
        share = np.zeros((self.bins, start.size))
        for wrap in range(-wraps, wraps + 1):
            share += np.diff(ndtr((edges - start - wrap * period) / sigma), axis=0)
        return share

    def rates(
        self,
        *,
        distance: Array,
        signal: Array,
        background: Array | float,
        exposure: float,
        temperature: float | None = None,
    ) -> Array:
        """Return expected detections per cycle and bin (bins, pixels) of ready pixels.

        ``distance`` (pixels,) [m]; ``signal`` (pixels,): photons of the pulse that would be detected in an
        exposure without pile-up; ``background``: photons of unmodulated light, likewise; ``exposure`` [s];
        ``temperature`` [degC] of the diodes. Dark counts and afterpulses are added.
        """
        photons = self.response(np.asarray(distance, float) * (2.0 / SPEED_OF_LIGHT))
        photons *= np.asarray(signal, float)
        return self.detected(photons, background=background, exposure=exposure, temperature=temperature)

    def detected(
        self,
        photons: Array,
        *,
        background: Array | float,
        exposure: float,
        temperature: float | None = None,
    ) -> Array:
        """Return the rates as `rates` does, for photons (bins, pixels) of the pulse in an exposure."""
        even = (np.asarray(background, float) + self.dark_rate(temperature) * exposure) / self.bins
        return self.with_afterpulses((photons + even) / self.cycles(exposure))

    def transfer(self, harmonics: Array) -> Array:
        """Return the transfer function of pulse, jitter and bins, complex [-], at harmonics (k,) of the rate.

        It is that of a Gaussian of `time_sigma`, averaged over the width of a bin and sampled in its middle.
        The photons of a bin are the inverse discrete Fourier transform of S_k* times this function, where S_k
        is the complex image of the light at k times the pulse rate.
        """
        turns = np.asarray(harmonics, float) / self.bins
        width = 2.0 * np.pi * np.asarray(harmonics, float) * self.time_sigma / self.period
        result: Array = np.exp(-0.5 * width**2 + 1j * np.pi * turns) * np.sinc(turns)
        return result

    def with_afterpulses(self, rates: Array) -> Array:
        """Return rates (bins, pixels) per cycle with those of the afterpulses of all detections.

        Each detection is followed, with `afterpulse_probability`, by an avalanche after the dead time and an
        exponentially distributed delay. Averaged over many cycles this is the convolution of the detected
        rate with the exponential, wrapped at the cycle's end.
        """
        if self.afterpulse_probability == 0:
            return rates
        kernel = self.afterpulse_probability * np.fft.rfft(self._afterpulse_delays)[:, None]
        total, before = rates, np.zeros_like(rates)
        while np.any(np.abs(total - before) > _NEGLIGIBLE * total):
            before = total
            detected = detection_probabilities(total)
            total = rates + np.fft.irfft(kernel * np.fft.rfft(detected, axis=0), self.bins, axis=0)
        return total

    @cached_property
    def _afterpulse_delays(self) -> Array:
        """Share of the afterpulses by bins of their delay, wrapped at the cycle's end (bins,); sums to 1."""
        delay = np.arange(self.bins) * self.bin_width
        # for each bin the first delay after the dead time; further ones follow by whole periods
        wait = np.ceil((self.dead_time - delay) / self.period * (1 - 1e-12)).clip(min=0) * self.period
        weight = np.exp(-(delay + wait - self.dead_time) / self.afterpulse_time_constant)
        return np.asarray(weight / weight.sum())
