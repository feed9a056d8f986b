"""YAML files of users: read with the place of every value, written completely or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.temporary import temporary_file

_MAXIMUM_FILE_SIZE = 64 * 2**20
#: Most values (without keys) in a file; values behind aliases (*name) count each time they are used.
_MOST_VALUES = 200_000
_DEEPEST = 100


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
        text = ".".join(str(part)[:100] for part in place)
        if line is not None:
            text = f"{text} (line {line})" if text else f"line {line}"
        return InputError(problem, file=self.path, place=text or None, remedy=remedy)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loads safe YAML in which 1e-3 is a number (as in YAML 1.2)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+0123456789."),
)


def read_yaml(path: str | os.PathLike[str]) -> Document:
    """Read a YAML file safely, with the line of every value.

    Raises `InputError` where the file is absent, unreadable or not YAML, has a key twice, more than 200,000
    values, or groups nested a hundred times.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAXIMUM_FILE_SIZE:
            raise InputError("is larger than 64 MiB", file=path, remedy="is this the right file?")
        if not path.is_file() and not path.is_dir():
            raise InputError("is no file, or an endless one", file=path, remedy="give a YAML file")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError("is not a text file", file=path, remedy="give a YAML file") from None
    except OSError as error:
        raise InputError(os_reason(error), file=path, remedy="check the path and permissions") from None
    lines: dict[tuple[Any, ...], int] = {}
    try:
        _check_size(text, path)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            data = None if node is None else _construct(loader, node, (), lines, path)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"line {mark.line + 1}" if mark else None
        problem = f"not valid YAML: {error.problem or error.context}"
        if mark and problem.endswith("undefined alias"):
            problem += f" '{_word_at(text, mark)}'"
        raise InputError(problem, file=path, place=place, remedy="mend the syntax") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise InputError(f"not valid YAML: {error}", file=path, remedy="mend the syntax") from None
    return Document(path, data, lines)


def _check_size(text: str, path: Path) -> None:
    """Raise `InputError` for a file that would take minutes, or too deep a stack, to load."""
    values = depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        else:
            values += 1
        if depth > _DEEPEST:
            raise _too_deep(path)
        if values > 2 * _MOST_VALUES:  # keys among them
            raise _too_many(path)


def _too_deep(path: Path) -> InputError:
    return InputError("nested too deeply", file=path, remedy="is this the right file?")


def _word_at(text: str, mark: yaml.Mark) -> str:
    """Return the name of the alias that a mark points to."""
    found = re.match(r"\*?([^\s,\[\]{}]*)", text.splitlines()[mark.line][mark.column :])
    return found[1][:100] if found else ""


def _too_many(path: Path) -> InputError:
    return InputError(
        f"holds more than {_MOST_VALUES} values (aliases repeat theirs)",
        file=path,
        remedy="is this the right file? arrays belong into .npy files",
    )


def _construct(
    loader: _Loader,
    node: Any,
    place: tuple[Any, ...],
    lines: dict[tuple[Any, ...], int],
    path: Path,
) -> Any:
    if len(lines) >= _MOST_VALUES:
        raise _too_many(path)
    if len(place) > _DEEPEST:  # an alias of a group that contains it
        raise _too_deep(path)
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
            result[key] = _construct(loader, value_node, (*place, key), lines, path)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_construct(loader, one, (*place, i), lines, path) for i, one in enumerate(node.value)]
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
    """Writes leaf lists and groups on one line."""

    ignore_aliases: ClassVar[Any] = lambda self, data: True


def write_yaml(path: str | os.PathLike[str], data: Any, *, comment: str = "") -> None:
    """Write plain data as YAML, completely or not at all, below a comment."""
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)
    above = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    write_whole(path, lambda stream: stream.write((above + text).encode()))


def write_whole(path: str | os.PathLike[str], write: Callable[[Any], Any]) -> None:
    """Call ``write`` with a binary stream whose content replaces ``path`` once it is complete.

    Raises `RimError` where the file cannot be written; no files remain then.
    """
    path = Path(path)
    try:
        temporary = temporary_file(path.parent, path.name)
        try:
            with os.fdopen(temporary.lock, "wb", closefd=False) as stream:
                write(stream)
                stream.flush()
                os.fsync(stream.fileno())
            os.chmod(temporary.path, 0o666 & ~_umask())
            os.replace(temporary.path, path)
        finally:
            temporary.close()
    except OSError as error:
        raise RimError(
            f"cannot be written: {error.strerror or error}",
            file=path,
            remedy="check the folder, its permissions and the free space; nothing was left behind",
        ) from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
