"""The calibration node's parameters, and the work that they describe; no messages in here."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Collection
from pathlib import Path
from typing import Any

from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.nodes.common.folders import FOLDERS, Folders, is_free
from rim_camera_ros.nodes.common.lifecycle import AUTOSTART
from rim_camera_ros.nodes.common.parameters import Spec, Values

SPECS = (
    Spec(
        "recordings",
        "",
        "recordings of one camera, joined by ':'; each one that is recorded is added",
        is_path=True,
    ),
    Spec(
        "camera",
        "sr3000",
        "camera file to start from, or the name of a shipped one; it is not changed",
        is_path=True,
    ),
    Spec(
        "scene",
        "",
        "scene file of the recordings, or the name of a shipped one; joined by ':': that of each recording "
        "in their order",
        is_path=True,
    ),
    Spec(
        "effects",
        "",
        "effects to fit, joined by ','; empty: the camera file's and those that the recordings need",
    ),
    Spec("geometry", False, "fit camera constant, principal point and distortion, too"),
    Spec(
        "output",
        "",
        "name of the camera file to write, without folder; empty: calibrated_1, or the next that is free",
    ),
    Spec(
        "record_as",
        "",
        "name of the recording to write, without folder; empty: recording_1, or the next that is free",
    ),
    Spec(
        "record_frames", 0, "frames after which recording ends by itself; 0: when asked to", limits=(0, 2**31)
    ),
    Spec("niceness", 10, "by how much the calibration gives way to other processes (nice)", limits=(0, 19)),
    FOLDERS,
    AUTOSTART,
)

#: Parameters that name a file, with the folder of the shipped ones that they may name.
_FILES = {"camera": "calibration", "scene": "config"}
#: Parameters that name a file to write, with its default name.
NEW = {"output": "calibrated", "record_as": "recording"}
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")


def recordings_of(values: Values) -> list[str]:
    """Return the paths that the parameter ``recordings`` holds."""
    return [word for word in values["recordings"].split(os.pathsep) if word]


def given_files(values: Values) -> list[str]:
    """Return the files that the node was started with."""
    return [*recordings_of(values), *(parameter for name in _FILES for parameter in files_of(values, name))]


def files_of(values: Values, name: str) -> list[str]:
    """Return the files, or names of shipped ones, that ``camera`` or ``scene`` holds."""
    return [word for word in values[name].split(os.pathsep) if word] if name == "scene" else [values[name]]


def check(values: Values, changed: Collection[str], folders: Folders) -> None:
    """Raise `InputError` for a file outside of ``folders`` or an invalid name; files need not exist."""
    if "recordings" in changed:
        for one in recordings_of(values):
            folders.check(one, place="recordings")
    for name, kind in _FILES.items():
        if name in changed:
            for parameter in files_of(values, name):
                folders.check(parameter, kind=kind, place=name)
    for name in NEW:
        if name in changed and values[name] and not _NAME.fullmatch(values[name]):
            raise InputError(
                f"'{values[name][:100]}' is not a name of a file",
                place=name,
                remedy="letters, digits, _ - . only; the folder is that of the parameter folders",
            )


def calibration_of(values: Values, folders: Folders) -> dict[str, Any]:
    """Return the request to the process that calibrates (`process`).

    Raises `InputError`, which names the parameter, for errors that show before files are read.
    """
    check(values, values.keys(), folders)
    recordings = recordings_of(values)
    if not recordings:
        raise InputError(
            "none is given", place="recordings", remedy="name recordings, joined by ':', or record some"
        )
    seen: dict[Path, str] = {}
    for recording in recordings:
        if not Path(recording).exists():
            raise InputError("no such recording", file=recording, place="recordings", remedy="check its path")
        if Path(recording).resolve() in seen:
            raise InputError(
                "is given twice", file=recording, place="recordings", remedy="give each recording once"
            )
        seen[Path(recording).resolve()] = recording
    if not values["scene"]:
        raise InputError("is empty", place="scene", remedy="name the scene file of the recordings")
    for name, find in (("camera", find_camera), ("scene", find_scene)):
        for parameter in files_of(values, name):
            try:
                find(parameter)
            except InputError as error:
                raise InputError(error.problem, file=error.file, place=name, remedy=error.remedy) from None
    output = _new(values, "output", folders)
    report = output.with_name(f"{output.stem}.report.html")
    for path in (output, report):
        if path.exists():
            raise InputError("exists already", file=path, place="output", remedy="give another name")
    effects = [word.strip() for word in values["effects"].split(",") if word.strip()]
    return {
        "recordings": recordings,
        "camera": values["camera"],
        "scene": files_of(values, "scene"),
        "effects": effects,
        "geometry": values["geometry"],
        "output": str(output),
        "niceness": values["niceness"],
        "command": _command(values, recordings, effects, output),
    }


def recording_of(values: Values, folders: Folders, *, namespace: str) -> dict[str, Any]:
    """Return the request to the process that records (`recording`).

    With a scene, the coverage of the recording is published meanwhile. Raises `InputError` where the
    recording cannot have the given name, or scene or camera are no files.
    """
    output = _new(values, "record_as", folders).with_suffix("")
    if output.exists() or output.is_symlink():
        raise InputError("exists already", file=output, place="record_as", remedy="give another name")
    found = {"output": str(output), "namespace": namespace, "frames": values["record_frames"]}
    scenes = files_of(values, "scene")
    # the new recording is added after the others: its scene is the last one
    known = [str(find_scene(scenes[-1])), str(find_camera(values["camera"]))] if scenes else None
    return found | {"known": known}


def with_recording(values: Values, path: str) -> str:
    """Return the parameter ``recordings`` with one more path."""
    return os.pathsep.join([*recordings_of(values), path])


def _new(values: Values, name: str, folders: Folders) -> Path:
    """Return the path of a file to write, with the ending .yaml: of the given name, or the next free one."""
    if values[name]:
        return folders.target(values[name], place=name)
    number = 1
    while True:
        path = folders.target(f"{NEW[name]}_{number}", place=name)
        if is_free(path):
            return path
        number += 1


def _command(values: Values, recordings: list[str], effects: list[str], output: Path) -> str:
    """Return the command that does the same, for the provenance."""
    words = ["rim", "calibrate", *recordings, "--camera", values["camera"]]
    words += [word for parameter in files_of(values, "scene") for word in ("--scene", parameter)]
    words += ["--out", str(output)]
    words += ["--effects", ",".join(effects)] if effects else []
    words += ["--geometry"] * values["geometry"]
    return shlex.join(words)
