"""camera_info as YAML, as ROS' camera_calibration and camera_info_manager write and read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.optics import Optics
from rim_camera_ros.yaml_files import Document, read_yaml, write_yaml


def read_camera_info(path: Path) -> tuple[Optics, tuple[int, int]]:
    """Return optics and (height, width) of a camera_info file with distortion plumb_bob.

    Raises `InputError`, which names the key that is missing or wrong, also for another distortion model.
    """
    document = read_yaml(path)
    data = document.data if isinstance(document.data, dict) else {}
    model = data.get("distortion_model", "plumb_bob")
    if model != "plumb_bob":
        raise document.error(
            ("distortion_model",),
            f"the distortion model is {model!r}",
            "plumb_bob is needed; rim import converts others",
        )
    k = _numbers(document, "camera_matrix", 9).reshape(3, 3)
    d = _numbers(document, "distortion_coefficients", None)
    if d.size > 5 or not (k[0, 0] > 0 and k[1, 1] > 0):
        raise document.error(
            ("distortion_coefficients",) if d.size > 5 else ("camera_matrix",),
            f"{d.size} coefficients" if d.size > 5 else "a focal length is not positive",
            "plumb_bob has up to five: k1 k2 p1 p2 k3" if d.size > 5 else "fx 0 cx 0 fy cy 0 0 1",
        )
    size = []
    for key in ("image_height", "image_width"):
        value = data.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or value <= 0:
            raise document.error(
                (key,) if key in data else (), f"{key} is {value!r}", "pixels, a whole number"
            )
        size.append(value)
    k1, k2, p1, p2, k3 = (float(one) for one in (*d, *[0.0] * (5 - d.size)))
    optics = Optics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), (k1, k2, p1, p2, k3))
    return optics, (size[0], size[1])


def _numbers(document: Document, key: str, count: int | None) -> Any:
    group = document.data.get(key) if isinstance(document.data, dict) else None
    data = group.get("data") if isinstance(group, dict) else None
    try:
        values = np.array(data, dtype=float).ravel()
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if data is None or not np.isfinite(values).all() or (count is not None and values.size != count):
        place = (key,) if group is not None else ()
        raise document.error(
            place, f"{key} has no data of {count or 'up to five'} numbers", "as camera_calibration writes it"
        )
    return values


def write_camera_info(path: Path, optics: Optics, *, shape: tuple[int, int], name: str) -> None:
    """Write a camera_info file of a camera of ``shape`` (height, width). Raises `RimError`."""
    height, width = shape
    k = [optics.fx, 0.0, optics.cx, 0.0, optics.fy, optics.cy, 0.0, 0.0, 1.0]
    p = [optics.fx, 0.0, optics.cx, 0.0, 0.0, optics.fy, optics.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    write_yaml(
        path,
        {
            "image_width": width,
            "image_height": height,
            "camera_name": name,
            "camera_matrix": {"rows": 3, "cols": 3, "data": k},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(optics.d)},
            "rectification_matrix": {
                "rows": 3,
                "cols": 3,
                "data": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            },
            "projection_matrix": {"rows": 3, "cols": 4, "data": p},
        },
        comment="Written by rim optics.",
    )
