"""Parameters of the launch files, as files that distinguish the nodes of one process; no ROS in here."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from rim_camera_ros.errors import InputError

_EVERY_NODE = "/**"
_LEVELS = ("debug", "info", "warn", "error", "fatal")


def preset_file(name: str, presets: Path) -> str:
    """Return the file of a preset in the folder ``presets``, or '' for no name.

    Raises `InputError`, which lists the existing presets.
    """
    if not name:
        return ""
    path = presets / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(one.stem for one in presets.glob("*.yaml")))
        raise InputError(f"no preset '{name}'", place="preset", remedy=f"presets: {known}")
    return str(path)


def for_node(
    node: str, *, folder: str | Path, file: str = "", values: Mapping[str, Any] | None = None
) -> list[str]:
    """Return parameter files for one node of a process; later ones override earlier ones.

    ``file``: a user's parameter file, in which ``/**`` means this node; ``values`` override it. They are
    written to ``folder`` and stay there, as a node that is started again reads them again: use the log folder
    of the launch. Raises `InputError` where the file cannot be read or is not a parameter file.
    """
    contents: list[dict[str, Any]] = []
    if file:
        contents.append(_addressed(_read(file), node))
    if values:
        contents.append({f"{_EVERY_NODE}/{node}": {"ros__parameters": dict(values)}})
    return [_written(content, Path(folder), node) for content in contents]


def log_levels(text: str, *, namespace: str, nodes: tuple[str, ...]) -> list[str]:
    """Return the arguments of ``--ros-args`` that set log levels, none for ''.

    ``text``: a level for all ``nodes``, or levels by node, ``driver=debug,correction=warn``. Raises
    `InputError` for an unknown level or node.
    """
    levels: dict[str, str] = {}
    for part in (word.strip() for word in text.split(",") if word.strip()):
        node, _, level = part.rpartition("=")
        if level not in _LEVELS:
            raise InputError(
                f"'{level}' is no level", place="log_level", remedy="one of: " + ", ".join(_LEVELS)
            )
        if node and node not in nodes:
            raise InputError(f"no node '{node}'", place="log_level", remedy="one of: " + ", ".join(nodes))
        levels |= dict.fromkeys([node] if node else nodes, level)
    prefix = "".join(f"{word}." for word in namespace.strip("/").split("/") if word)
    return [word for node, level in levels.items() for word in ("--log-level", f"{prefix}{node}:={level}")]


def _read(file: str) -> dict[str, Any]:
    path = Path(file).expanduser()
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=path, remedy="check its path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"is no YAML: {' '.join(str(error).split())[:200]}", file=path) from None
    if not isinstance(content, dict) or not all(isinstance(one, dict) for one in content.values()):
        raise InputError(
            "is no parameter file", file=path, remedy="/**: {ros__parameters: {name: value}}, say"
        )
    return content


def _addressed(content: Mapping[str, Any], node: str) -> dict[str, Any]:
    return {f"{_EVERY_NODE}/{node}" if name == _EVERY_NODE else name: one for name, one in content.items()}


def _written(content: Mapping[str, Any], folder: Path, node: str) -> str:
    with tempfile.NamedTemporaryFile(
        "w", dir=folder, prefix=f"{node}_", suffix=".yaml", delete=False
    ) as written:
        yaml.safe_dump(dict(content), written)
    return written.name
