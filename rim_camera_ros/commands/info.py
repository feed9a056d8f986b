"""``rim info``: what is in a recording, a camera file or a scene file; what is on USB."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from rim_camera_ros.camera_file import CAMERA_FORMAT, load_camera
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_profile,
    add_topics,
    camera_of,
    topics_of,
)
from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.files import find_camera, find_scene, shipped
from rim_camera_ros.info.camera import camera_facts, camera_text
from rim_camera_ros.info.recording import recording_facts, recording_text
from rim_camera_ros.info.scene import scene_facts, scene_text
from rim_camera_ros.info.usb import usb_facts, usb_text
from rim_camera_ros.scene import SCENE_FORMAT, load_scene
from rim_camera_ros.yaml_files import read_yaml

#: Bytes at the beginning of a file that determine its kind.
_BEGIN = 1 << 16
#: The word that requests the cameras on USB; a file of that name is ./usb.
_USB = "usb"

_EXAMPLES = """
rim info bag
rim info bag --camera camera.yaml          # distances in metres, noise against the camera file's model
rim info sr3000
rim info room --camera sr3000 --json
rim info usb                               # which SwissRangers are connected, and what is missing to use them
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "info",
        "Show what is in a recording, a camera file or a scene file. The kind is found by the content. Of a "
        "recording that is damaged or lacks images, the readable part is shown, and the error after it. The "
        "word usb: the cameras that are connected.",
        _EXAMPLES,
    )
    parser.add_argument(
        "what", metavar="BAG|CAMERA|SCENE|usb", help="a file or folder, or the name of a shipped one; or usb"
    )
    parser.add_argument(
        "--camera", help="camera file for a recording or a scene, or the name of a shipped one"
    )
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_topics(parser)
    add_profile(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Find the kind, gather, print; of a faulty recording the readable part is printed before the error."""
    if given.what == _USB:
        return _run_usb(given)
    kind, path = find_kind(given.what)
    camera = camera_of(given.camera) if given.camera else None
    fault: RimError | None = None
    if kind == "camera":
        if camera is not None:
            raise InputError("is a camera file itself", file=given.what, remedy="leave --camera out")
        facts, text = camera_facts(load_camera(path)), camera_text
    elif kind == "scene":
        try:
            facts, text = scene_facts(load_scene(path), camera), scene_text
        except InputError as error:
            raise error.located(path) from None
    else:
        with Progress("read", None, quiet=given.quiet) as progress:
            facts, fault = recording_facts(path, topics_of(given), camera, progress.show)
        text = recording_text
    if given.json:
        print(json.dumps({"kind": kind, "path": str(path), **_finite(facts)}, indent=1, allow_nan=False))
    else:
        print(text(facts))
    if fault is not None:
        raise fault
    return 0


def _run_usb(given: argparse.Namespace) -> int:
    if given.camera:
        raise InputError("usb takes no camera file", place="--camera", remedy="leave --camera out")
    facts = usb_facts()
    print(json.dumps({"kind": _USB, **facts}, indent=1) if given.json else usb_text(facts))
    return 0


def find_kind(name: str) -> tuple[str, Path]:
    """Return ``camera``, ``scene`` or ``recording`` and the path. Raises `InputError` for none of them.

    The content decides: a YAML file states its format, anything else can only be a recording.
    """
    path = Path(name)
    if not path.exists():
        return _shipped(name)
    if path.is_dir() or not path.is_file():
        return "recording", path
    with path.open("rb") as stream:
        begin = stream.read(_BEGIN)
    if b"rosbag2_bagfile_information" in begin:
        return "recording", path.absolute().parent
    if path.suffix not in (".yaml", ".yml") and (b"\0" in begin or b"format:" not in begin):
        return "recording", path
    data = read_yaml(path).data
    stated = data.get("format") if isinstance(data, dict) else None
    kinds = {CAMERA_FORMAT: "camera", SCENE_FORMAT: "scene"}
    if stated not in kinds:
        found = "it states no format" if stated is None else f"format is {stated!r}"
        raise InputError(
            f"neither a camera file nor a scene file: {found}",
            file=path,
            remedy=f"expected format: {CAMERA_FORMAT} or {SCENE_FORMAT}",
        )
    return kinds[str(stated)], path


def _shipped(name: str) -> tuple[str, Path]:
    if len(Path(name).parts) > 1 or Path(name).suffix:
        raise InputError("no such file", file=name, remedy="check the path")
    cameras, scenes = shipped("calibration"), shipped("config")
    if name in cameras:
        return "camera", find_camera(name)
    if name in scenes:
        return "scene", find_scene(name)
    close = nearest_name(name, [*cameras, *scenes])
    known = f"cameras: {', '.join(cameras)}; scenes: {', '.join(scenes)}"
    raise InputError(
        "neither a file nor the name of a shipped camera or scene",
        file=name,
        remedy=f"{close} {known}" if close.startswith("did you") else known,
    )


def _finite(value: Any) -> Any:
    """Return plain data without NaN and infinity, which JSON has not."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)
