"""Make blind cases of imperfect cameras, diagnose them through the command line, hold them against the gates.

`python -m test.blind.imperfect --out DIR --tiers null,single --cases 10` writes one line a case to
DIR/results.jsonl and the table to DIR/summary.md.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .case import Case, make_case
from .imperfections import OFF
from .plan import COUNTS, MASTER_SEED, plan
from .score import line, summary

RESULTS, SUMMARY = "results.jsonl", "summary.md"
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
#: Seconds after which a diagnosis counts as failed.
PATIENCE = 1800.0
ROOT = Path(__file__).resolve().parents[3]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    found = argparse.ArgumentParser(
        prog="python -m test.blind.imperfect",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found.add_argument("--out", type=Path, required=True, help="folder for results.jsonl and summary.md")
    found.add_argument("--seed", type=int, default=MASTER_SEED, help=f"master seed ({MASTER_SEED})")
    found.add_argument("--tiers", help=f"comma-separated, of {','.join(COUNTS)} (all)")
    found.add_argument("--cases", type=int, help="so many of each tier instead of the planned numbers")
    found.add_argument("--imperfections", choices=tuple(OFF), default="all", help="what is imperfect (all)")
    found.add_argument("--only", action="append", metavar="NAME", help="only this case; may be repeated")
    found.add_argument("--jobs", type=int, default=1, help="cases at a time (1)")
    found.add_argument("--resume", action="store_true", help="keep the results in OUT and go on")
    found.add_argument("--keep", action="store_true", help="keep recordings and reports")
    found.add_argument("--make-only", action="store_true", help="make the cases and diagnose nothing")
    found.add_argument("--package", type=Path, default=ROOT, help="checkout whose rim is run (this one)")
    found.add_argument("--one", help=argparse.SUPPRESS)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Make, diagnose, compare, and write the table."""
    options = parser().parse_args(arguments)
    if options.one:
        run_case(Case(**_case(json.loads(options.one))), options)
        return 0
    try:
        cases = chosen(options)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    path = options.out / RESULTS
    if path.exists() and not options.resume:
        print(f"error: {path} exists; --resume goes on with it", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    done = read(path)
    left = [case for case in cases if (case.name, case.seed, case.imperfections) not in done]
    print(f"{len(cases)} cases, {len(cases) - len(left)} done", flush=True)
    failed = run_all(left, options)
    found = [one for one in read(path).values() if one["name"] in {case.name for case in cases}]
    if found:
        table = summary(found)
        (options.out / SUMMARY).write_text(table, encoding="utf-8")
        print(table)
    return 1 if failed else 0


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the options ask for.

    Raises
    ------
    ValueError: a tier or a case is not of the plan.
    """
    tiers = options.tiers.split(",") if options.tiers else list(COUNTS)
    counts = {name: COUNTS.get(name, 0) if options.cases is None else options.cases for name in tiers}
    cases = plan(counts, master_seed=options.seed, imperfections=options.imperfections)
    if options.only:
        whole = plan(master_seed=options.seed, imperfections=options.imperfections)
        by_name = {case.name: case for case in [*whole, *cases]}
        missing = sorted(set(options.only) - set(by_name))
        if missing:
            raise ValueError(f"no such cases: {', '.join(missing)}; for example {whole[0].name}")
        cases = [by_name[name] for name in options.only]
    return cases


def _case(document: dict[str, Any]) -> dict[str, Any]:
    return {**document, "effects": tuple(document["effects"])}


def read(path: Path) -> dict[tuple[str, int, str], dict[str, Any]]:
    """Lines of results by name, seed and imperfections of their cases; a broken last line is passed over."""
    found = {}
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            one = json.loads(text)
        except json.JSONDecodeError:
            continue
        found[one["name"], one["seed"], one["imperfections"]] = one
    return found


def run_all(cases: Sequence[Case], options: argparse.Namespace) -> int:
    """Run cases, each in a process of its own; print a line for each; return how many could not be made."""
    started, failed = time.monotonic(), 0

    def run(case: Case) -> tuple[Case, dict[str, Any] | None, str]:
        command = [sys.executable, "-m", "test.blind.imperfect", "--out", str(options.out.absolute())]
        command += ["--one", json.dumps(asdict(case)), "--package", str(options.package.absolute())]
        command += ["--keep"] * options.keep + ["--make-only"] * options.make_only
        ended = subprocess.run(
            command, cwd=ROOT, env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False
        )
        if ended.returncode != 0:
            return case, None, (ended.stderr.strip().splitlines() or [f"exit {ended.returncode}"])[-1]
        return case, json.loads(ended.stdout.splitlines()[-1]), ""

    with ThreadPoolExecutor(options.jobs) as pool:
        for number, future in enumerate(as_completed([pool.submit(run, case) for case in cases]), start=1):
            case, one, reason = future.result()
            rest = (time.monotonic() - started) / number * (len(cases) - number) / 60
            if one is None:
                failed += 1
                print(f"! {case.name}: {reason}", flush=True)
                continue
            said = "+".join(e["effect"] for e in one.get("missing", [])) or one.get("verdict", "made")
            mark = " " if one.get("right", True) else "x"
            print(
                f"{mark} {case.name:22} {'+'.join(case.effects) or 'null':28} {said:34}"
                f" {one.get('cpu_seconds', 0):5.1f} s cpu, {rest:.0f} min to go",
                flush=True,
            )
    return failed


def run_case(case: Case, options: argparse.Namespace) -> None:
    """Make and diagnose one case; append its line to the results and print it."""
    folder = options.out / "cases" / case.name
    shutil.rmtree(folder, ignore_errors=True)
    truth = make_case(folder, case)
    if options.make_only:
        print(json.dumps({"name": case.name}))
        return
    # the truth is not where the diagnosis could read it
    root = np.load(folder / "truth.npy")
    for name in ("truth.json", "truth.npy"):
        (folder / name).unlink()
    answer = folder / "diagnosis"
    report, error, seconds = diagnose(folder, answer, options.package)
    one = {
        "name": case.name,
        "tier": case.tier,
        "seed": case.seed,
        "imperfections": case.imperfections,
        **{
            key: truth[key]
            for key in (
                "effects",
                "style",
                "hypothesis",
                "moved",
                "size",
                "share",
                "nats",
                "rival",
                "rival_nats",
                "strength",
                "parameters",
            )
        },
        "cpu_seconds": seconds,
        **line(truth, report, error, answer, root),
    }
    if options.keep:
        (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
        np.save(folder / "truth.npy", root)
    else:
        shutil.rmtree(folder)
    text = json.dumps(one)
    # one write in append mode, so that lines of several processes do not mix
    descriptor = os.open(options.out / RESULTS, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, (text + "\n").encode())
    finally:
        os.close(descriptor)
    print(text)


def diagnose(folder: Path, answer: Path, package: Path) -> tuple[dict[str, Any] | None, str | None, float]:
    """Run `rim diagnose` on a case with one thread: the report or None, the error, CPU seconds."""
    command = [
        *(sys.executable, "-m", "rim_camera_ros.cli", "diagnose", "recording"),
        *("--camera", "camera.yaml", "--scene", "scene.yaml", "--out", str(answer.absolute())),
        *("--threads", "1", "--quiet"),
    ]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    error = None
    try:
        ended = subprocess.run(
            command,
            cwd=folder,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(package)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        if ended.returncode != 0:
            last = ended.stderr.strip().splitlines() or ["no message"]
            error = f"exit {ended.returncode}: {last[-1]}"
    except subprocess.TimeoutExpired:
        error = f"not ready after {PATIENCE:.0f} s"
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if error is not None:
        return None, error, seconds
    report: dict[str, Any] = json.loads((answer / "report.json").read_text(encoding="utf-8"))
    return report, None, seconds


if __name__ == "__main__":
    sys.exit(main())
