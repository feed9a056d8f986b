"""One case from making to opening: seal, publish, diagnose as a user would, open, compare."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .generator import Truth, make_case
from .generator.freeze import digest
from .plan import Case
from .score import intersection_over_union, region

#: The improved camera in the folder of a diagnosis.
MODEL = "camera.yaml"

FORMAT = "rim_proof/1"
LEDGER = "ledger.txt"
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
#: Seconds after which a diagnosis counts as failed.
PATIENCE = 900.0
ROOT = Path(__file__).resolve().parents[2]


def state_of_program() -> dict[str, str]:
    """Commit of the repository and sha256 over the sources of the generator and of the package."""
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    total = hashlib.sha256()
    package = ROOT / "rim_camera_ros"
    for path in sorted(package.rglob("*.py")):
        total.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes() + b"\0")
    return {"commit": commit or "none", "generator": digest(), "package": total.hexdigest()}


def run_case(
    case: Case, out: Path, *, state: Mapping[str, str], baselines: bool = True, keep: bool = False
) -> dict[str, Any]:
    """Make, seal, diagnose and open one case; its result is also written to `out/results/NAME.json`.

    A diagnosis that fails is a result too, with the field `error`.

    Raises
    ------
    RuntimeError: the sealed truth is not what was published.
    """
    given, sealed, answer = (out / place / case.name for place in ("given", "sealed", "answers"))
    for folder in (given, sealed, answer):
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
    truth = make_case(
        given,
        tier=case.tier,
        effect=case.effect,
        seed=case.seed,
        strength=case.strength,
        size=case.size,
        forms=case.forms,
        masked=case.masked,
    )
    seals = seal_away(given, sealed)
    publish(out / LEDGER, case.name, seals, state)
    outcome = diagnose(given, answer)
    trouble: list[str] = []
    open_again(sealed, seals)
    document = {
        "format": FORMAT,
        "case": asdict(case),
        "state": dict(state),
        "seals": seals,
        "truth": json.loads((sealed / "truth.json").read_text()),
        **outcome,
    }
    if outcome["error"] is None:
        document |= compared(answer, sealed, outcome["report"])
        attempt(MODEL, lambda: readable(answer / MODEL), trouble)
        document["chi2_of_truth"] = attempt(
            "twin", lambda: chi_square(truth, out / "twins" / case.name), trouble
        )
    if baselines:
        document["baselines"] = attempt("baselines", lambda: baseline_names(given), trouble)
    document["trouble"] = trouble
    if not keep:
        for folder in (given, answer):
            shutil.rmtree(folder, ignore_errors=True)
    write_result(out / "results" / f"{case.name}.json", document)
    return document


def seal_away(given: Path, sealed: Path) -> dict[str, str]:
    """Move the truth out of a case and return the sha256 of its files."""
    sealed.mkdir(parents=True)
    seals = {}
    for name in ("truth.json", "truth.npy"):
        shutil.move(given / name, sealed / name)
        seals[name] = hashlib.sha256((sealed / name).read_bytes()).hexdigest()
    return seals


def publish(ledger: Path, name: str, seals: Mapping[str, str], state: Mapping[str, str]) -> None:
    """Append one line to the ledger: case, time (UTC), both seals, generator, package."""
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    line = " ".join(
        [name, now, seals["truth.json"], seals["truth.npy"], state["generator"][:16], state["package"][:16]]
    )
    ledger.parent.mkdir(parents=True, exist_ok=True)
    # one write in append mode, so that lines of several processes do not mix
    descriptor = os.open(ledger, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, (line + "\n").encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_again(sealed: Path, seals: Mapping[str, str]) -> None:
    """Check that the truth is still the one that was published.

    Raises
    ------
    RuntimeError: it is not.
    """
    for name, expected in seals.items():
        if hashlib.sha256((sealed / name).read_bytes()).hexdigest() != expected:
            raise RuntimeError(f"{sealed / name} is not the truth that was published")


def diagnose(given: Path, answer: Path) -> dict[str, Any]:
    """Run `rim diagnose` on a case's files in a process of its own, with one thread.

    Returns report (None where it failed), error, wall and CPU seconds, largest resident memory [MB] of
    this process' children so far.
    """
    command = [
        *(sys.executable, "-m", "rim_camera_ros.cli", "diagnose", "recording"),
        *("--camera", "camera.yaml", "--scene", "scene.yaml", "--out", str(answer.absolute())),
        *("--threads", "1"),
    ]
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    error, report = None, None
    try:
        ended = subprocess.run(
            command,
            cwd=given,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        if ended.returncode != 0:
            lines = ended.stderr.strip().splitlines() or ["no message"]
            error = f"exit {ended.returncode}: {lines[-1]}"
    except subprocess.TimeoutExpired:
        error = f"not ready after {PATIENCE:.0f} s"
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if error is None:
        report = json.loads((answer / "report.json").read_text(encoding="utf-8"))
    return {
        "report": report,
        "error": error,
        "wall_seconds": time.monotonic() - started,
        "cpu_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_mb": after.ru_maxrss / 1024.0,
    }


def compared(answer: Path, sealed: Path, report: Mapping[str, Any]) -> dict[str, Any]:
    """Compare the reported region with the true one (both of 90 % of the mean square over poses).

    `truth.npy` is the root of that mean square, so it is squared first; `iou_of_root` leaves it as it is.
    """
    root = np.load(sealed / "truth.npy").astype(float)
    if not root.any():
        return {"iou": None, "iou_of_root": None, "true_region": None}
    true = region(root**2)
    reported = np.load(answer / report["where"]["pixels"]).astype(float)
    own = region(reported)
    return {
        "iou": intersection_over_union(own, true),
        "iou_of_root": intersection_over_union(own, region(root)),
        "true_region": float(true.mean()),
    }


def attempt(what: str, run: Callable[[], Any], trouble: list[str]) -> Any:
    """What a comparison gives; where it fails, None, with the reason among `trouble`."""
    try:
        return run()
    except Exception as error:
        trouble.append(f"{what}: {type(error).__name__}: {error}")
        return None


def readable(camera: Path) -> None:
    """Raises where the package does not read a camera file, as `rim simulate` would."""
    from rim_camera_ros.camera_file import load_camera

    load_camera(camera)


def baseline_names(given: Path) -> dict[str, str]:
    """See `baselines.first_named`."""
    from .baselines import first_named

    return first_named(given)


def chi_square(truth: Truth, folder: Path) -> float | None:
    """See `twin.chi_square_of_truth`."""
    from .twin import chi_square_of_truth

    return chi_square_of_truth(truth, folder)


def write_result(path: Path, document: Mapping[str, Any]) -> None:
    """Write a result whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    temporary.replace(path)


def main() -> int:
    """Run the case that standard input describes: arguments of `run_case` as JSON."""
    given = json.load(sys.stdin)
    case = Case(**{**given["case"], "size": tuple(given["case"]["size"])})
    # the state at this very moment: sources that change during a run must not go unnoticed
    state = state_of_program()
    run_case(case, Path(given["out"]), state=state, baselines=given["baselines"], keep=given["keep"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
