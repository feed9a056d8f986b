"""Settings of a SwissRanger, in the units of the driver, checked without a camera.

Numbers are those of the vendor's public headers (definesSR.h, libMesaSR.h of libmesasr 1.0.14). Nothing here
imports numpy, so that the acquisition process starts fast.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rim_camera_ros.errors import InputError, nearest_name

#: Integration time register: 8 bits. SR-2 (second series) and SR-3000 expose (n + 1) * 0.2 ms per sample.
INTEGRATION_TIME_LIMITS = (0, 255)
#: Amplitudes are 16 bits.
AMPLITUDE_LIMITS = (0, 65535)
#: Modulation frequencies in Hz that the enumeration ModulationFrq names for the SR-3000.
MODULATION_FREQUENCIES = (40e6, 30e6, 21e6, 20e6, 19e6)

#: Processing in camera and library, by name: bits of AcquireMode. AM_TOGGLE_FRQ is excluded because frames do
#: not state their frequency then, AM_CONV_GRAY because it replaces the amplitude.
MODE_BITS: Mapping[str, int] = {"fixed_pattern": 0x01, "median": 0x04}
#: No processing, what the correction of this package needs.
RAW = "raw"


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoExposure:
    """The library's control of the integration time; the defaults are the vendor's for the SR-3000.

    The integration time is moved slowly between ``least`` and ``greatest`` (register) until ``percent_over``
    percent of the pixels lie above ``position`` in the histogram of amplitudes (8 bits).
    """

    least: int = 5
    greatest: int = 255
    percent_over: int = 10
    position: int = 45

    def __post_init__(self) -> None:
        limits = {"least": (0, 254), "greatest": (0, 255), "percent_over": (0, 100), "position": (0, 255)}
        for name, (low, high) in limits.items():
            _whole(getattr(self, name), low, high, f"auto_exposure.{name}")
        if self.least > self.greatest:
            raise InputError(
                f"least {self.least} is above greatest {self.greatest}", place="auto_exposure.least"
            )

    def __str__(self) -> str:
        return f"{self.least} to {self.greatest}, {self.percent_over} % above {self.position}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """All settings that are applied together between two frames; None: as the camera was when it was opened.

    ``integration_time``: register 0..255. ``modulation_frequency`` in Hz. ``amplitude_threshold`` in counts:
    pixels with less deliver distance 0. ``frame_rate`` in Hz, None: as fast as the camera delivers.
    ``mode``: names of `MODE_BITS` joined by ``+``, or ``raw``. Raises `InputError` for anything else.
    """

    integration_time: float | None = None
    modulation_frequency: float | None = None
    amplitude_threshold: int = 0
    auto_exposure: AutoExposure | None = None
    frame_rate: float | None = None
    mode: str = RAW

    def __post_init__(self) -> None:
        if self.integration_time is not None:
            _whole(self.integration_time, *INTEGRATION_TIME_LIMITS, "integration_time")
            if self.auto_exposure is not None:
                raise InputError(
                    "auto exposure sets the integration time itself",
                    place="integration_time",
                    remedy="leave the integration time at its default, or turn auto exposure off",
                )
        if self.modulation_frequency is not None and self.modulation_frequency not in MODULATION_FREQUENCIES:
            raise InputError(
                f"the camera has no modulation frequency {self.modulation_frequency / 1e6:g} MHz",
                place="modulation_frequency",
                remedy=f"known: {', '.join(f'{hertz / 1e6:g}' for hertz in MODULATION_FREQUENCIES)} MHz",
            )
        _whole(self.amplitude_threshold, *AMPLITUDE_LIMITS, "amplitude_threshold")
        if self.frame_rate is not None and not (math.isfinite(self.frame_rate) and self.frame_rate > 0):
            raise InputError(f"frame rate {self.frame_rate:g} Hz is not positive", place="frame_rate")
        mode_bits(self.mode)

    def to_plain(self) -> dict[str, Any]:
        """Return the settings as plain data."""
        return asdict(self)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> CameraSettings:
        """Return the settings from the plain data of `to_plain`."""
        auto = plain["auto_exposure"]
        return cls(**{**plain, "auto_exposure": None if auto is None else AutoExposure(**auto)})


def mode_bits(mode: str) -> int:
    """Return the bits of AcquireMode for a mode by name. Raises `InputError` for an unknown one."""
    bits = 0
    if mode != RAW:
        for name in mode.split("+"):
            if name not in MODE_BITS:
                raise InputError(
                    f"no mode '{name}'", place="mode", remedy=nearest_name(name, [RAW, *MODE_BITS])
                )
            bits |= MODE_BITS[name]
    return bits


def mode_name(bits: int) -> str:
    """Return the names of the bits of AcquireMode, bits without a name as a hexadecimal number."""
    names = [name for name, bit in MODE_BITS.items() if bits & bit]
    rest = bits & ~sum(MODE_BITS.values())
    return "+".join([*names, *([f"0x{rest:02x}"] if rest else [])]) or RAW


def modes() -> Iterable[str]:
    """Return the names of all modes."""
    return (RAW, *MODE_BITS, "+".join(MODE_BITS))


def _whole(value: float, low: int, high: int, place: str) -> None:
    if not (low <= value <= high) or value != int(value):
        raise InputError(f"{value:g} is not a whole number from {low} to {high}", place=place)
