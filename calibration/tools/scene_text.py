"""What scene files are written from: numbers, poses, textures and surfaces as YAML, and a schedule."""

from dataclasses import dataclass, field

import numpy as np

from rim_camera_ros.rotations import quaternion


def about(axis, angle):
    """Return the rotation matrix about x, y or z by an angle in rad."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = c
    rotation[i, j], rotation[j, i] = -s, s
    return rotation


def number(value):
    """Return a number as it stands in the files: at most 9 decimals, no negative zero."""
    text = f"{round(float(value), 9) + 0.0:.9f}".rstrip("0")
    return text + "0" if text.endswith(".") else text


def numbers(values):
    return "[" + ", ".join(number(one) for one in values) + "]"


def pose(position, rotation=None):
    """Return a pose as YAML."""
    orientation = np.array((0.0, 0.0, 0.0, 1.0) if rotation is None else quaternion(rotation)).round(9)
    # where w is 0, as after half a turn, the sign is free and would depend on the machine
    orientation *= np.sign(next(one for one in orientation[::-1] if one != 0))
    return f"{{position: {numbers(position)}, orientation: {numbers(orientation)}}}"


def texture(cell, rows):
    """Return a texture as YAML whose rows and columns, even in number, lie centred on the surface."""
    rows = np.asarray(rows, float)
    tiles = np.roll(rows, (-(rows.shape[0] // 2), -(rows.shape[1] // 2)), (0, 1))
    values = ", ".join(numbers(row) for row in tiles)
    return f"{{cell: {numbers(cell)}, values: [{values}]}}"


def surface(name, kind, *, at="truth", sigma=None, **more):
    """Return a surface as lines of YAML."""
    lines = [f"- name: {name}", f"  type: {kind}", f"  pose: {at}"]
    lines += [f"  {key}: {value}" for key, value in more.items()]
    if sigma is not None:
        lines.append(f"  pose_sigma: {numbers(sigma)}")
    return lines


@dataclass
class Experiment:
    """A scene file in the making; `station` adds to its schedule."""

    about: str
    surfaces: list
    stations: list = field(default_factory=list)

    def station(self, *, uptime, setting, frames=10, rate=10.0, ambient=20.0, **poses):
        keys = [f"frames: {frames}", f"rate: {number(rate)}", f"integration_time: {setting}"]
        keys += [f"uptime: {number(uptime)}", f"ambient: {number(ambient)}"]
        if poses:
            keys.append("poses: {" + ", ".join(f"{name}: {one}" for name, one in poses.items()) + "}")
        self.stations.append("- {" + ", ".join(keys) + "}")

    def text(self, name):
        notes = [f"# {line}" for line in self.about.strip().splitlines()]
        surfaces = [line for one in self.surfaces for line in one]
        return "\n".join(
            [
                *notes,
                "# Metres, seconds, degrees Celsius; poses in the camera optical frame: x right, y down, z forward.",
                "#",
                f"# Generated: calibration/tools/experiments.py; how to do it: docs/experiments/{name}.md",
                "format: rim_scene/1",
                "surfaces:",
                *surfaces,
                "schedule:",
                *self.stations,
                "",
            ]
        )
