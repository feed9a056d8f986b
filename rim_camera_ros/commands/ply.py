"""Clouds as PLY files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.yaml_files import write_whole


def write_ply(path: str | os.PathLike[str], points: NDArray[Any], *, comment: str = "") -> int:
    """Write the valid points of a cloud (H, W, 4) as binary PLY and return their number.

    x y z in metres in the optical frame (x right, y down, z forward), intensity in counts. Raises
    `RimError` where the file cannot be written.
    """
    flat = points.reshape(-1, 4)
    valid = np.ascontiguousarray(flat[np.isfinite(flat[:, :3]).all(axis=1)], "<f4")
    lines = ["ply", "format binary_little_endian 1.0"]
    lines.append("comment x y z in metres, optical frame: x right, y down, z forward; intensity in counts")
    if comment:
        lines.append(f"comment {' '.join(comment.split())}")
    lines.append(f"element vertex {len(valid)}")
    lines += [f"property float {name}" for name in ("x", "y", "z", "intensity")]
    header = "\n".join([*lines, "end_header", ""]).encode()
    write_whole(path, lambda stream: stream.write(header + valid.tobytes()))
    return len(valid)
