"""What the commands share: options, inputs, progress, notes."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import TypeVar

from rim_camera_ros.bags import DEFAULT_NAMESPACE, Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.scene import Scene, load_scene

T = TypeVar("T")


def add_command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str, examples: str
) -> argparse.ArgumentParser:
    """Add a command with its description and examples."""
    return commands.add_parser(
        name,
        help=text.partition(".")[0],
        description=text,
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


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options common to commands that write."""
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    parser.add_argument("--quiet", action="store_true", help="no progress, notes and summary")


def topics_of(given: argparse.Namespace) -> Topics:
    """Return the topics that the options name. Raises `InputError` for an unknown role."""
    return Topics.parse(given.topic, namespace=given.namespace)


def positive(kind: type[float] | type[int]) -> Callable[[str], float]:
    """Return an argument type for numbers above 0."""

    def convert(text: str) -> float:
        value = kind(text)
        if not 0 < value < float("inf"):
            raise argparse.ArgumentTypeError(f"must be positive, found {text}")
        return value

    convert.__name__ = "whole number" if kind is int else "number"
    return convert


def camera_of(name: str) -> Camera:
    """Return the camera of a file or a shipped name."""
    return load_camera(find_camera(name))


def scene_of(name: str) -> Scene:
    """Return the scene of a file or a shipped name."""
    return load_scene(find_scene(name))


def say(given: argparse.Namespace, notes: Iterable[str]) -> None:
    """Print notes to standard error, unless --quiet."""
    if not given.quiet:
        for note in sorted(notes):
            print(f"note: {note}", file=sys.stderr)


class Progress:
    """One line on a terminal that says how far the work is; nothing in a pipe or with --quiet."""

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
        """Say that so many are done, at most ten times a second."""
        now = time.monotonic()
        if not self._shown or now - self._last < 0.1:
            return
        self._last = now
        rate = done / max(now - self._start, 1e-6)
        of = f" of {self._total}" if self._total else ""
        left = f", {max(self._total - done, 0) / rate:.0f} s left" if self._total and rate > 0 else ""
        sys.stderr.write(f"\r\033[K{self._words} {done}{of} frames ({rate:.0f}/s{left})")
        sys.stderr.flush()
