#!/usr/bin/env python3
"""Write docs/file_reference.md from the dataclasses of files; ``--check`` says whether it is up to date."""

from __future__ import annotations

# ruff: noqa: E501 -- examples and sentences of the page
import dataclasses
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pages import DOCS, run

from rim_camera_ros.camera_file import CAMERA_FORMAT, _File, load_camera
from rim_camera_ros.effects import ORDER, PARTICULAR
from rim_camera_ros.files import find_camera
from rim_camera_ros.limits import limits
from rim_camera_ros.measurement import TYPES
from rim_camera_ros.parameters import ArrayFile, NestedList, encode
from rim_camera_ros.scene import SCENE_FORMAT, Scene

PAGE = DOCS / "file_reference.md"
#: Keys whose dataclass says nothing of them.
_WORDS = {
    "format": "what kind of file this is",
    "device": "name of the camera",
    "sensor": "the array and its counts",
    "optics": "camera constant, principal point and distortion (ROS plumb_bob)",
    "radiometry": "amplitude = gain * integration_time * reflectivity * cos(incidence) * falloff / distance^2",
    "noise": "sigma_d^2 = floor^2 + shot^2 / A + (amplitude / A)^2, A in counts",
    "effects": "parameters by the name of the effect, [below](#effects); an absent effect is off",
    "validity": "ranges within which the calibration holds",
    "covariance": "of the parameters, in their own units",
    "provenance": "who made the file, from what; anything may stand here",
    "measurement": "how the device measures, by its `type`, [below](#ways-of-measuring); without it by one modulation frequency",
    "camera_motion": "of the camera, in its own optical frame",
    "surfaces": "what the camera may see",
    "schedule": "stations, one after the other; without it 100 frames at 25 Hz",
}
_EXAMPLES: dict[str, Any] = {
    "camera.noise.circular_range": 0.2888, "camera.format": CAMERA_FORMAT, "scene.format": SCENE_FORMAT,
    "camera.sensor.distance_lsb": 0.001, "camera.sensor.background_suppression": 50, "camera.sensor.integration_time": 100, "camera.minimum_amplitude": 150,
    "camera.covariance.parameters[]": "[effects.distance_scale.scale]", "camera.covariance.matrix": "mine.covariance.npy",
    "measurement.range": [0.3, 18.7], "measurement.wraps": [[0, 0, 0], [0, 0, 1], [1, 0, 1]],
    "camera.validity.distance": [1.2, 7.45], "camera.validity.amplitude": [200, 40000],
    "camera.validity.integration_time": [16, 100], "camera.validity.temperature": [-10, 40],
    "camera.validity.region": [0, 0, 175, 143],
    "scene.surfaces[].name": "board", "scene.surfaces[].type": "rectangle", "scene.surfaces[].pose": "truth",
    "scene.surfaces[].pose.position": [0.1, 0, 2.5], "scene.surfaces[].pose.orientation": [0, 0.2588, 0, 0.9659],
    "scene.surfaces[].pose.free[]": "[z, pitch]", "scene.surfaces[].size": [1.0, 0.8], "scene.surfaces[].radius": 0.145,
    "scene.surfaces[].texture.cell": [0.1, 0.1], "scene.surfaces[].texture.values": [[0.1, 0.9], [0.5, 0.3]],
    "scene.surfaces[].pose_sigma": [0.002, 0.001], "scene.camera_motion.linear": [0, 0, 0.1],
    "scene.camera_motion.angular": [0, 0.05, 0], "scene.schedule[].frames": 50, "scene.schedule[].rate": 25,
    "scene.schedule[].integration_time": 60, "scene.schedule[].uptime": 0, "scene.schedule[].ambient": 20,
    "scene.schedule[].poses.NAME.position": [0, 0, 1.5], "scene.schedule[].poses.NAME.orientation": [0, 0, 0, 1],
    "scene.schedule[].poses.NAME.free[]": "[z]",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Key:
    """One key of a file: its path, the type and metadata of its field, its default."""

    path: str
    hint: Any
    metadata: Mapping[str, Any]
    default: Any


def keys(kind: type, prefix: str) -> Iterator[Key]:
    """Yield every key that a dataclass describes, with those of the groups inside it."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        path, groups = f"{prefix}{field.name}", list(_groups(hints[field.name]))
        shown = path if groups else path + _suffix(hints[field.name], groups=False)
        yield Key(shown, hints[field.name], field.metadata, default)
        for group in groups:
            yield from keys(group, f"{path}{_suffix(hints[field.name], groups=True)}.")


def _groups(hint: Any) -> Iterator[type]:
    """Yield the dataclasses within a type."""
    if isinstance(hint, type):
        if dataclasses.is_dataclass(hint) and hint not in (ArrayFile, NestedList):
            yield hint
        return
    for argument in typing.get_args(hint):
        yield from _groups(argument)


def _suffix(hint: Any, *, groups: bool) -> str:
    """Return how entries are shown: [] of a list, NAME or SETTING of a group by names or settings."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple and arguments[-1] is Ellipsis:
        return "[]"
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return ".SETTING" if arguments[0] is float else ".NAME"
    if origin in (typing.Union, types.UnionType):
        return next((one for one in (_suffix(inner, groups=groups) for inner in arguments) if one), "")
    return ""


def _scalars(hint: Any) -> set[Any]:
    arguments = typing.get_args(hint)
    if not arguments or typing.get_origin(hint) is typing.Literal:
        return {hint}
    return set().union(*(_scalars(one) for one in arguments if one is not Ellipsis))


def _count(hint: Any) -> int:
    """Return how many numbers a key holds, 0 where that is not fixed."""
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is tuple and Ellipsis not in arguments:
        return len(arguments)
    return max((_count(one) for one in arguments), default=0)


def allowed(key: Key) -> str:
    """Return what a key may hold: choices, or the range of its numbers."""
    if list(_groups(key.hint)):
        return ""
    kinds = _scalars(key.hint)
    for one in kinds:
        if typing.get_origin(one) is typing.Literal:
            return ", ".join(typing.get_args(one))
    if ArrayFile in kinds:
        return "name of a .npy file in the same folder"
    if str in kinds and not kinds & {float, int}:
        return "text"
    if not kinds & {float, int, NestedList}:
        return ""
    bounds = limits(key.metadata)
    low = f"{'' if bounds.with_low else 'above '}{bounds.low:.10g}"
    high = f"{'' if bounds.with_high else 'below '}{bounds.high:.10g}"
    whole = "whole, " if int in kinds and float not in kinds else ""
    count = _count(key.hint)
    length = f"{count} numbers, each " if count else ""
    return f"{length}{whole}{low} to {high}"


def default(key: Key) -> str:
    """Return the default as the file would have it; *required* where there is none."""
    if key.default is dataclasses.MISSING:
        return "*required*"
    if key.default is None:
        return "none"
    if dataclasses.is_dataclass(key.default):
        return "its defaults"
    if key.default == () or (isinstance(key.default, Mapping) and not key.default):
        return "none"
    return f"`{_text(encode(key.default))}`"


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_text(one) for one in value) + "]"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "null" if value is None else str(value)


def _found(data: Any, path: list[str]) -> Any:
    """Return what example data hold at a path; None where they do not."""
    for part in path:
        name = part.removesuffix("[]")
        if name in ("NAME", "SETTING"):
            data = next(iter(data.values()), None) if isinstance(data, dict) else None
        else:
            data = data.get(name) if isinstance(data, dict) else None
        if part.endswith("[]") and isinstance(data, list) and data and isinstance(data[0], dict):
            data = data[0]
        if data is None:
            return None
    return data


def row(key: Key, example: Any) -> str:
    """Return the table's row of a key."""
    unit = key.metadata.get("unit", "")
    words = key.metadata.get("doc") or _WORDS.get(key.path.split(".")[-1].removesuffix("[]"), "")
    path = key.path.split(".", 1)[1]
    value = _EXAMPLES.get(key.path, example)
    shown = ""
    if value not in (None, [], ()) and not (
        isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict))
    ):
        shown = f"`{path.split('.')[-1].removesuffix('[]')}: {_text(value)}`"
        if path.endswith((".SETTING", ".NAME")):
            shown = f"`60: {_text(value)}`"
    return (
        f"| `{path}` | {words} | {unit if unit != '-' else ''} | {default(key)} | {allowed(key)} | {shown} |"
    )


_HEAD = ["| key | | unit | default | range | example |", "|---|---|---|---|---|---|"]


def _measurement(kind: type) -> list[str]:
    """Return the section of a way of measuring."""
    return ["", f"### {kind.type}", "", *_HEAD, *(row(one, None) for one in keys(kind, "measurement."))]


def pages() -> dict[Path, str]:
    """Return the content of the page by its path."""
    camera = load_camera(find_camera("sr3000"))
    example = {
        "format": CAMERA_FORMAT, "device": camera.device, "sensor": encode(camera.sensor), "optics": encode(camera.optics),
        "radiometry": encode(camera.radiometry), "noise": encode(camera.noise),
    }  # fmt: skip
    lines = [
        "# Every key of camera and scene files",
        "",
        "`a.b` is the key `b` in the group `a`, `a[].b` the key `b` of each entry of the list `a`, `a.SETTING` an entry",
        "for an integration time, `a.NAME` one for a surface. Lengths are metres. A key without a default must be given;",
        "an unknown key is an error that names the nearest known one. Numbers outside the range are refused.",
        "What the shipped files hold: [camera_files.md](camera_files.md); how the effects act: [effects](effects/README.md).",
        "",
        f"## Camera file (`{CAMERA_FORMAT}`)",
        "",
        *_HEAD,
        *(row(one, _found(example, one.path.split(".")[1:])) for one in keys(_File, "camera.")),
        "",
        "The key `sensor.modulation_frequency` may be a list: [several frequencies](several_frequencies.md) says what else may be one then.",
        "",
        "## Ways of measuring",
        "",
        "Groups `measurement` of a camera file, by their `type`.",
        *(line for kind in TYPES.values() for line in _measurement(kind)),
        "",
        "## Effects",
        "",
        "Groups of `effects` in a camera file, in their order along the light.",
    ]
    for effect in (*ORDER, *PARTICULAR):
        data = encode(effect.example(load_camera(find_camera("gated")) if effect in PARTICULAR else camera))
        lines += ["", f"### [{effect.name}](effects/{effect.name}.md)", "", *_HEAD]
        lines += [row(one, _found(data, one.path.split(".")[1:])) for one in keys(effect, f"{effect.name}.")]
    lines += ["", f"## Scene file (`{SCENE_FORMAT}`)", "", *_HEAD]
    lines += [
        row(one, None if one.default in (dataclasses.MISSING, None) else encode(one.default))
        for one in keys(Scene, "scene.")
    ]
    lines += ["", "This page is written by `docs/tools/file_reference.py` (`make docs`).", ""]
    return {PAGE: "\n".join(lines)}


if __name__ == "__main__":
    sys.exit(run(__doc__ or "", pages))
