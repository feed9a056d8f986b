"""Make a case: `--out DIR --tier plain --effect scattering --scene rich --seed 12 --strength 0.8`."""

import argparse
import sys
from pathlib import Path

from .base import FORMS
from .case import make_case, seal
from .catalogue import OUTSIDE, TIERS, VOCABULARY
from .scenes import SCENES


def columns_and_rows(text: str) -> tuple[int, int]:
    """`176x144` as numbers."""
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 16 and int(rows) >= 16):
        raise argparse.ArgumentTypeError(f"{text!r} is not COLUMNSxROWS, for example 176x144")
    return int(columns), int(rows)


def main(arguments: list[str] | None = None) -> int:
    """Make one case and print the seal of its truth."""
    parser = argparse.ArgumentParser(prog="python -m test.blind.generator", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write, must not exist")
    parser.add_argument("--tier", choices=TIERS, required=True)
    parser.add_argument(
        "--effect", help=f"{', '.join((*VOCABULARY, *OUTSIDE))}; two joined by +; default: drawn"
    )
    parser.add_argument("--scene", choices=SCENES, help="default: drawn among those that show the effect")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument(
        "--strength", type=float, help="RMS of effect / median sigma; default: 0.25 to 3, drawn"
    )
    parser.add_argument(
        "--size", type=columns_and_rows, default=(88, 72), help="columns x rows, default 88x72"
    )
    parser.add_argument("--forms", choices=FORMS, default="scoring")
    parser.add_argument(
        "--masked", action=argparse.BooleanOptionalAction, default=None, help="default: by tier"
    )
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    options = parser.parse_args(arguments)
    try:
        make_case(**vars(options))
    except (ValueError, FileExistsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(seal(options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
