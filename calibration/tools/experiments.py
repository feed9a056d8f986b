#!/usr/bin/env python3
"""Write the laboratory: the set-ups of Kahlmann 2007, chapter 3, as scene files with a schedule.

Moved surfaces have `pose: truth`: the schedule moves them, the recording holds their poses, and a calibration that is given the same
scene file takes them from there. What is at rest has its pose in the file. With `--check` nothing is written, and the exit
status is 1 where a file on disk differs.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from laboratory import EXPERIMENTS, SECOND_CAMERA

from rim_camera_ros.camera_file import load_camera, save_camera, with_effects
from rim_camera_ros.effects.interference import Interference

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "calibration" / "experiments"
SECOND_CAMERA_COMMENT = """\
The shipped sr3000 with a second camera of the same kind that lights the same scene (Kahlmann 2007, eq. 2.11): its quartz is 1 ppm off, so
that the selectivity by frequency hardly helps; 80 counts in each pixel are assumed. To simulate two_cameras_experiment with.

Generated: calibration/tools/experiments.py from calibration/sr3000.yaml
"""


def write(folder):
    """Write every file into a folder."""
    for name, make in EXPERIMENTS.items():
        (folder / f"{name}.yaml").write_text(make().text(name), encoding="utf-8")
    camera = load_camera(ROOT / "calibration" / "sr3000.yaml")
    effects = dict(camera.effects) | {"interference": Interference(frequency=20000020.0, amplitude=80.0)}
    provenance = {
        "source": "sr3000.yaml and an assumed second camera",
        "fitted_by": "nobody",
        "recordings": [],
    }
    camera = replace(with_effects(camera, effects), covariance=None, provenance=provenance)
    save_camera(camera, folder / f"{SECOND_CAMERA}.yaml", comment=SECOND_CAMERA_COMMENT)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if a file differs")
    if not parser.parse_args(arguments).check:
        FOLDER.mkdir(exist_ok=True)
        write(FOLDER)
        return 0
    with tempfile.TemporaryDirectory() as made:
        write(Path(made))
        fresh = {one.name: one.read_bytes() for one in Path(made).iterdir()}
    there = {one.name: one.read_bytes() for one in FOLDER.iterdir() if one.is_file()}
    differ = sorted(name for name in fresh.keys() | there.keys() if fresh.get(name) != there.get(name))
    for name in differ:
        print(f"{name}: not as this script makes it")
    if not differ:
        print("all as this script makes them")
    return int(bool(differ))


if __name__ == "__main__":
    sys.exit(main())
