"""Gated (shuttered) cameras: distances from ratios of images (Kahlmann 2007, sec. 2.3.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import Settings
from rim_camera_ros.gated.estimation import ROUNDING, GateEstimator
from rim_camera_ros.gated.gates import GatedShutter, PulseAndGates
from rim_camera_ros.measurement.base import FrameCorrection, FrameSimulation, OneFrequency
from rim_camera_ros.measurement.single_photon import check_effects, check_waveform
from rim_camera_ros.noise import Noise, NoiseFactors
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.scene import Scene

#: Counts at which the noises of photons and read-out are computed, and number of distances for the median.
_BRIGHT, _FAINT, _PLACES = 1e6, 1e-3, 200


@dataclass(frozen=True, kw_only=True)
class Gated(PulseAndGates, OneFrequency):
    """Images of a light pulse through gates; pulses come at the sensor's modulation frequency.

    The amplitude is the light of the pulse that a pixel receives, in photo-electrons. The level of
    ``background_light`` is that of a gate as wide as the pulse.
    """

    type: ClassVar[str] = "gated"
    samples: ClassVar[tuple[str, ...]] = ("gates",)
    demodulates: ClassVar[bool] = False

    def shutter(self, camera: Camera) -> GatedShutter:
        """Return pulse, gates and period."""
        keys = {field.name: getattr(self, field.name) for field in fields(PulseAndGates)}
        return GatedShutter(pulse_rate=camera.sensor.modulation_frequency, **keys)

    def estimator(self, camera: Camera) -> GateEstimator:
        """Return the estimator for the images. Raises ValueError for gates that do not overlap."""
        return GateEstimator(self.shutter(camera), background=camera.background)

    def check(self, camera: Camera) -> None:
        """Raise ValueError for gates that do not determine a distance, or effects of demodulation."""
        if len(self.gates) < 2:
            raise ValueError("one gate cannot separate distance and reflectivity: give two gates or more")
        self.estimator(camera)
        check_effects(camera, "a gated camera")

    def simulation(
        self, camera: Camera, scene: Scene, *, waveform: Waveform | None = None, **options: Any
    ) -> FrameSimulation:
        """Return the chain of effects with gates at its end."""
        from rim_camera_ros.gated.simulation import GatedSimulation

        check_waveform(waveform)
        return GatedSimulation(camera, scene, **options)

    def correction(self, camera: Camera, **options: Any) -> FrameCorrection:
        """Return the chain of effects in reverse, after the evaluation of the gates if a frame has them."""
        from rim_camera_ros.pipeline.resolved import ResolvedCorrection

        estimator = self.estimator(camera)

        def resolve(planes: NDArray[Any], settings: Settings) -> tuple[Any, Any, Any]:
            found = estimator.estimate(planes.reshape(len(planes), -1))
            one, two, three = (
                values.reshape(planes.shape[1:]).astype(np.float32)
                for values in (found.distance, found.amplitude, found.sigma)
            )
            return one, two, three

        return ResolvedCorrection(
            camera,
            resolve,
            role=self.samples[0],
            count=len(self.gates),
            black_level=self.black_level,
            responds=True,
            **options,
        )

    def noise(self, camera: Camera) -> Noise:
        """Return the noise of a distance without images: the Cramer-Rao bound, as its median over the range.

        ``shot`` is by the pulse's photons, ``amplitude`` by the read-out; unmodulated light is neglected.
        """
        shot, amplitude = (float(np.median(one)) for one in _noise_at(self.shutter(camera))[1:])
        return Noise(floor=0.0, shot=shot, amplitude=amplitude, circular_range=2.0 * math.pi * shot)

    def noise_factors(self, camera: Camera, distance: NDArray[Any], settings: Settings) -> NoiseFactors:
        """Return the Cramer-Rao bounds at the distances over their medians, as variances.

        Unmodulated light adds photons to each gate like the read-out adds electrons, and has its factor.
        """
        at, shot, amplitude = _noise_at(self.shutter(camera))
        near = np.nan_to_num(distance)
        photons, read_out = (
            np.square(np.interp(near, at, one) / np.median(one)) for one in (shot, amplitude)
        )
        electrons = self.read_noise**2 + ROUNDING
        light = read_out * (np.median(amplitude) / np.median(shot)) ** 2 / electrons
        return NoiseFactors(photons, read_out, light)

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return pulse, gates, and the distances that they determine."""
        shutter = self.shutter(camera)
        low, high = self.estimator(camera).limits
        rows = [
            (
                "gates",
                f"{len(self.gates)}, of pulses of {self.pulse_width * 1e9:g} ns; their ratios determine "
                f"{low:.3g} .. {high:.3g} m",
            )
        ]
        for i, gate in enumerate(self.gates):
            near, far = shutter.slice_of(i)
            rows.append(
                (
                    f"gate {i}",
                    f"opens after {gate.delay * 1e9:g} ns for {gate.width * 1e9:g} ns: the slice from "
                    f"{near:.3g} to {far:.3g} m",
                )
            )
        return rows


@lru_cache(maxsize=16)
def _noise_at(shutter: GatedShutter) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return distances [m], and the bounds there: of photons [m sqrt(counts)], of read-out [m counts]."""
    estimator = GateEstimator(shutter)
    at = np.linspace(*estimator.limits, _PLACES + 2)[1:-1]
    shot = estimator.bound(at, amplitude=_BRIGHT) * math.sqrt(_BRIGHT)
    # with so little light photons add no noise
    return at, shot, estimator.bound(at, amplitude=_FAINT) * _FAINT
