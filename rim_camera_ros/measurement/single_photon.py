"""Arrays of single-photon diodes: direct time of flight by histograms (Kahlmann 2007, sec. 2.3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import Settings
from rim_camera_ros.measurement.base import FrameCorrection, FrameSimulation, OneFrequency
from rim_camera_ros.noise import Noise, NoiseFactors
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.scene import Scene
from rim_camera_ros.single_photon.detector import PulseAndDiode, SinglePhotonDetector
from rim_camera_ros.single_photon.estimation import PulseEstimator, fisher_sigma

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Signals [photons] at which the noise is fitted to the bound: the least one, which it describes to 10 %, and
#: their number up to saturation.
_FEWEST, _SIGNALS = 50.0, 30
#: Relative step of dark counts for which the bound is computed anew.
_ALIKE = 0.02
#: So many cycles that no photon hides another (no pile-up).
_MANY = 10**9
#: Least length of a period in standard deviations of the pulse.
_ROOM = 16.0


@dataclass(frozen=True, kw_only=True)
class SinglePhoton(PulseAndDiode, OneFrequency):
    """Histograms of the times of first photons; pulses come at the sensor's modulation frequency.

    The amplitude is the number of signal photons of an exposure. The level of ``background_light`` is that of
    the other photons which come within the pulse's effective width, 4 sqrt(pi) sigma_t.
    """

    type: ClassVar[str] = "single_photon"
    samples: ClassVar[tuple[str, ...]] = ("histogram",)
    demodulates: ClassVar[bool] = False

    def detector(self, camera: Camera) -> SinglePhotonDetector:
        """Return pulse, diode and clock."""
        keys = {field.name: getattr(self, field.name) for field in fields(PulseAndDiode)}
        return SinglePhotonDetector(pulse_rate=camera.sensor.modulation_frequency, **keys)

    def check(self, camera: Camera) -> None:
        """Raise ValueError for a pulse longer than the period allows, or effects of demodulation."""
        detector = self.detector(camera)
        if detector.period < _ROOM * detector.time_sigma:
            raise ValueError(
                f"a period of {detector.period * 1e9:.3g} ns has no room for pulses of "
                f"{detector.time_sigma * 1e9:.3g} ns (1-sigma with the jitter): lower modulation_frequency"
            )
        check_effects(camera, "a direct measurement of time")

    def simulation(
        self, camera: Camera, scene: Scene, *, waveform: Waveform | None = None, **options: Any
    ) -> FrameSimulation:
        """Return the chain of effects with photons counted at its end."""
        from rim_camera_ros.single_photon.simulation import SinglePhotonSimulation

        check_waveform(waveform)
        return SinglePhotonSimulation(camera, scene, **options)

    def correction(self, camera: Camera, **options: Any) -> FrameCorrection:
        """Return the chain of effects in reverse, after the evaluation of a histogram where there is one."""
        from rim_camera_ros.pipeline.resolved import ResolvedCorrection

        detector = self.detector(camera)
        estimator = PulseEstimator(detector)

        def resolve(planes: NDArray[Any], settings: Settings) -> tuple[Any, Any, Any]:
            cycles = detector.cycles(camera.sensor.exposure_seconds(camera.integration_time(settings)))
            found = estimator.estimate(planes.reshape(len(planes), -1), cycles=cycles)
            shape = planes.shape[1:]
            return tuple(one.reshape(shape) for one in (found.distance, found.signal, found.sigma))  # type: ignore[return-value]

        return ResolvedCorrection(
            camera,
            resolve,
            role=self.samples[0],
            count=detector.bins,
            **options,
        )

    def coincident(self, camera: Camera) -> float:
        """Return the share of a period that is the pulse's effective width, 4 sqrt(pi) sigma_t / T.

        If b is the other light within it, the bound under much other light is sigma^2 = (c sigma_t / 2)^2 b /
        S^2.
        """
        detector = self.detector(camera)
        return 4.0 * math.sqrt(math.pi) * detector.time_sigma / detector.period

    def unmodulated(self, camera: Camera) -> float:
        """Return the photons of unmodulated light in an exposure, over the whole period."""
        return camera.background / self.coincident(camera)

    def noise(self, camera: Camera) -> Noise:
        """Return the noise of a distance without a histogram: the model nearest to the Cramer-Rao bound.

        It is for the integration time and the temperature that the file states.
        """
        dark = self._dark_counts(camera, camera.sensor.integration_time or 0.0, None)
        shot, amplitude = _nearest(self.detector(camera), dark, camera.sensor.saturation)
        return Noise(floor=0.0, shot=shot, amplitude=amplitude, circular_range=2.0 * math.pi * shot)

    def noise_factors(
        self, camera: Camera, distance: NDArray[Any], settings: Settings
    ) -> NoiseFactors | None:
        """Return the factors by which dark counts at these settings exceed those stated by the file."""
        time = camera.stated_integration_time(settings)
        if time is None or camera.sensor.integration_time is None:
            return None
        detector, most = self.detector(camera), camera.sensor.saturation
        given = self._dark_counts(camera, time, settings.body_temperature)
        stated = self._dark_counts(camera, camera.sensor.integration_time, None)
        if not given > 0 < stated:
            return None
        # rounded, so that the bound is computed for few numbers of dark counts
        near = stated * math.exp(round(math.log(given / stated) / _ALIKE) * _ALIKE)
        (photons, read_out), own = _nearest(detector, near, most), _nearest(detector, stated, most)
        return NoiseFactors((photons / own[0]) ** 2, (read_out / own[1]) ** 2, 1.0)

    def _dark_counts(self, camera: Camera, time: float, temperature: float | None) -> float:
        """Return the dark counts of an exposure."""
        return self.detector(camera).dark_rate(temperature) * camera.sensor.exposure_seconds(time)

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return the properties of pulse, diode and bins."""
        detector = self.detector(camera)
        return [
            (
                "single photons",
                f"{detector.bins} bins of {detector.bin_width * 1e12:.4g} ps; pulse "
                f"{self.pulse_width * 1e12:g} ps, jitter {self.jitter * 1e12:g} ps, dead time "
                f"{self.dead_time * 1e9:g} ns",
            ),
            (
                "dark counts",
                f"{self.dark_count_rate:g} Hz at {self.dark_count_temperature:g} degC, twice as many "
                f"{self.dark_count_doubling:g} degC warmer",
            ),
        ]


@lru_cache(maxsize=256)
def _nearest(detector: SinglePhotonDetector, dark: float, most: float) -> tuple[float, float]:
    """Return shot [m sqrt(counts)] and amplitude [m counts] of the noise nearest to the Cramer-Rao bound.

    By relative least squares of the variances over the signals [photons] up to ``most``, without pile-up.
    The other light consists of ``dark`` counts and afterpulses. Because of the bins shot exceeds
    c sigma_t / 2.
    """
    signals = np.geomspace(_FEWEST, most, _SIGNALS)
    bounds = [
        fisher_sigma(
            detector,
            distance=detector.ambiguity / 2.0,
            signal=float(signal),
            background=dark + detector.afterpulse_probability * float(signal),
            cycles=_MANY,
        )
        for signal in signals
    ]
    from scipy.optimize import nnls  # takes a good part of a node's start

    terms = np.stack([1.0 / signals, 1.0 / signals**2], axis=1) / np.square(bounds)[:, None]
    shot, amplitude = np.sqrt(nnls(terms, np.ones(_SIGNALS))[0])
    return float(shot), float(amplitude)


def check_effects(camera: Camera, way: str) -> None:
    """Raise ValueError for effects of demodulation in the file of a camera that does not demodulate."""
    found = [name for name, effect in camera.effects.items() if effect.demodulates]
    if found:
        raise ValueError(f"effects.{found[0]} does not act on {way}: remove it")


def check_waveform(waveform: Waveform | None) -> None:
    """Raise `InputError` where samples of a demodulation are requested."""
    from rim_camera_ros.errors import InputError

    if waveform is not None:
        raise InputError("a waveform is for demodulated light, this camera has pulses", place="waveform")
