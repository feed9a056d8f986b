"""Hidden files and folders for unfinished work; those of a killed run are removed by the next run.

Each is locked (`flock`) while its process lives. The system releases the lock when the process ends, however
it ends, so that a file that can be locked has no owner any more. On file systems without such locks nothing
is removed. Processes on other machines are noticed as far as the file system shares locks.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rim_camera_ros.errors import InputError

_MARK = ".rim-"
_OURS = re.compile(r"\..*\.rim-(?:[a-z0-9_]{8}|claim)")
_CLAIM = "claim"
_REPLACED = "replaced"


@dataclass(frozen=True)
class Temporary:
    """A hidden file or folder that this process owns while ``lock``, a file descriptor, is open."""

    path: Path
    lock: int

    def close(self) -> None:
        """Remove it, unless it was moved to its place, or has the replaced output and its place is empty."""
        if not self.path.is_dir() or self.path.is_symlink():
            self.path.unlink(missing_ok=True)
        elif not (self.path / _REPLACED).exists() or _target(self.path).exists():
            shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)

    def put_in_place(self, new: Path, target: Path) -> None:
        """Move ``new`` from this folder to ``target``; an existing target is removed only after that."""
        old = self.path / _REPLACED
        replaced = target.exists()
        if replaced:
            target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            if replaced:
                old.rename(target)
            raise


def temporary_file(folder: Path, name: str) -> Temporary:
    """Return a new empty file, open for writing, for an output ``name`` in the folder.

    Removes the files of killed runs there. Raises OSError.
    """
    clear(folder)

    def make() -> Temporary:
        handle, path = tempfile.mkstemp(prefix=_prefix(name), dir=folder)
        return Temporary(Path(path), handle)

    return _locked(make)


def temporary_folder(folder: Path, name: str) -> Temporary:
    """Return a new empty folder for an output ``name``; otherwise as `temporary_file`."""
    clear(folder)

    def make() -> Temporary:
        path = tempfile.mkdtemp(prefix=_prefix(name), dir=folder)
        return Temporary(Path(path), os.open(path, os.O_RDONLY | os.O_DIRECTORY))

    return _locked(make)


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Keep other runs from writing ``path`` until the context is left; `InputError` if one writes it now."""
    folder = path.absolute().parent
    clear(folder)
    claim = folder / f"{_prefix(path.name)}{_CLAIM}"
    while True:
        lock = os.open(claim, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise InputError(
                "another run is writing it", file=path, remedy="wait until it ends, or give another name"
            ) from None
        except OSError:
            pass  # no locks on this file system: as if there were no other run
        if _is(claim, lock):
            break
        os.close(lock)  # its owner removed it meanwhile
    try:
        yield
    finally:
        Temporary(claim, lock).close()


#: Outputs that this process has claimed until `release_claims`.
_claims = ExitStack()


def claim(path: Path) -> None:
    """Claim an output as `claimed` does, until `release_claims`."""
    _claims.enter_context(claimed(path))


def release_claims() -> None:
    """Release the claims made by `claim`."""
    _claims.close()


def clear(folder: Path) -> None:
    """Remove the hidden files and folders of killed runs, as far as possible."""
    try:
        with os.scandir(folder) as entries:
            found = [
                Path(entry.path)
                for entry in entries
                if _OURS.fullmatch(entry.name) and not entry.is_symlink()
            ]
    except OSError:
        return
    for path in found:
        with suppress(OSError):
            _clear(path)


def _clear(path: Path) -> None:
    if path.stat().st_uid != os.geteuid():
        return
    lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        return
    if _is(path, lock):
        Temporary(path, lock).close()
    else:
        os.close(lock)


def _prefix(name: str) -> str:
    # names of files have at most 255 bytes, including the additions here
    return f".{name.encode()[:200].decode(errors='ignore')}{_MARK}"


def _target(path: Path) -> Path:
    """Return the output for which a hidden file or folder was made."""
    return path.with_name(path.name[1:].rpartition(_MARK)[0])


def _locked(make: Callable[[], Temporary]) -> Temporary:
    """Return a made file or folder, locked; it is made anew if `clear` of another process removed it."""
    while True:
        made = make()
        with suppress(OSError):
            fcntl.flock(made.lock, fcntl.LOCK_EX)
        if _is(made.path, made.lock):
            return made
        os.close(made.lock)


def _is(path: Path, lock: int) -> bool:
    """Whether an open descriptor still belongs to the file at the path."""
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(lock))
    except OSError:
        return False
