"""Show the tracking on walking figures: ``python -m rim_camera_ros.tracking``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import RimError
from rim_camera_ros.files import find_camera
from rim_camera_ros.tracking.figures import SHIPPED, SHIPPED_FRAMES, crossing, overtaking
from rim_camera_ros.tracking.picture import draw
from rim_camera_ros.tracking.trial import Trial, run


def main() -> int:
    """Follow the people of the shipped scene, or of ``--seeds`` crossings drawn at random; print a table."""
    parser = argparse.ArgumentParser(prog="python -m rim_camera_ros.tracking", description=__doc__)
    parser.add_argument("--camera", default="sr3000", help="camera file, or the name of a shipped one")
    parser.add_argument(
        "--seeds", type=int, default=0, help="crossings drawn at random (0: the shipped scene)"
    )
    parser.add_argument("--overtaking", action="store_true", help="with --seeds: one overtakes the other")
    parser.add_argument("--picture", type=Path, help="PNG of the last one from above")
    options = parser.parse_args()
    try:
        camera = load_camera(find_camera(options.camera))
        trials: list[Trial] = []
        print("crossing   identities    RMS  95 %   max [mm]")
        draw_walks = overtaking if options.overtaking else crossing
        for seed in range(options.seeds):
            trials.append(run(draw_walks(seed), camera, seed=seed))
            _print(str(seed), trials[-1])
        if not trials:
            trials.append(run(SHIPPED, camera, seed=0, frames=SHIPPED_FRAMES))
            _print("shipped", trials[-1])
    except RimError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    kept = sum(trial.identities_kept for trial in trials)
    errors = np.concatenate([trial.errors for trial in trials])
    print(f"identities kept in {kept} of {len(trials)}; position {_millimetres(errors)} mm (RMS, 95 %, max)")
    if options.picture is not None:
        draw(trials[-1], options.picture)
    return 0


def _print(name: str, trial: Trial) -> None:
    kept = "kept" if trial.identities_kept else "lost"
    print(f"{name:>8}   {kept:>10}   {_millimetres(trial.errors)}", flush=True)


def _millimetres(errors: NDArray[np.float64]) -> str:
    if not errors.size:
        return "nobody followed"
    rms = float(np.sqrt(np.mean(errors**2)))
    return (
        f"{1e3 * rms:4.0f}  {1e3 * float(np.percentile(errors, 95)):4.0f}  {1e3 * float(errors.max()):4.0f}"
    )


if __name__ == "__main__":
    sys.exit(main())
