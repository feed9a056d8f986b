"""The command ``rim``: dispatch, errors in one line, exit status, interruption."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import FrameType, ModuleType

from rim_camera_ros import __version__, completion
from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.files import expanded
from rim_camera_ros.temporary import release_claims

_EPILOG = """exit status: 0 done, 1 the work failed, 2 bad usage or bad input, 130 interrupted.
Cameras and scenes are files or the names of shipped ones; rim COMMAND --help says more.
RIM_TRACEBACK=1 in the environment shows where an error came from."""

#: Signals that end the work; incomplete output is removed.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds after the first Ctrl-C during which a second one does not interrupt the clean-up.
_PATIENCE = 3.0
#: Seconds between two checks whether an import is over.
_AFTER_IMPORT = 0.05


#: The commands: modules of `rim_camera_ros.commands`, in the order in which the help lists them.
COMMANDS = (
    "board", "poses", "optics", "simulate", "record", "import", "camera", "correct", "calibrate", "diagnose",
    "compare", "plan", "reproduce", "info",
)  # fmt: skip
#: Modules that are not named like their command, as ``import`` is a keyword of Python.
_MODULES = {"import": "import_recording"}


def command_modules(names: Sequence[str] = COMMANDS) -> dict[str, ModuleType]:
    """Return the modules of commands by name."""
    return {name: import_module(f"rim_camera_ros.commands.{_MODULES.get(name, name)}") for name in names}


def parser(names: Sequence[str] = COMMANDS) -> argparse.ArgumentParser:
    """Return the parser of commands; it raises `InputError` for bad usage."""
    from rim_camera_ros.commands.common import Parser

    result = Parser(
        prog="rim",
        description="Simulate, record, correct, calibrate and diagnose time-of-flight cameras.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--version", action="version", version=f"rim {__version__}")
    commands = result.add_subparsers(metavar="COMMAND", required=True)
    for module in command_modules(names).values():
        module.add_parser(commands)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; no traceback reaches the user."""
    try:
        return _run([_with_home(argument) for argument in (sys.argv[1:] if argv is None else argv)])
    except RimError as error:
        return _failed(str(error), error.exit_status)
    except KeyboardInterrupt as end:
        for number in _ENDING:
            signal.signal(number, signal.SIG_IGN)
        return _failed(": ".join(["interrupted", *map(str, end.args)]), 130)
    except BrokenPipeError:
        _drop_output()  # the reader of the output is gone
        return 0
    except OSError as error:
        _drop_output()
        reason = error.strerror or str(error)
        place = error.filename if isinstance(error.filename, str) else "reading or writing failed"
        return _failed(f"{place}: {reason} (check the disk and the permissions)", 1)
    except MemoryError:
        return _failed("out of memory", 1)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == __package__:
            return _fault(error)
        remedy = f"install what the package needs: {sys.executable} -m pip install '<its folder>[diagnosis]'"
        return _failed(f"the Python module '{error.name}' is not installed ({remedy})", 1)
    except Exception as error:
        return _fault(error)


def _run(argv: list[str]) -> int:
    """Parse the command line, which imports the command, and do the work."""
    if completion.requested():
        named = completion.command_to_complete(COMMANDS)
        completion.complete(completion.parser_of_names(COMMANDS) if named is None else parser((named,)))
    command = argv[0] if argv and not argv[0].startswith("-") else None
    if command is not None and command not in COMMANDS:
        raise InputError(f"no command '{command}'", remedy=nearest_name(command, COMMANDS))
    try:
        # other commands are not imported, which would take a second
        given = parser(COMMANDS if command is None else (command,)).parse_args(argv)
    except SystemExit as end:  # --help and --version
        sys.stdout.flush()
        return end.code if isinstance(end.code, int) else 2
    with _signals():
        try:
            status: int = given.run(given)
        finally:
            release_claims()
        sys.stdout.flush()
    return status


@contextmanager
def _signals() -> Iterator[None]:
    """Turn the first signal that ends the work into a KeyboardInterrupt; ignore further ones for a while.

    A signal is postponed during an import, as callbacks of imports lose exceptions, and during code made from
    text (dataclasses), after which the interpreter would end itself by the signal even if it was caught.
    Signals that are already ignored (``nohup``, a script's background job) stay ignored. Outside of the main
    thread nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    last: list[float] = []
    put_off: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _uninterruptible(frame):
            put_off.append(number)
            signal.signal(signal.SIGALRM, interrupt)
            signal.setitimer(signal.ITIMER_REAL, _AFTER_IMPORT)
            return
        now = time.monotonic()
        if not last or now - last[-1] > _PATIENCE:
            last.append(now)
            raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in (*_ENDING, signal.SIGALRM)}
    ours = [number for number in _ENDING if before[number] != signal.SIG_IGN]
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        if put_off:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number in (*ours, signal.SIGALRM):
            if signal.getsignal(number) == interrupt:
                signal.signal(number, before[number])


def _with_home(word: str) -> str:
    """Return a word of the command line with ``~`` as the home folder, also after ``--option=``."""
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return option + equals + expanded(value) if value.startswith("~") else word


def _uninterruptible(frame: FrameType | None) -> bool:
    """Whether a frame or one of its callers belongs to the import system, or to code that ``exec`` runs."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(("<frozen importlib", "<string>")):
            return True
        frame = frame.f_back
    return False


def _drop_output() -> None:
    """Prevent buffered output from being written at the interpreter's end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fault(error: Exception) -> int:
    return _failed(f"{type(error).__name__}: {error} (this is a fault of the program: please report it)", 1)


def _failed(text: str, status: int) -> int:
    if os.environ.get("RIM_TRACEBACK"):
        traceback.print_exc()
    print(f"rim: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
