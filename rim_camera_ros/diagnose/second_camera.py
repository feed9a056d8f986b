"""Light of a second camera, measured by the variation from frame to frame that all pixels share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.result import Missing
from rim_camera_ros.diagnose.variance import Variance
from rim_camera_ros.effects import ForeignLight
from rim_camera_ros.fit.data import KEPT_FRAMES, Station
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.phasor import selectivity_envelope

Array = NDArray[Any]

NAME = ForeignLight.name
_FREQUENCIES = 24
#: Nats by which another frequency must describe the integration times better than the camera's own.
_LEAST_GAIN = 3.0
#: Relative difference of the amplitude from a camera file's that matters.
_LEAST_CHANGE = 0.1
_OWN = (
    "camera.yaml holds the second camera with this camera's frequency, as that of the second one is not "
    "identifiable, and the light that demodulation leaves, the same in all pixels"
)
_FARTHER = (
    "camera.yaml holds the second camera with the nearest frequency with which its light depends on the "
    "integration time as recorded, the same in all pixels; one farther away with more light does the same"
)


@dataclass(frozen=True)
class SecondCamera:
    """A second camera by the frames of single poses, which the camera file lacks or states differently.

    ``effect`` describes it. Either ``missing`` is its entry where the file lacks it, or ``adjusted`` where
    the file's values change; the other one is None.
    """

    effect: ForeignLight
    missing: Missing | None
    adjusted: Adjusted | None
    notes: tuple[str, ...]


def second_camera(fitted: Fit, camera: Camera, variance: Variance) -> SecondCamera | None:
    """Fit a second camera to the light that all pixels share; None where the camera file has it right.

    By eq. 2.11 of Kahlmann (2007) only the amplitude after the frequency selectivity is measured. Beyond the
    first zero of the selectivity it falls with the integration time in the same way for every frequency: the
    nearest frequency then represents all that are farther away and have greater amplitudes. A frequency in
    the camera file is kept.
    """
    known = camera.effects.get(NAME)
    stations = [station for station in fitted.forward.dataset.stations if station.common_light is not None]
    if not stations or (known is None and not variance.pixels_vary_together):
        return None
    light = Light.of(stations, camera)
    own = stations[0].settings.modulation_frequency or camera.sensor.modulation_frequency
    before = known if isinstance(known, ForeignLight) else None
    difference = light.difference() if before is None else before.frequency - own
    effect = ForeignLight(
        before.frequency if before is not None else own + difference, light.amplitude(difference)
    )
    interval = light.interval(effect.amplitude, difference)
    if before is None:
        said = _missing(effect, interval, variance, fitted)
        return SecondCamera(effect, said, None, (_FARTHER if difference > 0 else _OWN,))
    change = abs(effect.amplitude - before.amplitude)
    if interval is None or change < _LEAST_CHANGE * before.amplitude:
        return None
    if interval[0] <= before.amplitude <= interval[1]:
        return None
    moved = Adjusted(NAME, {"amplitude": before.amplitude}, {"amplitude": effect.amplitude})
    return SecondCamera(effect, None, moved, ())


def with_second_camera(
    found: SecondCamera, verdict: str, missing: list[Missing], adjusted: list[Adjusted], model: Camera
) -> tuple[str, list[Missing], list[Adjusted], Camera]:
    """Add a second camera to a verdict, what is missing and adjusted, and the improved camera."""
    if found.missing is not None:
        missing = [*missing, found.missing]
        verdict = "missing_physics" if verdict != "unknown_physics" else verdict
    if found.adjusted is not None:
        adjusted = [*adjusted, found.adjusted]
        verdict = "wrong_parameters" if verdict == "consistent" else verdict
    return verdict, missing, adjusted, added(model, found.effect)


def _missing(
    effect: ForeignLight, interval: tuple[float, float] | None, variance: Variance, fitted: Fit
) -> Missing:
    scatter = _scatter(effect, fitted)
    known = "" if interval is None else f" ({interval[0]:.3g} to {interval[1]:.3g})"
    sentence = (
        f"{NAME}: all pixels vary together from frame to frame, "
        f"{variance.common or 0:,.0f} times as much as independent noise would: a second camera adds "
        f"{effect.amplitude:.3g} counts{known} of a phase that changes from frame to frame; distances of "
        f"single frames scatter by up to {scatter * 1e3:.3g} mm by it (99 % of them less)"
    )
    numbers = {"frequency": effect.frequency, "amplitude": effect.amplitude}
    intervals = {} if interval is None else {"amplitude": interval}
    return Missing(NAME, 1.0, numbers, intervals, sentence, magnitude=scatter)


@dataclass(frozen=True)
class Light:
    """Light that all pixels share, by station: its ``power`` and the power by ``noise`` [counts^2].

    ``weight`` are degrees of freedom, ``window`` is the exposure [s].
    """

    window: Array
    power: Array
    noise: Array
    weight: Array

    @classmethod
    def of(cls, stations: Sequence[Station], camera: Camera) -> Light:
        """Return the light that the pixels of stations share; each must have two frames or more."""
        power = np.array([station.common_light for station in stations], float)
        beyond = np.array([station.common for station in stations], float) - 1
        noise = np.divide(power, beyond, out=np.zeros_like(power), where=beyond != 0)
        frames = np.array([min(station.frames, KEPT_FRAMES) for station in stations])
        return cls(np.array([_window(station, camera) for station in stations]), power, noise, frames - 1.0)

    def picked(self, index: Array) -> Light:
        """Return the light of some stations, by their numbers."""
        return Light(self.window[index], self.power[index], self.noise[index], self.weight[index])

    def amplitude(self, difference: float) -> float:
        """Return the amplitude [counts] of greatest likelihood, before the frequency selectivity."""
        return self._fitted(difference)[0]

    def interval(self, amplitude: float, difference: float) -> tuple[float, float] | None:
        """Return the 95 % interval of an amplitude [counts] by a jackknife over stations.

        None for a single station.
        """
        number = len(self.power)
        if number < 2:
            return None
        left = [np.delete(np.arange(number), k) for k in range(number)]
        values = np.array([self.picked(index).amplitude(difference) for index in left])
        half = stdtrit(number - 1, 0.975) * np.sqrt((number - 1) * values.var())
        return max(float(amplitude - half), 0.0), float(amplitude + half)

    def difference(self) -> float:
        """Return the frequency difference [Hz] that describes the powers best; 0 unless it is much better."""
        if not (self.window > 0).all():
            return 0.0
        nearest, farthest = 1 / (np.pi * self.window.max()), 1 / (np.pi * self.window.min())
        tried = np.geomspace(nearest, farthest, _FREQUENCIES).tolist()
        losses = {difference: self._fitted(difference)[1] for difference in tried}
        best = min(losses, key=lambda difference: losses[difference])
        return best if losses[best] < self._fitted(0.0)[1] - _LEAST_GAIN else 0.0

    def _fitted(self, difference: float) -> tuple[float, float]:
        """Return the amplitude and the negative log likelihood [nats] of complex normal numbers."""
        passed = np.array(
            [selectivity_envelope(frequency_difference=difference, window=window) for window in self.window]
        )
        total = self.power + self.noise

        def loss(amplitude: float) -> float:
            model = (amplitude * passed) ** 2 + self.noise
            return float((self.weight * (np.log(model) + total / model)).sum())

        most = 2 * float(np.sqrt(total / passed**2).max())
        found = minimize_scalar(loss, bounds=(0.0, most), method="bounded")
        return float(found.x), float(found.fun)


def _window(station: Station, camera: Camera) -> float:
    own = station.settings.integration_time or camera.sensor.integration_time
    return 0.0 if own is None else camera.sensor.exposure_seconds(own)


def _scatter(effect: ForeignLight, fitted: Fit) -> float:
    """Return the standard deviation of single distances [m] that 99 % of the values stay below."""
    spread = [
        effect.scatter(prediction.amplitude[prediction.used], prediction.context)
        for prediction in fitted.forward.predictions(slopes=False)
    ]
    return float(np.quantile(np.concatenate(spread), 0.99))
