"""Facts on the cameras on USB: which are connected, and what is missing to take frames."""

from __future__ import annotations

from typing import Any

from rim_camera_ros.devices.supervision import probe_library
from rim_camera_ros.devices.usb import UsbCamera, UsbCameras, UsbUnavailable
from rim_camera_ros.errors import RimError


def usb_facts(cameras: UsbCameras | None = None, *, library: str | None = None) -> dict[str, Any]:
    """Return plain facts.

    ``cameras``: a list with ``model``, ``ids``, ``file``, ``state`` and ``problem`` of each, None where pyusb
    or libusb is missing. ``library``: ``file`` and ``version`` of libmesasr, None where it cannot be used.
    ``missing``: sentences, empty where frames can be taken. The argument ``library``: its path; None: that of
    the environment variable, or the system's.
    """
    facts: dict[str, Any] = {"cameras": None, "library": None, "missing": []}
    missing: list[str] = facts["missing"]
    try:
        found = (cameras or UsbCameras()).find()
    except UsbUnavailable as error:
        missing.append(f"{error}; without it nobody can say what is connected")
    else:
        facts["cameras"] = [_camera(usb_camera) for usb_camera in found]
        if not found:
            missing.append("no SwissRanger is connected (plug it in and switch it on)")
        elif all(fact["problem"] for fact in facts["cameras"]):
            missing.extend(fact["problem"] for fact in facts["cameras"])
    try:
        facts["library"] = probe_library(library)
    except RimError as error:
        missing.append(str(error))
    return facts


def usb_text(facts: dict[str, Any]) -> str:
    """Return the facts as text, one line for each connected camera and each missing part."""
    lines = []
    for fact in facts["cameras"] or ():
        lines.append(f"{fact['model']} ({fact['ids']}) at {fact['file']}: {fact['state']}")
    if facts["library"]:
        lines.append(f"libmesasr {facts['library']['version']}: {facts['library']['file']}")
    lines += [f"missing: {fact}" for fact in facts["missing"]]
    if not facts["missing"]:
        lines.append("frames can be taken")
    return "\n".join(lines)


def _camera(usb_camera: UsbCamera) -> dict[str, Any]:
    error = usb_camera.error()
    return {
        "model": usb_camera.model.name,
        "ids": f"{usb_camera.vendor:04x}:{usb_camera.product:04x}",
        "file": usb_camera.file,
        "state": usb_camera.state,
        "problem": None if error is None else str(error),
    }
