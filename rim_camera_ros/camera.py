"""The camera: sensor, optics, radiometry, noise, and the effects that its file switches on."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics, Settings
from rim_camera_ros.noise import Noise
from rim_camera_ros.optics import Optics, pixel_rays
from rim_camera_ros.parameters import ArrayFile, quantity
from rim_camera_ros.phasor import ambiguity_range

FULL_SCALE = 65536

_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Sensor:
    """Array size, modulation, counts."""

    width: int = quantity("px", "number of columns", minimum=1, maximum=8192)
    height: int = quantity("px", "number of rows", minimum=1, maximum=8192)
    modulation_frequency: float = quantity("Hz", "modulation frequency", minimum=1e3)
    pixel_pitch: tuple[float, float] | None = quantity(
        "m", "pixel spacing along row and column; null: not known", default=None, above=0.0
    )
    distance_lsb: float | None = quantity(
        "m", "metres per count; null: ambiguity range / 65536", default=None, above=0.0
    )
    saturation: float = quantity("counts", "amplitude at which a pixel saturates", default=65535.0, above=0.0)
    amplitude_threshold: float = quantity(
        "counts", "a pixel whose measured amplitude is below it delivers 0 and 0", default=0.0, minimum=0.0
    )
    background_suppression: float | None = quantity(
        "dB",
        "what a circuit in the pixel takes of the unmodulated light, by 20 log10; the rest fills the "
        "pixel as modulated light does; null: unmodulated light fills no pixel",
        default=None,
        minimum=0.0,
        maximum=200.0,
    )
    exposure: tuple[float, float] = quantity(
        "s", "seconds = first + second * integration_time", default=(0.0002, 0.0002), minimum=0.0
    )
    integration_time: float | None = quantity(
        "device unit", "setting of recordings without frame_info", default=None, above=0.0
    )

    @property
    def ambiguity(self) -> float:
        """Ambiguity range L in metres."""
        return ambiguity_range(self.modulation_frequency)

    @property
    def lsb(self) -> float:
        """Metres per distance count."""
        return self.distance_lsb if self.distance_lsb is not None else self.ambiguity / FULL_SCALE

    @property
    def wraps(self) -> bool:
        """Whether counts wrap at the ambiguity range (if not, the camera has resolved the wraps itself)."""
        return FULL_SCALE * self.lsb <= self.ambiguity * (1 + 1e-6)

    def remaining(self, background: float) -> float:
        """Return the counts by which unmodulated light of ``background`` counts fills a pixel.

        They are background * 10^(-suppression / 20) (Kahlmann 2007, sec. 2.3.2 and table 2.3, suppression of
        background illumination). A pixel saturates where their sum with its amplitude reaches `saturation`.
        Photon noise remains that of all the light (sec. 2.3.1).
        """
        suppression = self.background_suppression
        return 0.0 if suppression is None else background * 10.0 ** (-suppression / 20.0)

    def exposure_seconds(self, integration_time: float) -> float:
        """Return the exposure in seconds of an integration time in the device's own unit."""
        return self.exposure[0] + self.exposure[1] * integration_time


@dataclass(frozen=True)
class Radiometry:
    """amplitude = gain * integration_time * reflectivity * cos(incidence) * falloff / distance^2."""

    gain: float = quantity(
        "counts*m^2/unit", "amplitude per integration time at 1 m", default=500.0, above=0.0
    )
    gain_sigma: float = quantity(
        "-", "relative variation of the emitted power from pose to pose", default=0.0, minimum=0.0, below=1.0
    )
    pattern_sigma: float = quantity(
        "-", "relative variation of the gain from pixel to pixel", default=0.02, minimum=0.0, below=1.0
    )


@dataclass(frozen=True)
class Validity:
    """Ranges within which the calibration is valid; None: not stated."""

    distance: tuple[float, float] | None = quantity("m", "least and greatest", default=None)
    amplitude: tuple[float, float] | None = quantity("counts", "least and greatest", default=None)
    integration_time: tuple[float, float] | None = quantity("device unit", "least, greatest", default=None)
    temperature: tuple[float, float] | None = quantity("degC", "least and greatest", default=None)
    region: tuple[float, float, float, float] | None = quantity("px", "u0 v0 u1 v1, inclusive", default=None)

    def __post_init__(self) -> None:
        for name in ("distance", "amplitude", "integration_time", "temperature"):
            limits = getattr(self, name)
            if limits is not None and not limits[0] <= limits[1]:
                raise ValueError(f"{name}: the first value must not exceed the second")
        if self.region is not None and not (
            self.region[0] <= self.region[2] and self.region[1] <= self.region[3]
        ):
            raise ValueError("region: expected u0 v0 u1 v1 with u0 <= u1 and v0 <= v1")


@dataclass(frozen=True)
class Covariance:
    """Covariance of parameters named by dotted paths, in their own units."""

    parameters: tuple[str, ...] = quantity("-", "dotted paths", most=10_000)
    matrix: ArrayFile = quantity("-", "square .npy file in the order of the parameters")

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if self.matrix.values.shape != (n, n):
            raise ValueError(f"matrix has shape {self.matrix.values.shape}, expected ({n}, {n})")

    def without(self, prefixes: Collection[str]) -> Covariance | None:
        """Return the covariance of parameters whose paths begin with none of the prefixes, or None."""
        kept = [i for i, parameter in enumerate(self.parameters) if not parameter.startswith(tuple(prefixes))]
        if len(kept) == len(self.parameters):
            return self
        matrix = ArrayFile(self.matrix.file, self.matrix.values[np.ix_(kept, kept)])
        return Covariance(tuple(self.parameters[i] for i in kept), matrix) if kept else None


@dataclass(frozen=True)
class Camera:
    """The content of a camera file. ``effects``: parameter objects of `rim_camera_ros.effects` by name.

    ``minimum_amplitude``: None is the amplitude at which the noise by the amplitude term exceeds the range
    noise. ``measurement``: None for one modulation frequency, else an object of `rim_camera_ros.measurement`;
    ``channels``: with several frequencies the ordinary camera of each.
    """

    sensor: Sensor
    optics: Optics
    device: str = "unnamed"
    radiometry: Radiometry = field(default_factory=Radiometry)
    noise: Noise = field(default_factory=Noise)
    minimum_amplitude: float | None = None
    effects: Mapping[str, Any] = _EMPTY
    validity: Validity = field(default_factory=Validity)
    covariance: Covariance | None = None
    provenance: Mapping[str, Any] = _EMPTY
    measurement: Any = None
    channels: tuple[Camera, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return (self.sensor.height, self.sensor.width)

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """Unit rays (height, width, 3) in the optical frame."""
        return pixel_rays(self.optics, width=self.sensor.width, height=self.sensor.height)

    @property
    def intrinsics(self) -> Intrinsics:
        """The geometry as camera_info states it."""
        o = self.optics
        return Intrinsics(
            width=self.sensor.width, height=self.sensor.height, fx=o.fx, fy=o.fy, cx=o.cx, cy=o.cy, d=o.d
        )

    def stated_integration_time(self, settings: Settings) -> float | None:
        """Return the frame's integration time, or the camera file's, or None where neither is known."""
        value = settings.integration_time
        return self.sensor.integration_time if value is None else value

    def integration_time(self, settings: Settings) -> float:
        """Return the frame's integration time, or the camera file's where the recording has none.

        Raises `InputError` where neither is known or where it is not positive.
        """
        value = self.stated_integration_time(settings)
        if value is None:
            raise InputError(
                "the recording states no integration_time (no frame_info)",
                place="sensor.integration_time",
                remedy="give sensor.integration_time in the camera file",
            )
        if not value > 0:
            raise InputError(f"integration_time must be positive, found {value:g}", remedy="check frame_info")
        return value

    def light_of(self, published: Any) -> Any:
        """Return published amplitudes before their compression, as the noise model requires them."""
        for effect in self.effects.values():
            # that of the amplitude response, a `rim_camera_ros.effects.base.ResponseEffect`
            if hasattr(effect, "expanded"):
                return effect.expanded(published)
        return published

    def check_modulation(self, settings: Settings) -> None:
        """Raise `InputError` where a frame was taken at another modulation frequency than the file's."""
        frequency, own = settings.modulation_frequency, self.sensor.modulation_frequency
        if frequency is not None and abs(frequency / own - 1) > 1e-3:
            raise InputError(
                f"it was recorded at a modulation frequency of {frequency / 1e6:g} MHz, the camera file says "
                f"{own / 1e6:g} MHz",
                place="frame_info",
                remedy="give the camera file of that frequency: each is calibrated by itself",
            )

    def sigma_distance(
        self,
        amplitude: NDArray[Any],
        *,
        distance: NDArray[Any] | None = None,
        settings: Settings | None = None,
    ) -> NDArray[Any]:
        """Return the 1-sigma of one distance [m] at amplitudes [counts] before their compression.

        For some ways of measuring the noise depends on ``distance`` [m] and ``settings``; without both it is
        that of the noise section.
        """
        factors = None
        if distance is not None and settings is not None and self.measurement is not None:
            factors = self.measurement.noise_factors(self, distance, settings)
        return self.noise.sigma_distance(amplitude, background=self.background, factors=factors)

    @property
    def noise_range(self) -> float:
        """R in metres of the amplitude's noise, sigma_A = 2 pi A sigma_d / R (`Noise.circular_range`)."""
        stated = self.noise.circular_range
        return self.sensor.ambiguity if stated is None else stated

    @property
    def background(self) -> float:
        """Counts of unmodulated light by the effects, which only add noise."""
        return float(sum(effect.unmodulated_light for effect in self.effects.values()))
