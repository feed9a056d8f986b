"""Where a camera file comes from: recordings with their checksums, version, date, command."""

from __future__ import annotations

import datetime
import hashlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rim_camera_ros import __version__
from rim_camera_ros.errors import RimError

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Source:
    """A recording as provenance states it: path as given, sha256, frames, poses."""

    path: str
    sha256: str
    frames: int
    poses: int


def checksum(path: str | os.PathLike[str], *, tick: Callable[[], None] | None = None) -> str:
    """Return the sha256 of a file; of a folder, that of its files' names and checksums, sorted by name.

    ``tick`` is called once per MB and may raise to end the work. Raises `RimError` for what cannot be read.
    """
    path = Path(path)
    try:
        if path.is_file():
            return _of_file(path, tick)
        whole = hashlib.sha256()
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            whole.update(f"{file.relative_to(path).as_posix()} {_of_file(file, tick)}\n".encode())
        return whole.hexdigest()
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise RimError(problem, file=error.filename or path, remedy="check its permissions") from None


def _of_file(path: Path, tick: Callable[[], None] | None) -> str:
    sums = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            sums.update(chunk)
            if tick is not None:
                tick()
    return sums.hexdigest()


def provenance(
    *,
    sources: Iterable[Source],
    command: str,
    camera: str,
    scene: str | None,
    fitted: Sequence[str],
    not_fitted: Mapping[str, str],
    accuracy: Mapping[str, Any],
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the section ``provenance`` of a calibrated camera file, plain data.

    ``not_fitted`` states for each effect why it is not among the ``fitted``.
    """
    found: dict[str, Any] = {
        "program": f"rim_camera_ros {__version__}",
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": command,
        "camera": camera,
    }
    if scene is not None:
        found["scene"] = scene
    found["recordings"] = [
        {"path": source.path, "sha256": source.sha256, "frames": source.frames, "poses": source.poses}
        for source in sources
    ]
    found["fitted"] = list(fitted)
    found["left_out"] = dict(not_fitted)
    found["accuracy"] = dict(accuracy)
    if notes:
        found["notes"] = list(notes)
    return found
