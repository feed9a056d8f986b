"""Run the blind benchmark: make sealed cases, diagnose them, open, score, and write proof.md.

`python -m test.blind --out DIR` runs all cases; `--forms tuning --cases 1` tries one of each tier.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .generator.base import FORMS
from .page import write_page
from .plan import CI_COUNTS, COUNTS, MASTER_SEED, TWICE, Case, plan
from .run_case import LEDGER, ONE_THREAD, ROOT, state_of_program
from .score import first_word, named_right


def parser() -> argparse.ArgumentParser:
    """The command line."""
    found = argparse.ArgumentParser(
        prog="python -m test.blind", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("--out", type=Path, required=True, help="folder for the results and the ledger")
    found.add_argument("--docs", type=Path, help="folder for proof.md and proof/ (default: OUT)")
    found.add_argument("--forms", choices=FORMS, default="scoring", help="of the left-out effects")
    found.add_argument("--cases", type=int, help="so many of each tier instead of the planned numbers")
    found.add_argument("--tiers", help=f"comma-separated, of {','.join(COUNTS)} (all)")
    found.add_argument("--ci", action="store_true", help="the forty cases of continuous integration")
    found.add_argument("--only", action="append", metavar="NAME", help="only this case; may be repeated")
    found.add_argument("--seed", type=int, default=MASTER_SEED, help="master seed")
    found.add_argument("--jobs", type=int, default=2, help="cases at a time (2)")
    found.add_argument("--resume", action="store_true", help="keep results of this state of the program")
    found.add_argument("--keep", action="store_true", help="keep recordings and reports")
    found.add_argument("--no-baselines", action="store_true", help="leave the two other methods out")
    found.add_argument("--page-only", action="store_true", help="score the results in OUT as they are")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, score, and write the page."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parser().parse_args(arguments)
    folder = options.out / "results"
    if options.page_only:
        found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
        return _finish(options, found, arguments)
    try:
        cases = chosen(options)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if any(folder.glob("*.json")) and not options.resume:
        print(f"error: {options.out} holds results; --resume goes on with them", file=sys.stderr)
        return 2
    state = state_of_program()
    done, open_ = finished(cases, folder, state)
    print(f"{len(cases)} cases, {len(done)} done; generator {state['generator'][:16]}", flush=True)
    found, failed = run_all(open_, options)
    if {one["state"]["package"] for one in found} - {state["package"]}:
        print("warning: sources changed during the run; --resume repeats what is stale", file=sys.stderr)
    return _finish(options, done + found, arguments, failed)


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the options request.

    Raises
    ------
    ValueError: a tier or a case is not of the plan.
    """
    counts = dict(CI_COUNTS if options.ci else COUNTS)
    if options.tiers:
        wanted = options.tiers.split(",")
        counts = {name: COUNTS.get(name, 0) for name in wanted}
    if options.cases is not None:
        counts = dict.fromkeys(counts, options.cases)
    cases = plan(counts, forms=options.forms, master_seed=options.seed)
    if options.only:
        by_name = {case.name: case for case in plan(forms=options.forms, master_seed=options.seed)}
        missing = sorted(set(options.only) - set(by_name))
        if missing:
            raise ValueError(f"no such cases: {', '.join(missing)}; for example {TWICE}-000 or plain-017")
        cases = [by_name[name] for name in options.only]
    return cases


def finished(
    cases: Sequence[Case], folder: Path, state: dict[str, str]
) -> tuple[list[dict[str, Any]], list[Case]]:
    """Results of cases that were run with this state of the program, and the cases still to run."""
    done, left = [], []
    for case in cases:
        path = folder / f"{case.name}.json"
        result = json.loads(path.read_text()) if path.exists() else None
        same = result is not None and all(
            result["state"][key] == state[key] for key in ("generator", "package")
        )
        if same and result["case"]["seed"] == case.seed and result["case"]["forms"] == case.forms:
            done.append(result)
        else:
            left.append(case)
    return done, left


def run_all(cases: Sequence[Case], options: argparse.Namespace) -> tuple[list[dict[str, Any]], list[str]]:
    """Run cases, printing a line for each; return results, and why there is none of a case."""
    started, found, failed = time.monotonic(), [], []
    for number, (case, result, reason) in enumerate(_results(cases, options), start=1):
        rest = (time.monotonic() - started) / number * (len(cases) - number) / 60
        if result is None:
            failed.append(f"{case.name}: {reason}")
            print(f"! {failed[-1]}", flush=True)
            continue
        found.append(result)
        truth = "+".join(result["truth"]["effects"]) or "null"
        print(
            f"{' ' if named_right(result) else 'x'} {case.name:15} {truth:36} {first_word(result):24}"
            f" {result['cpu_seconds']:5.1f} s cpu, {rest:.0f} min to go",
            flush=True,
        )
    return found, failed


def _results(
    cases: Sequence[Case], options: argparse.Namespace
) -> Iterator[tuple[Case, dict[str, Any] | None, str]]:
    """Run each case in a process of its own, with one thread; yield them as they end."""

    def run(case: Case) -> tuple[Case, dict[str, Any] | None, str]:
        given = {
            "case": asdict(case),
            "out": str(options.out.absolute()),
            "baselines": not options.no_baselines,
            "keep": options.keep,
        }
        ended = subprocess.run(
            [sys.executable, "-m", "test.blind.run_case"],
            input=json.dumps(given),
            env={**os.environ, **ONE_THREAD},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        if ended.returncode != 0:
            return case, None, (ended.stderr.strip().splitlines() or [f"exit {ended.returncode}"])[-1]
        path = options.out / "results" / f"{case.name}.json"
        return case, json.loads(path.read_text()), ""

    pool = ThreadPoolExecutor(options.jobs)
    try:
        for future in as_completed([pool.submit(run, case) for case in cases]):
            yield future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _finish(
    options: argparse.Namespace,
    results: Sequence[dict[str, Any]],
    arguments: Sequence[str],
    failed: Sequence[str] = (),
) -> int:
    if not results:
        print(f"error: no results in {options.out}", file=sys.stderr)
        return 2
    ordered = sorted(results, key=lambda one: one["case"]["name"])
    command = (
        "make proof" if not arguments or options.docs else " ".join(["python -m test.blind", *arguments])
    )
    path = write_page(
        ordered,
        options.docs or options.out,
        ledger=options.out / LEDGER,
        command=command,
        not_run=failed,
    )
    print(path)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
