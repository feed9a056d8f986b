"""YAML files as users write them: read with the place of every value, written whole or not at all."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from rim_camera_ros.errors import InputError, RimError

_MAXIMUM_FILE_SIZE = 64 * 2**20
#: Values that a file may come to hold by way of aliases (*name), beyond those that are written in it.
_MOST_REPEATED = 1_000_000


@dataclass(frozen=True)
class Document:
    """A parsed YAML file: plain values, and the line (from 1) of each by path."""

    path: Path
    data: Any
    lines: Mapping[tuple[Any, ...], int]

    @property
    def folder(self) -> Path:
        return self.path.parent

    def error(self, place: tuple[Any, ...], problem: str, remedy: str | None = None) -> InputError:
        """Return an error that names this file and the place with its line."""
        known = place
        while known and known not in self.lines:
            known = known[:-1]
        line = self.lines.get(known)
        text = ".".join(str(part) for part in place)
        if line is not None:
            text = f"{text} (line {line})" if text else f"line {line}"
        return InputError(problem, file=self.path, place=text or None, remedy=remedy)


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-3 is a number (as in YAML 1.2)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+0123456789."),
)


def read_yaml(path: str | os.PathLike[str]) -> Document:
    """Read a YAML file safely, with the line of every value.

    Raises `InputError` where the file is absent, unreadable, not YAML, holds a key twice, or very many values
    by way of aliases.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAXIMUM_FILE_SIZE:
            raise InputError("is larger than 64 MiB", file=path, remedy="is this the right file?")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError("is not a text file", file=path, remedy="give a YAML file") from None
    except OSError as error:
        raise InputError(os_reason(error), file=path, remedy="check the path and permissions") from None
    lines: dict[tuple[Any, ...], int] = {}
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            most = len(text) + _MOST_REPEATED
            data = None if node is None else _construct(loader, node, (), lines, path, most=most)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"line {mark.line + 1}" if mark else None
        problem = f"not valid YAML: {error.problem or error.context}"
        raise InputError(problem, file=path, place=place, remedy="mend the syntax") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise InputError(f"not valid YAML: {error}", file=path, remedy="mend the syntax") from None
    except RecursionError:
        raise InputError("nested too deeply", file=path, remedy="is this the right file?") from None
    return Document(path, data, lines)


def _construct(
    loader: _Loader,
    node: Any,
    place: tuple[Any, ...],
    lines: dict[tuple[Any, ...], int],
    path: Path,
    *,
    most: int,
) -> Any:
    if len(lines) >= most:
        raise InputError(
            "aliases (*name) repeat more than a million values", file=path, remedy="is this the right file?"
        )
    lines[place] = node.start_mark.line + 1
    plain = ("tag:yaml.org,2002:map", "tag:yaml.org,2002:seq")
    if not isinstance(node, yaml.ScalarNode) and node.tag not in plain:
        raise yaml.constructor.ConstructorError(
            None, None, f"could not determine a constructor for the tag '{node.tag}'", node.start_mark
        )
    if isinstance(node, yaml.MappingNode):
        result: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be a plain word or number", key_node.start_mark
                )
            key = loader.construct_object(key_node)
            if key in result:
                where = ".".join(str(part) for part in (*place, key))
                raise InputError(
                    "key given twice",
                    file=path,
                    place=f"{where} (line {key_node.start_mark.line + 1})",
                    remedy="keep one",
                )
            result[key] = _construct(loader, value_node, (*place, key), lines, path, most=most)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [
            _construct(loader, one, (*place, i), lines, path, most=most) for i, one in enumerate(node.value)
        ]
    return loader.construct_object(node)


def os_reason(error: OSError) -> str:
    reasons: dict[type, str] = {
        FileNotFoundError: "no such file",
        IsADirectoryError: "is a folder, not a file",
        PermissionError: "no permission to read it",
        NotADirectoryError: "no such file",
    }
    return reasons.get(type(error), f"cannot be read: {error.strerror or error}")


class _Dumper(yaml.SafeDumper):
    """Leaf lists and groups on one line."""

    ignore_aliases: ClassVar[Any] = lambda self, data: True


def write_yaml(path: str | os.PathLike[str], data: Any, *, comment: str = "") -> None:
    """Write plain data as YAML, whole or not at all, below a comment in plain words."""
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)
    above = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    write_whole(path, lambda stream: stream.write((above + text).encode()))


def write_whole(path: str | os.PathLike[str], write: Callable[[Any], Any]) -> None:
    """Call ``write`` with a binary stream whose content replaces ``path`` once it is complete.

    Raises `RimError` where the file cannot be written; nothing is left behind then.
    """
    path = Path(path)
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise RimError(
            f"cannot be written: {error.strerror or error}",
            file=path,
            remedy="check the folder, its permissions and the free space; nothing was left behind",
        ) from None
    except BaseException:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
