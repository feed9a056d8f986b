"""Gated (shuttered) cameras: distances from ratios of images (Kahlmann 2007, sec. 2.3.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import Settings
from rim_camera_ros.gated.estimation import GateEstimator
from rim_camera_ros.gated.gates import GatedShutter, PulseAndGates
from rim_camera_ros.measurement.base import FrameCorrection, FrameSimulation, OneFrequency
from rim_camera_ros.measurement.single_photon import check_effects, check_waveform
from rim_camera_ros.noise import Noise
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.scene import Scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Counts at which the noise of photons and that of the read-out are taken, and the distances of the median.
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
        keys = {one.name: getattr(self, one.name) for one in fields(PulseAndGates)}
        return GatedShutter(pulse_rate=camera.sensor.modulation_frequency, **keys)

    def estimator(self, camera: Camera) -> GateEstimator:
        """Return what evaluates the images. Raises ValueError for gates that do not overlap."""
        return GateEstimator(self.shutter(camera), background=camera.background)

    def check(self, camera: Camera) -> None:
        """Raise ValueError for gates that tell no distance, or effects of demodulation."""
        if len(self.gates) < 2:
            raise ValueError("one gate cannot tell a distance from a reflectivity: give two gates or more")
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
        """Return the chain of effects in reverse, after the evaluation of the gates where they are there."""
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
            responds=True,
            **options,
        )

    def noise(self, camera: Camera) -> Noise:
        """Return the noise of a distance without the images: the Cramer-Rao bound, its median over the range.

        shot of the pulse's photons, amplitude of the read-out; unmodulated light is left out.
        """
        estimator = self.estimator(camera)
        at = np.linspace(*estimator.limits, _PLACES + 2)[1:-1]
        shot = float(np.median(estimator.bound(at, amplitude=_BRIGHT))) * math.sqrt(_BRIGHT)
        # so little light that its photons add no noise
        amplitude = float(np.median(estimator.bound(at, amplitude=_FAINT))) * _FAINT
        return Noise(floor=0.0, shot=shot, amplitude=amplitude, circular_range=2.0 * math.pi * shot)

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return pulse, gates, and the distances that they tell."""
        shutter = self.shutter(camera)
        low, high = self.estimator(camera).limits
        rows = [
            (
                "gates",
                f"{len(self.gates)}, of pulses of {self.pulse_width * 1e9:g} ns; their ratios tell "
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
