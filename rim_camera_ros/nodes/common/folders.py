"""Which files a node may read and write on behalf of others while it runs; no ROS in here."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable
from pathlib import Path

from rim_camera_ros.errors import InputError
from rim_camera_ros.files import shipped
from rim_camera_ros.nodes.common.parameters import Spec

FOLDERS = Spec(
    "folders",
    "",
    "folders of files that parameters and services may name while the node runs, joined by ':'; services "
    "write into the first; empty: rim_camera in $ROS_HOME (~/.ros)",
    read_only=True,
    is_path=True,
)


class Folders:
    """Folders below which files may be read; services write into the first.

    ``text``: the parameter `FOLDERS`. Files and folders that were given at the start of the node (``given``)
    are trusted and may be read again.
    """

    def __init__(self, text: str, *, given: Iterable[str] = ()) -> None:
        parts = [word for word in text.split(os.pathsep) if word]
        home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
        self._folders = [Path(part).resolve() for part in parts] or [home / "rim_camera"]
        self._readable = list(self._folders)
        for name in given:
            path = Path(name)
            if name and path.exists():
                self._readable.append(path.resolve())

    def check(self, name: str, *, kind: str | None = None, place: str) -> None:
        """Raise `InputError` where a file or folder may not be read; files outside are not accessed.

        ``kind`` (``calibration``, ``config``): names of shipped files of this kind are allowed.
        """
        path = Path(name)
        if not name or (kind is not None and name in shipped(kind)):
            return
        bare = kind is not None and len(path.parts) == 1 and path.suffix not in (".yaml", ".yml")
        if bare and not path.exists():
            return  # the reader's error lists the names
        if not self._allows(path):
            raise InputError(
                "lies outside of the folders that may be read while the node runs",
                file=name,
                place=place,
                remedy="start the node with folders:=FOLDER, or with this file",
            )

    def target(self, name: str, *, place: str) -> Path:
        """Return the path of a camera file to write, from its name without folder; the folder is made.

        Raises `InputError` for anything but letters, digits, ``_``, ``-`` and ``.``.
        """
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}", name):
            raise InputError(
                f"'{name[:100]}' is not a name of a file",
                place=place,
                remedy="letters, digits, _ - . only; the folder is that of the parameter folders",
            )
        folder = self._folders[0]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            problem = f"the folder cannot be made: {error.strerror}"
            raise InputError(
                problem, file=folder, remedy="start the node with another folders:=FOLDER"
            ) from None
        path = folder / (name if name.endswith((".yaml", ".yml")) else f"{name}.yaml")
        if path.is_symlink():
            raise InputError("is a link and is not written through", file=path, place=place)
        return path

    def new(self, name: str, *, place: str) -> Path:
        """Return the path of a camera file to write that replaces nothing: NAME, or NAME_2, NAME_3...

        Raises `InputError` as `target` does.
        """
        path = self.target(name, place=place)
        stem, number = path.stem, 1
        while not is_free(path):
            number += 1
            path = path.with_name(f"{stem}_{number}{path.suffix}")
        return path

    def _allows(self, path: Path) -> bool:
        try:
            real = path.resolve()
        except (OSError, RuntimeError, ValueError):
            return False
        return any(real.is_relative_to(folder) for folder in self._readable)


def is_free(path: Path) -> bool:
    """Whether no file, link, recording or array of a camera file has the name of a path."""
    return not path.with_suffix("").exists() and not any(path.parent.glob(f"{glob.escape(path.stem)}.*"))
