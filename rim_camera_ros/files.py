"""Files shipped with the package: camera files, scene files, experiments, found by name."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from rim_camera_ros.errors import InputError, nearest_name

_CAMERAS = "calibration"
_SCENES = "config"
#: Scene files of the set-ups of a calibration, and cameras to simulate them with.
_EXPERIMENTS = "calibration/experiments"


def expanded(text: str) -> str:
    """Return a path, or several joined by ``:``, with ``~`` and ``~user`` expanded as by a shell.

    Shells do not expand them in ``--out=~/bag`` and in values of parameters.
    """
    return os.pathsep.join(os.path.expanduser(word) for word in text.split(os.pathsep))


def share_folder() -> Path:
    """Return the folder with ``calibration`` and ``config``: the source tree or share/."""
    source = Path(__file__).resolve().parents[1]
    if (source / "package.xml").is_file():
        return source
    candidates = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    candidates += list(Path(__file__).resolve().parents)
    for prefix in candidates:
        share = prefix / "share" / "rim_camera_ros"
        if (share / _CAMERAS).is_dir():
            return share
    raise InputError("the shipped camera and scene files cannot be found", remedy="reinstall the package")


def find_camera(name: str) -> Path:
    """Return the path of a camera file, given as a path or by the name of a shipped one."""
    return _find(name, _CAMERAS, "camera file")


def find_scene(name: str) -> Path:
    """Return the path of a scene file, given as a path or by the name of a shipped one."""
    return _find(name, _SCENES, "scene file")


def shipped(kind: str) -> list[str]:
    """Return the names of shipped cameras (``calibration``) or scenes (``config``), with the experiments."""
    return sorted(_paths(kind))


def _paths(kind: str) -> dict[str, Path]:
    wanted = b"format: rim_camera/" if kind == _CAMERAS else b"format: rim_scene/"
    folders = [share_folder() / experiment for experiment in (_EXPERIMENTS, kind)]
    return {p.stem: p for folder in folders for p in folder.glob("*.yaml") if wanted in p.read_bytes()}


def _find(name: str, kind: str, words: str) -> Path:
    path = Path(name)
    if path.is_file():
        return path
    by_path = path.suffix in (".yaml", ".yml") or len(path.parts) > 1
    if by_path or (path.exists() and name not in shipped(kind)):
        problem = "is a folder" if path.is_dir() else "no such file"
        raise InputError(problem, file=name, remedy=f"give a {words} or one of: {_listed(shipped(kind))}")
    known = _paths(kind)
    if name in known:
        return known[name]
    near = nearest_name(name, known)
    raise InputError(
        f"no {words} of this name",
        file=name,
        remedy=f"{near}; shipped: {_listed(sorted(known))}" if near.startswith("did") else near,
    )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
