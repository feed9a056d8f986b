"""A camera file as text with a comment at every key: meaning, unit, and the source of its value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import CAMERA_FORMAT

_SECTIONS = ("sensor", "optics", "radiometry", "noise")
_COLUMN = 46


def camera_text(camera: Camera, *, why: Mapping[str, str], heading: str) -> str:
    """Return the text of a camera file without effects.

    ``why``: the source of a value by dotted path. A key without one has its default value, and the comment
    says so.
    """
    lines = [f"# {line}".rstrip() for line in heading.splitlines()]
    lines += [_line("format", CAMERA_FORMAT, "kind of file and version"), ""]
    lines.append(_line("device", camera.device, why.get("device", "name of the camera")))
    for section in _SECTIONS:
        part = getattr(camera, section)
        lines += ["", f"{section}:"]
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            unit = field.metadata.get("unit", "-")
            meaning = field.metadata.get("doc", field.name) + (f" [{unit}]" if unit != "-" else "")
            origin = why.get(f"{section}.{field.name}")
            if origin is None:
                origin = "default" if field.default == value else "as stated"
            lines.append(_line(f"  {field.name}", value, f"{meaning}; {origin}"))
    minimum = "below it no point [counts]; null: where the amplitude term's noise exceeds the range noise"
    lines += ["", _line("minimum_amplitude", camera.minimum_amplitude, minimum)]
    lines.append(_line("effects", {}, "none is known yet: rim calibrate and rim diagnose find them"))
    lines += ["", "provenance:"]
    lines += [_line(f"  {key}", value, "") for key, value in camera.provenance.items()]
    return "\n".join(lines) + "\n"


def _line(key: str, value: Any, comment: str) -> str:
    left = f"{key}: {_plain(value)}"
    return f"{left:<{_COLUMN - 1}} # {comment}" if comment else left


def _plain(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_plain(one) for one in value)}]"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, str):
        plain = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
        return value if value.replace("/", "").replace("_", "").isalnum() else f'"{plain}"'
    return str(value)


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(f"{value} is no value of a camera file")
    text = f"{value:.10g}"
    return text if any(one in text for one in ".en") else f"{text}.0"
