"""Sigma and flags of a corrected frame: which of its distances are valid, and how precise they are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import INVALID, Flag, Settings
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.amplitude_tables import AmplitudeReading
from rim_camera_ros.pipeline.folded import Folded
from rim_camera_ros.pipeline.mixed import LEAST_SHARE, LEAST_SIGMAS, LEAST_STEP, mixed_pixels
from rim_camera_ros.pipeline.optics import Light

Image = NDArray[Any]


@dataclass
class Work:
    """A frame during its correction: tables of its setting, values by its amplitudes, the light so far."""

    folded: Folded
    reading: AmplitudeReading
    #: pixels without a raw distance, None where all have one
    missing: NDArray[np.bool_] | None
    light: Light
    #: cosine of the angle of incidence, NaN where no plane was found; None where no term needs it
    cosine: Image | None = None

    @property
    def noise(self) -> Image:
        """1-sigma in metres of one distance (H, W), by its amplitude and the gain of undoing the optics."""
        gain = self.light.gain
        sigma: Image = self.reading.sigma if gain is None else self.reading.sigma * gain
        return sigma


class Judgement:
    """Judges the distances of one camera.

    ``reference_region``: pixels that see the internal reference path, None where there are none.
    ``spreads``: whether stray light was undone. ``dtype`` of the distances. ``compiled``: by the compiled
    function, which takes float32.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        reference_region: tuple[slice, slice] | None,
        spreads: bool,
        dtype: Any,
        compiled: bool,
    ) -> None:
        self._camera = camera
        self._reference = reference_region
        self._spreads = spreads
        self._dtype = dtype
        self._compiled = compiled

    def judge(self, work: Work, settings: Settings) -> tuple[Image, NDArray[np.uint8]]:
        """Return sigma [m] and flags (H, W); distance and sigma become NaN where they are not valid."""
        if not self._compiled:
            sigma = self._sigma(work)
            flags = self._flags(work, sigma, settings)
            invalid = (flags & np.uint8(INVALID.value)) != 0
            np.copyto(work.light.distance, np.nan, where=invalid)
            np.copyto(sigma, np.nan, where=invalid)
            return sigma, flags
        folded, light, reading = work.folded, work.light, work.reading
        if work.missing is not None:
            _mark(reading.flags, work.missing, Flag.NO_MEASUREMENT)
        outside = folded.outside or self._outside(settings)
        kernels.judge(
            light.distance,
            reading.sigma,
            reading.flags,
            amplitude=light.amplitude,
            gain=light.gain,
            slope=folded.distance.slope,
            cosine=work.cosine,
            always=self._always,
            minimum=folded.amplitude.minimum if self._spreads else -np.inf,
            spread=folded.incidence_spread,
            limits=self._camera.validity.distance or (-np.inf, np.inf),
            mixed=(LEAST_STEP, LEAST_SIGMAS, LEAST_SHARE),
            everywhere=Flag.OUTSIDE_CALIBRATION.value if outside else 0,
        )
        return reading.sigma, reading.flags

    def _sigma(self, work: Work) -> Image:
        """Return the 1-sigma in metres (H, W), including the uncertainty by the incidence; a new array."""
        sigma = work.noise
        gain = work.folded.distance.gain(work.light.distance)
        if gain is not None:
            # where the cyclic error compresses distances, undoing it increases their noise
            sigma *= gain
        if work.cosine is not None:
            at = np.flatnonzero(np.isnan(work.cosine))
            sigma.ravel()[at] = np.hypot(sigma.take(at), self._dtype(work.folded.incidence_spread))
        return sigma

    def _flags(self, work: Work, sigma: Image, settings: Settings) -> NDArray[np.uint8]:
        folded, distance = work.folded, work.light.distance
        flags = work.reading.flags
        if self._spreads:
            # pixels whose amplitude was above the minimum only by stray light
            _mark(flags, work.light.amplitude < self._dtype(folded.amplitude.minimum), Flag.LOW_AMPLITUDE)
        # a value that is missing because of its amplitude is not flagged as a missing measurement, too
        nowhere = np.isnan(distance)
        if nowhere.any():
            nowhere &= (flags & np.uint8(INVALID.value)) == 0
            _mark(flags, nowhere, Flag.NO_MEASUREMENT)
        if work.missing is not None:
            _mark(flags, work.missing, Flag.NO_MEASUREMENT)
        _mark(flags, mixed_pixels(distance, sigma), Flag.MIXED_PIXEL)
        if folded.outside or self._outside(settings):
            flags |= np.uint8(Flag.OUTSIDE_CALIBRATION.value)
        limits = self._camera.validity.distance
        if limits is not None:
            low, high = (self._dtype(limit) for limit in limits)
            _mark(flags, (distance < low) | (distance > high), Flag.OUTSIDE_CALIBRATION)
        if self._always is not None:
            flags |= self._always
        return flags

    def _outside(self, settings: Settings) -> bool:
        """Whether the setting or the temperature lies outside the calibrated range."""
        limits = self._camera.validity
        pairs = (
            (limits.integration_time, self._camera.stated_integration_time(settings)),
            (limits.temperature, settings.ambient_temperature),
        )
        return any(
            bounds is not None and value is not None and not bounds[0] <= value <= bounds[1]
            for bounds, value in pairs
        )

    @cached_property
    def _always(self) -> NDArray[np.uint8] | None:
        """Flags of pixels outside the calibrated region, and of those that see no scene; None without any."""
        region, seen = self._camera.validity.region, self._reference
        if region is None and seen is None:
            return None
        flags = np.zeros(self._camera.shape, np.uint8)
        if region is not None:
            u0, v0, u1, v1 = (round(x) for x in region)
            flags += np.uint8(Flag.OUTSIDE_CALIBRATION.value)
            flags[max(v0, 0) : v1 + 1, max(u0, 0) : u1 + 1] = 0
        if seen is not None:
            flags[seen] |= Flag.NO_MEASUREMENT.value
        return flags


def _mark(flags: NDArray[np.uint8], where: NDArray[np.bool_], flag: Flag) -> None:
    flags |= where.view(np.uint8) * np.uint8(flag.value)
