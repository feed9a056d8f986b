"""The terms that the camera file describes, of the interface's form: the file has to state them exactly."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .sensor import PLUMB_BOB, Array, Sensor, axis_angle_squared

COUNTS_OF_THESIS = 0.12
"""Our amplitude counts per count of the thesis."""
GAIN = 500.0 * COUNTS_OF_THESIS
TABLE_3_4 = {16: (85.71, 0.995), 60: (237.0, 15.71), 100: (383.3, 4.036)}
TABLE_3_5 = {
    16: (5.768e-9, -4.555e-7, 9.834e-6, 5.655e-4),
    60: (4.122e-9, -1.806e-7, 1.757e-6, 2.996e-4),
    100: (3.065e-9, -1.691e-7, 4.899e-6, 2.817e-4),
}
NAMES = ("emission_pattern", "amplitude_offset", "cyclic_error", "incidence_angle", "integration_time_offset")


@dataclass(frozen=True)
class Cyclic:
    """amplitude * sin(4 phi + phase + gradient . (u - cx, v - cy))."""

    amplitude: float
    phase: float
    gradient: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """The camera as the tool is told it; a term that is None is left out."""

    sensor: Sensor
    gain: float = GAIN
    gain_sigma: float = 0.01
    floor: float = 0.002
    shot: float = 0.0
    read: float = 4.0
    saturation: int = 65535
    threshold: int = 40
    falloff: tuple[float, float] | None = None
    hyperbola: dict[int, tuple[float, float]] | None = None
    cyclic: Cyclic | None = None
    incidence: dict[int, tuple[float, float, float, float]] | None = None
    offset: dict[int, float] | None = None

    def without(self, names: "tuple[str, ...] | list[str]") -> "Camera":
        """The camera without the terms of these names; other names are ignored."""
        fields = dict(zip(NAMES, ("falloff", "hyperbola", "cyclic", "incidence", "offset"), strict=True))
        return replace(self, **{fields[name]: None for name in names if name in fields})

    def relative_power(self, rays: Array) -> Array:
        """Emission pattern along rays, (...)."""
        return self.pattern(axis_angle_squared(rays))

    def pattern(self, q: Array) -> Array:
        """Emission pattern at squared angles from the axis."""
        if self.falloff is None:
            return np.ones_like(q)
        return np.asarray(1.0 + self.falloff[0] * q + self.falloff[1] * q * q)

    def sigma(self, amplitude: Array) -> Array:
        """1-sigma of one distance, metres."""
        safe = np.maximum(amplitude, 1e-3)
        return np.asarray(np.sqrt(self.floor**2 + self.shot**2 / safe + (self.read / safe) ** 2))

    def measurable(self, amplitude: Array, settings: Array) -> "np.ndarray":
        """True where the hyperbola gives a distance."""
        if self.hyperbola is None:
            return np.ones(amplitude.shape, bool)
        return np.asarray(
            amplitude > per_setting({T: b for T, (_, b) in self.hyperbola.items()}, settings) + 1.0
        )

    def metres(self, distance: Array, amplitude: Array, incidence: Array, settings: Array) -> Array:
        """Sum of the terms at noise-free distance [m], amplitude [counts], incidence [rad].

        `settings` is the integration time of every exposure, (n,).
        """
        total = np.zeros_like(distance)
        if self.hyperbola is not None:
            a = per_setting({T: row[0] for T, row in self.hyperbola.items()}, settings)
            b = per_setting({T: row[1] for T, row in self.hyperbola.items()}, settings)
            total += a / np.maximum(amplitude - b, 1.0)
        if self.cyclic is not None:
            total += self.cyclic.amplitude * np.sin(self.cyclic_angle(distance, self.cyclic))
        if self.incidence is not None:
            x = gon(incidence)
            c4, c3, c2, c1 = (
                per_setting({T: row[k] for T, row in self.incidence.items()}, settings) for k in range(4)
            )
            total -= x * (c1 + x * (c2 + x * (c3 + x * c4)))
        if self.offset is not None:
            total += per_setting(self.offset, settings)
        return total

    def cyclic_angle(self, distance: Array, cyclic: Cyclic) -> Array:
        """Argument of the cyclic error's sine."""
        u, v = self.sensor.grid()
        (cx, cy), (gu, gv) = self.sensor.principal_point, cyclic.gradient
        return 8.0 * np.pi * distance / self.sensor.ambiguity + cyclic.phase + gu * (u - cx) + gv * (v - cy)

    def document(self) -> dict[str, Any]:
        """The camera file, format rim_camera/1."""
        (fx, fy), (cx, cy) = self.sensor.focal_lengths, self.sensor.principal_point
        effects: dict[str, Any] = {}
        if self.falloff is not None:
            effects["emission_pattern"] = {"falloff": list(self.falloff)}
        if self.hyperbola is not None:
            effects["amplitude_offset"] = {
                "hyperbola": {T: {"a": a, "b": b} for T, (a, b) in self.hyperbola.items()}
            }
        if self.cyclic is not None:
            effects["cyclic_error"] = {
                "harmonics": [{"order": 4, "amplitude": self.cyclic.amplitude, "phase": self.cyclic.phase}],
                "gradient": list(self.cyclic.gradient),
            }
        if self.incidence is not None:
            effects["incidence_angle"] = {"polynomial": {T: list(row) for T, row in self.incidence.items()}}
        if self.offset is not None:
            effects["integration_time_offset"] = {"offset": dict(self.offset)}
        return {
            "format": "rim_camera/1",
            "device": "SR-3000",
            "sensor": {
                "width": self.sensor.width,
                "height": self.sensor.height,
                "pixel_pitch": list(self.sensor.pitch),
                "modulation_frequency": 20e6,
                "distance_lsb": None,
                "saturation": self.saturation,
                "amplitude_threshold": self.threshold,
            },
            "optics": {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "d": list(PLUMB_BOB)},
            "radiometry": {"gain": self.gain, "gain_sigma": self.gain_sigma},
            "noise": {"floor": self.floor, "shot": self.shot, "amplitude": self.read},
            "effects": effects,
        }


def gon(angle: Array) -> Array:
    """Angle of incidence in gon, at most 90."""
    return np.minimum(np.abs(angle) * 200.0 / np.pi, 90.0)


def per_setting(rows: dict[int, float], settings: Array) -> Array:
    """The row of each exposure's integration time, (n, 1, 1)."""
    return np.array([rows[int(T)] for T in np.ravel(settings)])[:, None, None]


def draw_camera(sensor: Sensor, seed: int) -> Camera:
    """A SR-3000 like that of the thesis' tables, each term a little different from seed to seed."""
    rng = np.random.default_rng([seed, 2])
    scale = rng.uniform(0.85, 1.15) * COUNTS_OF_THESIS
    size = 88.0 / sensor.width
    slope = rng.normal(0.0, 0.004, 2) * size if rng.uniform() < 0.5 else np.zeros(2)
    return Camera(
        sensor=sensor,
        shot=0.05 if rng.uniform() < 0.5 else 0.0,
        falloff=(float(np.round(rng.uniform(-1.7, -1.4), 3)), float(np.round(rng.uniform(0.7, 0.95), 3))),
        hyperbola={T: (float(a * scale), float(b * COUNTS_OF_THESIS)) for T, (a, b) in TABLE_3_4.items()},
        cyclic=Cyclic(
            float(rng.uniform(0.006, 0.012)),
            float(rng.uniform(-np.pi, np.pi)),
            (float(slope[0]), float(slope[1])),
        ),
        incidence=dict(TABLE_3_5),
        offset={16: -0.031, 60: -0.004, 100: 0.003},
    )
