"""Parts that commands share: options, inputs, progress, notes."""

from __future__ import annotations

import argparse
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, TypeVar

from rim_camera_ros.bags import DEFAULT_NAMESPACE, Recording, Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.temporary import claim
from rim_camera_ros.threads import available

T = TypeVar("T")


class Parser(argparse.ArgumentParser):
    """A parser for which wrong usage is an `InputError`, in one line; options are not abbreviated."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **options})

    def error(self, message: str) -> NoReturn:
        """Raise `InputError`."""
        command = self.prog.partition(" ")[2]
        raise InputError(message, place=command or None, remedy=f"see {self.prog} --help")


def add_command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str, examples: str
) -> argparse.ArgumentParser:
    """Add a command with its description and examples."""
    return commands.add_parser(
        name,
        help=text.partition(".")[0],
        description=textwrap.fill(text, 90),
        epilog="examples:\n" + "\n".join(f"  {line}" for line in examples.strip().splitlines()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_topics(parser: argparse.ArgumentParser) -> None:
    """Add the options that name topics."""
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="topic of a role, e.g. distance=/tof/range",
    )
    parser.add_argument(
        "--namespace", default=DEFAULT_NAMESPACE, help=f"namespace of the topics ({DEFAULT_NAMESPACE})"
    )


def add_profile(parser: argparse.ArgumentParser) -> None:
    """Add the option that reads another driver's topics as they are, in addition to `add_topics`."""
    parser.add_argument(
        "--profile",
        metavar="NAME|FILE",
        help="driver whose radial, raw images are read as they are (others: rim import)",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options common to commands that write."""
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument("--quiet", action="store_true", help="no progress, notes and summary")


def add_threads(parser: argparse.ArgumentParser) -> None:
    """Add the option that says on how many threads to work."""
    parser.add_argument(
        "--threads",
        type=positive(int),
        default=available(),
        metavar="N",
        help="threads to work on; the result is the same with any number (the cores at hand, four at most)",
    )


def add_scheduler(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option that names a cluster, on whose workers ``what`` is done."""
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help=f"Dask scheduler on whose workers {what}, e.g. tcp://host:8786",
    )


def topics_of(given: argparse.Namespace) -> Topics:
    """Return the topics that the options name. Raises `InputError` for an unknown role or profile."""
    topics = Topics.parse(given.topic, namespace=given.namespace)
    if getattr(given, "profile", None) is None:
        return topics
    from rim_camera_ros.imports.direct import direct_topics

    bags = [getattr(given, name) for name in ("bag", "what") if hasattr(given, name)]
    return direct_topics(given.profile, Path([*bags, *getattr(given, "bags", ())][0]), topics)


def positive(kind: type[float] | type[int]) -> Callable[[str], float]:
    """Return an argument type for numbers above 0."""

    def convert(text: str) -> float:
        value = kind(text)
        if not 0 < value < float("inf"):
            raise argparse.ArgumentTypeError(f"must be positive, found {text}")
        return value

    convert.__name__ = "whole number" if kind is int else "number"
    return convert


def check_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Refuse outputs that would overwrite an input or one another, or that have no folder to lie in.

    Outputs that pass are claimed: another run that would write them is refused until this one ends. Raises
    `InputError` before any work is done. ``outputs`` by the name of their option.
    """
    sources = [Path(given).resolve() for given in inputs if given is not None and Path(given).exists()]
    seen: dict[Path, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        target = path.resolve()
        for source in sources:
            # a recording is a folder: the input may lie in the output, or the output in the input
            if target == source or target in source.parents or source in target.parents:
                where = "lies in" if source in target.parents else "would overwrite"
                raise InputError(
                    f"{option} {where} the input {source.name}", file=path, remedy="give another name"
                )
        other = seen.setdefault(target, option)
        if other != option:
            raise InputError(f"is both {other} and {option}", file=path, remedy="give two names")
        if not path.absolute().parent.is_dir():
            raise InputError(
                "its folder does not exist", file=path, remedy=f"make it: mkdir -p {path.parent}"
            )
        try:
            claim(path)
        except OSError as error:
            raise InputError(
                f"cannot be written: {error.strerror}", file=path, remedy="give a folder you may write to"
            ) from None


def check_file(path: Path | None, *, force: bool) -> None:
    """Raise `InputError` where an output file exists (unless ``force``) or is a folder."""
    if path is None or not (path.exists() or path.is_symlink()):
        return
    if path.is_dir():
        raise InputError("is a folder, not a file", file=path, remedy="give another name")
    if not force:
        raise InputError("exists already", file=path, remedy="--force replaces it")


def camera_of(name: str) -> Camera:
    """Return the camera of a file or a shipped name."""
    return load_camera(find_camera(name))


def scene_of(name: str) -> Scene:
    """Return the scene of a file or a shipped name."""
    return load_scene(find_scene(name))


def reading_notes(bag: Recording) -> list[str]:
    """Return notes on assumptions about a recording, and on messages that did not become frames."""
    return [*bag.assumptions, *(f"{bag.path}: excluded: {n} {why}" for why, n in bag.skipped.items() if n)]


def say(given: argparse.Namespace, notes: Iterable[str]) -> None:
    """Print notes to standard error, unless --quiet; after the work, so that an error stays one line."""
    if not given.quiet:
        for note in sorted(set(notes)):
            print(f"note: {note}", file=sys.stderr)


class Progress:
    """One line on a terminal with the progress of the work; nothing in a pipe or with --quiet."""

    def __init__(self, words: str, total: int | None, *, quiet: bool) -> None:
        self._words, self._total = words, total
        self._shown = not quiet and sys.stderr.isatty()
        self._start = time.monotonic()
        self._last = 0.0

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._shown and self._last:
            sys.stderr.write("\r\033[K")
            sys.stderr.flush()

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """Yield the items and count them."""
        for done, item in enumerate(items, 1):
            yield item
            self.show(done)

    def show(self, done: int) -> None:
        """Show that so many are done, at most ten times a second."""
        now = time.monotonic()
        if not self._shown or now - self._last < 0.1:
            return
        self._last = now
        rate = done / max(now - self._start, 1e-6)
        of = f" of {self._total}" if self._total else ""
        left = f", {max(self._total - done, 0) / rate:.0f} s left" if self._total and rate > 0 else ""
        sys.stderr.write(f"\r\033[K{self._words} {done}{of} frames ({rate:.0f}/s{left})")
        sys.stderr.flush()


class Stages:
    """One line on a terminal with the current task; nothing in a pipe or with --quiet."""

    def __init__(self, *, quiet: bool) -> None:
        self._shown = not quiet and sys.stderr.isatty()
        self._start = time.monotonic()

    def __enter__(self) -> Stages:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._shown:
            sys.stderr.write("\r\033[K")
            sys.stderr.flush()

    def show(self, text: str) -> None:
        """Show the current task, and for how long the work has gone on."""
        if self._shown:
            sys.stderr.write(f"\r\033[K{time.monotonic() - self._start:.0f} s: {text}"[:120])
            sys.stderr.flush()
