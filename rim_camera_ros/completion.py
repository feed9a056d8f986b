"""Completion of ``rim`` in the shell: commands, options, shipped cameras and scenes, effects, topics.

``eval "$(register-python-argcomplete rim)"`` in ~/.bashrc switches it on (zsh, fish: see argcomplete).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable

from rim_camera_ros.errors import RimError

#: Variable that argcomplete sets where the shell requests completions.
_VARIABLE = "_ARGCOMPLETE"
Completer = Callable[..., Iterable[str]]


def requested() -> bool:
    """Whether this process was started to complete a command line, not to run it."""
    return _VARIABLE in os.environ


def command_to_complete(known: Iterable[str]) -> str | None:
    """Return the command in the line that is completed, None where there is none yet."""
    words = os.environ.get("COMP_LINE", "").split(" ")
    return next((one for one in known if [one] == words[1:2] and len(words) > 2), None)


def parser_of_names(known: Iterable[str]) -> argparse.ArgumentParser:
    """Return a parser with only the names of the commands, as importing all commands takes seconds."""
    result = argparse.ArgumentParser(prog="rim")
    result.add_argument("--version", action="store_true")
    commands = result.add_subparsers()
    for name in known:
        commands.add_parser(name)
    return result


def complete(parser: argparse.ArgumentParser) -> None:
    """Print the completions of the line and end the process; return where argcomplete is not installed."""
    try:
        import argcomplete
    except ImportError:
        return
    for argument_parser in _parsers(parser):
        for action in argument_parser._actions:  # argparse has no public list of them
            completer = _completer(action)
            if completer is not None:
                action.completer = completer  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)


def _parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    found = [parser]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += list(action.choices.values())
    return found


def _completer(action: argparse.Action) -> Completer | None:
    """Return the function that completes the value of an option; None: argcomplete completes files."""
    name = action.dest
    if name in ("camera", "scene"):
        return _names_and_files("calibration" if name == "camera" else "config")
    if name == "what":
        return _names_and_files("calibration", "config", also=("usb",))
    if name in ("effects", "without"):
        return _effects
    if name == "topic":
        return _roles
    return None


def _names_and_files(*kinds: str, also: tuple[str, ...] = ()) -> Completer:
    def completer(prefix: str, **_: object) -> list[str]:
        from argcomplete.completers import FilesCompleter

        from rim_camera_ros.files import shipped

        try:
            names = [*also, *(name for kind in kinds for name in shipped(kind))]
        except RimError:  # an installation without the shipped files
            names = list(also)
        files = FilesCompleter() if "usb" in also else FilesCompleter(("yaml", "yml"))
        return [name for name in names if name.startswith(prefix)] + list(files(prefix))

    return completer


def _effects(prefix: str, **_: object) -> list[str]:
    """Complete the last of several effects, joined by commas."""
    from rim_camera_ros.effects import registry

    before, comma, last = prefix.rpartition(",")
    given = before.split(",")
    return [f"{before}{comma}{name}" for name in registry() if name.startswith(last) and name not in given]


def _roles(prefix: str, **_: object) -> list[str]:
    from rim_camera_ros.bags.topics import ROLES

    return [f"{role}=" for role in ROLES if role.startswith(prefix)]
