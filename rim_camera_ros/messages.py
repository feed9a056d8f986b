"""For programs that read the topics: the contents of messages as numbers and names. Needs no ROS.

The functions take messages of rclpy, or of rosbags for recordings. Contents that are sent as text are
documented key by key in docs/messages.md; a key that a message lacks is None here.

    from rim_camera_ros import messages
    settings = messages.frame_info(message).settings
    cloud = messages.cloud(message)          # x, y, z, intensity, and sigma and flags where they are sent
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags.messages import points_array, settings_from, stamp_of
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Flag, Settings

_NOTHING: Mapping[str, str] = MappingProxyType({})
#: Numbers of the types uint8 and float32 of a PointField.
_UINT8, _FLOAT32 = 2, 7


@dataclass(frozen=True)
class Status:
    """One status of a DiagnosticArray: level 0 fine, 1 warning, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]
    hardware_id: str = ""

    def number(self, key: str) -> float | None:
        """Return a value as a number, None where it is missing or not a finite number (such as "unknown")."""
        try:
            value = float(self.values[key])
        except (KeyError, ValueError):
            return None
        return value if math.isfinite(value) else None


@dataclass(frozen=True)
class FrameInfo:
    """The camera's settings with one frame; ``stamp`` [ns] is that of its images."""

    stamp: int
    device: str
    settings: Settings


@dataclass(frozen=True)
class DeviceInfo:
    """Which camera delivers, and which camera file describes it; None where it is not known.

    ``modulation_frequency`` [Hz]. ``file_sha256`` is of the camera file's bytes, hexadecimal.
    """

    device: str
    source: str | None
    serial_number: str | None
    firmware: str | None
    modulation_frequency: float | None
    file: str | None
    file_sha256: str | None
    values: Mapping[str, str] = _NOTHING


@dataclass(frozen=True)
class Progress:
    """Progress of a calibration or recording.

    ``fraction`` 0 to 1, None where the end is not known; ``seconds`` [s] since it began.
    """

    state: str
    stage: str | None
    fraction: float | None
    seconds: float | None
    message: str


@dataclass(frozen=True)
class Result:
    """How a calibration or recording ended: ``state`` is done, recorded, cancelled or failed.

    ``systematic`` [m] is the systematic error on held-out poses, ``reason`` says why it failed.
    """

    state: str
    file: str | None
    systematic: float | None
    chi_square: float | None
    effects: tuple[str, ...]
    reason: str | None
    message: str


def statuses(message: Any) -> dict[str, Status]:
    """Return the statuses of a DiagnosticArray by name; if a key occurs twice the first counts."""
    found: dict[str, Status] = {}
    for one in message.status:
        values: dict[str, str] = {}
        for pair in one.values:
            values.setdefault(str(pair.key), str(pair.value))
        # rclpy has a byte as bytes, rosbags as a number
        level = one.level[0] if isinstance(one.level, bytes) else int(one.level)
        found[str(one.name)] = Status(str(one.name), level, str(one.message), values, str(one.hardware_id))
    return found


def frame_info(message: Any) -> FrameInfo:
    """Return the contents of a frame_info message; `InputError` for a value that is not a possible number."""
    settings, device = settings_from(message)
    return FrameInfo(stamp_of(message), device, settings)


def device_info(message: Any) -> DeviceInfo:
    """Return the contents of a device_info message; `InputError` where it has no status."""
    status = _only(message, "device_info")
    values = status.values
    return DeviceInfo(
        device=status.hardware_id,
        source=values.get("source"),
        serial_number=values.get("serial_number"),
        firmware=values.get("firmware"),
        modulation_frequency=status.number("modulation_frequency"),
        file=values.get("file"),
        file_sha256=values.get("file_sha256"),
        values=values,
    )


def progress(message: Any) -> Progress:
    """Return the contents of a message of calibration/progress; `InputError` where it has no status."""
    status = _only(message, "progress")
    done, total = status.number("done"), status.number("total")
    return Progress(
        state=status.values.get("state", ""),
        stage=status.values.get("stage"),
        fraction=done / total if done is not None and total else None,
        seconds=status.number("seconds"),
        message=status.message,
    )


def result(message: Any) -> Result:
    """Return the contents of a message of calibration/result; `InputError` where it has no status."""
    status = _only(message, "result")
    millimetres = status.number("systematic_mm")
    listed = (name.strip() for name in status.values.get("effects", "").split(","))
    return Result(
        state=status.values.get("state", ""),
        file=status.values.get("file"),
        systematic=None if millimetres is None else millimetres / 1e3,
        chi_square=status.number("chi_square"),
        effects=tuple(name for name in listed if name not in ("", "none")),
        reason=status.values.get("reason"),
        message=status.message,
    )


def cloud(message: Any) -> dict[str, NDArray[Any]]:
    """Return the fields of a cloud of the correction by name, each (H, W).

    x y z [m], intensity [counts] float32; sigma [m] float32 and flags uint8 where points.fields sends them.
    Raises `InputError` for a cloud of another layout.
    """
    points = points_array(message)
    found: dict[str, NDArray[Any]] = {
        name: points[..., i] for i, name in enumerate(("x", "y", "z", "intensity"))
    }
    step = int(message.point_step)
    order = ">" if message.is_bigendian else "<"
    for field in message.fields[4:]:
        kind = {_UINT8: "u1", _FLOAT32: "f4"}.get(int(field.datatype))
        if kind is None or not 16 <= int(field.offset) <= step - int(kind[1]):
            raise InputError(f"the field {field.name} is neither uint8 nor float32 within the point")
        layout = np.dtype(
            {"names": ["v"], "formats": [order + kind], "offsets": [int(field.offset)], "itemsize": step}
        )
        read = np.frombuffer(message.data, layout).reshape(points.shape[:2])["v"]
        found[str(field.name)] = np.ascontiguousarray(read, kind)
    return found


def flag_names(value: int) -> list[str]:
    """Return the names of the bits of a pixel's flags, for example ``['SATURATED', 'MIXED_PIXEL']`` of 6."""
    return [str(flag.name) for flag in Flag if value & flag.value]


def _only(message: Any, what: str) -> Status:
    found = statuses(message)
    if not found:
        raise InputError(f"the message of {what} has no status")
    return next(iter(found.values()))
