"""The command ``rim``: dispatch, errors in one line, exit status."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import traceback
from collections.abc import Sequence

from rim_camera_ros import __version__
from rim_camera_ros.commands import correct, info, record, simulate
from rim_camera_ros.errors import RimError

_COMMANDS = (simulate, record, correct, info)

_EPILOG = """exit status: 0 done, 1 the work failed, 2 bad usage or bad input, 130 interrupted.
Cameras and scenes are files or the names of shipped ones; rim COMMAND --help says more."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    result = argparse.ArgumentParser(
        prog="rim",
        description="Simulate, record, correct and examine range imaging (time-of-flight) cameras.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--version", action="version", version=f"rim {__version__}")
    commands = result.add_subparsers(metavar="COMMAND", required=True)
    for one in _COMMANDS:
        one.add_parser(commands)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; no traceback reaches the user.

    RIM_TRACEBACK=1 in the environment shows where an error came from.
    """
    try:
        given = parser().parse_args(argv)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 2
    try:
        status: int = given.run(given)
        sys.stdout.flush()
        return status
    except RimError as error:
        return _failed(str(error), error.exit_status)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _failed("interrupted", 130)
    except BrokenPipeError:
        # whoever read the output has gone; nothing may be written at the interpreter's end either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        return _failed("out of memory", 1)
    except Exception as error:
        return _failed(
            f"{type(error).__name__}: {error} (this is a fault of the program: please report it)", 1
        )


def _failed(text: str, status: int) -> int:
    if os.environ.get("RIM_TRACEBACK"):
        traceback.print_exc()
    print(f"rim: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
