"""Hidden files and folders for unfinished work, which a killed run leaves behind and the next removes.

Each is locked (`flock`) while its process lives; the system takes the lock back when the process ends,
however it ends. What can be locked belongs to nobody any more. Where a file system has no such locks,
nothing is removed. Processes on other machines are seen as far as the file system shares locks.
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
    """A hidden file or folder that is ours as long as ``lock``, a file descriptor, is open."""

    path: Path
    lock: int

    def close(self) -> None:
        """Remove it, unless it was moved to its place, or holds what stood there and nothing stands there."""
        if not self.path.is_dir() or self.path.is_symlink():
            self.path.unlink(missing_ok=True)
        elif not (self.path / _REPLACED).exists() or _target(self.path).exists():
            shutil.rmtree(self.path, ignore_errors=True)
        os.close(self.lock)

    def put_in_place(self, new: Path, target: Path) -> None:
        """Move ``new``, which lies in this folder, to ``target``; what stands there goes only after that."""
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
    """Return a new empty file, open for writing, for what is to be called ``name`` in the folder.

    Removes what killed runs have left there. Raises OSError.
    """
    clear(folder)

    def make() -> Temporary:
        handle, path = tempfile.mkstemp(prefix=_prefix(name), dir=folder)
        return Temporary(Path(path), handle)

    return _locked(make)


def temporary_folder(folder: Path, name: str) -> Temporary:
    """Return a new empty folder for what is to be called ``name``; otherwise as `temporary_file`."""
    clear(folder)

    def make() -> Temporary:
        path = tempfile.mkdtemp(prefix=_prefix(name), dir=folder)
        return Temporary(Path(path), os.open(path, os.O_RDONLY | os.O_DIRECTORY))

    return _locked(make)


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Keep other runs from writing ``path`` until the context is left. Raises `InputError` where one does."""
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
            pass  # no locks here: as if alone
        if _is(claim, lock):
            break
        os.close(lock)  # its owner removed it meanwhile
    try:
        yield
    finally:
        Temporary(claim, lock).close()


#: What this process has claimed for good.
_claims = ExitStack()


def claim(path: Path) -> None:
    """Claim an output as `claimed` does, until `release_claims`."""
    _claims.enter_context(claimed(path))


def release_claims() -> None:
    """Give back what `claim` claimed."""
    _claims.close()


def clear(folder: Path) -> None:
    """Remove the hidden files and folders of killed runs; what cannot be removed stays."""
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
    # names of files have 255 bytes, these longer ones too
    return f".{name.encode()[:200].decode(errors='ignore')}{_MARK}"


def _target(path: Path) -> Path:
    """Return what a hidden file or folder was made for."""
    return path.with_name(path.name[1:].rpartition(_MARK)[0])


def _locked(make: Callable[[], Temporary]) -> Temporary:
    """Return what was made, locked; made anew where `clear` of another process came between."""
    while True:
        made = make()
        with suppress(OSError):
            fcntl.flock(made.lock, fcntl.LOCK_EX)
        if _is(made.path, made.lock):
            return made
        os.close(made.lock)


def _is(path: Path, lock: int) -> bool:
    """Whether an open descriptor is that of the path as it is now."""
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(lock))
    except OSError:
        return False
