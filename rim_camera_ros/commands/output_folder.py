"""A folder that a command either replaces as a whole or does not change."""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rim_camera_ros.errors import InputError
from rim_camera_ros.temporary import temporary_folder


@dataclass(frozen=True)
class OutputFolder:
    """The folder ``path``, which holds the files ``own`` and arrays or pictures (npy, png) ``of`` something.

    ``mark`` is the file by which an older output is recognised.
    """

    path: Path
    own: Set[str]
    of: str
    mark: str

    def check(self, *, force: bool) -> None:
        """Check, before the work, that the folder can be written afterwards. Raises `InputError`."""
        path = self.path
        if not path.exists():
            return
        if not path.is_dir():
            raise InputError("is a file, not a folder", file=path, remedy="give another name")
        if path.resolve() == Path.cwd():
            raise InputError("is the folder you work in", file=path, remedy="name a folder within it")
        content = {entry.name for entry in path.iterdir()}
        if content and not force:
            raise InputError("exists already", file=path, remedy="--force replaces it")
        older = self.mark in content
        foreign = sorted(one for one in content - self.own if not (older and one.endswith((".npy", ".png"))))
        if content and (foreign or not older):
            named = f" ({foreign[0]})" if foreign else ""
            raise InputError(
                f"holds something else than {self.of}{named}",
                file=path,
                remedy="give another name or empty it",
            )

    @contextmanager
    def written(self) -> Iterator[Path]:
        """Yield a new folder to write into, which then replaces the old one as a whole, or not at all."""
        path = self.path.resolve()
        temporary = temporary_folder(path.parent, path.name)
        try:
            new = temporary.path / "new"
            new.mkdir()
            yield new
            temporary.put_in_place(new, path)
        finally:
            temporary.close()
